"""Kernels: plain scalar functions that Python can run and numba can compile.

A kernel takes and returns floats, ints, bools and NamedTuples of them. It calls only `math` and
other kernels: of pamctl, or of its own outside package. `compile_kernel(kernel)` returns its
machine-code twin, built from the same source. Every kernel that it names is replaced by that
kernel's twin. The loop process runs the plain functions and never imports numba.

A module that calls kernels of outside packages lists their modules in `KERNEL_MODULES`.
"""

from __future__ import annotations

import hashlib
import os
import re
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from importlib.util import resolve_name
from pathlib import Path
from shutil import rmtree
from types import FunctionType
from typing import Any, TypeVar, cast

from pamctl.code_folder.find_code_folder import explain_unwritable, find_code_folder

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

_HOUSE = ("pamctl", "hal")
_UNUSED_S = 30 * 86_400.0
"""Machine code of sources that nobody ran for so long is removed."""


class Progress:
    """What a user who waits may want to know."""

    compiles_first = False
    """Nobody ran this code here before: it is compiled first, for some 20 s."""


progress = Progress()

Substitution = tuple[Callable[..., Any], Callable[..., Any]]
"""A function, and the kernel that compiled code calls instead of it."""


def compile_kernel(kernel: Kernel, substitution: Substitution | None = None) -> Kernel:
    """Return the numba twin of a kernel: same arguments, same values, at machine speed.

    `substitution` fixes a function that plain Python looks up in every call: numba cannot choose a
    function by the type of an argument. The first call compiles (seconds). The machine code is kept
    in the user's cache for the next process. Its key covers every source that the kernel can depend
    on.
    """
    return cast(Kernel, _make_twin(kernel, substitution, for_python=True))


def make_inner_twin(kernel: Kernel, substitution: Substitution | None = None) -> Kernel:
    """Return a twin that only compiled code can call, and that is in no cache.

    Machine code from a cache cannot be written into an object file.
    """
    return cast(Kernel, _make_twin(kernel, substitution, for_python=False))


@cache
def _make_twin(kernel: FunctionType, substitution: Substitution | None, *, for_python: bool) -> Any:
    """Return a twin that Python can call, or one that only other twins call.

    The code that converts tuples from Python or C is longer than most kernels. Without it the
    closed loop compiles in less than half the time.
    """
    if substitution is not None and kernel is substitution[0]:
        return _make_twin(substitution[1], None, for_python=for_python)
    twin = FunctionType(
        kernel.__code__,
        {
            name: _make_twin(value, _select_substitution(value, substitution), for_python=False)
            if _is_kernel(value, kernel)
            else value
            for name, value in _used_globals(kernel).items()
        },
        kernel.__name__,
        kernel.__defaults__,
    )
    # numba's cache identifies a function by its name, and a kernel may be called both ways.
    twin.__qualname__ = kernel.__qualname__ + ("" if for_python else "_for_kernels")
    if substitution is not None:
        twin.__qualname__ += f"_with_{substitution[1].__qualname__}"
    twin.__module__ = kernel.__module__
    modules = [kernel.__module__, *([] if substitution is None else [substitution[1].__module__])]
    import numba

    njit: Any = numba.njit
    return njit(
        twin,
        cache=for_python and _choose_cache(*modules),
        error_model="python",  # division by zero raises, as in the plain function
        no_cpython_wrapper=not for_python,
        no_cfunc_wrapper=True,
        forceinline=not for_python,
    )


def _used_globals(kernel: FunctionType) -> dict[str, Any]:
    used = {*kernel.__code__.co_names, "__builtins__", "__name__"}
    return {name: kernel.__globals__[name] for name in used & {*kernel.__globals__}}


def _is_kernel(value: object, caller: FunctionType) -> bool:
    return isinstance(value, FunctionType) and (
        _root_package(value.__module__) in {*_HOUSE, _root_package(caller.__module__)}
        or value.__module__ in _list_added_modules(caller.__module__)
    )


def _list_added_modules(module: str) -> tuple[str, ...]:
    """List the modules whose kernels a module calls without naming them in its source."""
    return getattr(sys.modules.get(module), "KERNEL_MODULES", ())


def _root_package(module: str) -> str:
    return module.partition(".")[0]


def _select_substitution(
    kernel: FunctionType, substitution: Substitution | None
) -> Substitution | None:
    """Return the substitution if it concerns a kernel; all other kernels share one twin."""
    concerned = substitution is not None and _reaches(kernel, substitution[0])
    return substitution if concerned else None


@cache
def _reaches(kernel: FunctionType, target: FunctionType) -> bool:
    return kernel is target or any(
        _reaches(value, target)
        for value in _used_globals(kernel).values()
        if _is_kernel(value, kernel)
    )


def _choose_cache(*modules: str) -> bool:
    """Give numba a cache for these modules' kernels, keyed by all their dependencies.

    Return whether it can be written.
    """
    import numba

    # numba checks only a kernel's own file for changes;
    # our kernels use kernels and types of other files.
    settings: Any = numba.config
    folder = _find_cache(hash_sources(*modules))
    settings.CACHE_DIR = str(folder)
    progress.compiles_first = progress.compiles_first or not folder.is_dir()
    return not explain_unwritable(folder)


@cache
def _find_cache(key: str) -> Path:
    """Return the folder of a key, marked as used; a new key removes what is long unused."""
    folder = find_code_folder() / f"kernels-{key}"
    with suppress(OSError):  # without a cache everything is compiled anew
        if folder.is_dir():
            os.utime(folder)
        else:
            _remove_unused(folder.parent)
    return folder


def _remove_unused(home: Path) -> None:
    os.utime(home)  # its time is now: kernels may import no clock
    now_s = home.stat().st_mtime
    for folder in home.glob("kernels-*"):
        if now_s - folder.stat().st_mtime > _UNUSED_S:
            rmtree(folder, ignore_errors=True)


@cache
def hash_sources(*modules: str) -> str:
    """Hash the sources of modules, and of their imports from pamctl or their own package."""
    waiting, found = [*modules], {*modules}
    while waiting:
        new = _find_imports(waiting.pop()) - found
        found |= new
        waiting += new
    digest = hashlib.sha256()
    for name in sorted(found):
        # The name too: numba identifies types by their module.
        digest.update(name.encode() + b"\0" + _source_of(name).read_bytes())
    return digest.hexdigest()[:16]


_IMPORT = re.compile(
    rb"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n#]*)|import[ \t]+([^\n#]*))",
    re.MULTILINE,
)
"""An import in a source. One in a docstring counts too, which does no harm."""
_COMMENT = re.compile(rb"#[^\n]*")


@cache
def _find_imports(module: str) -> set[str]:
    """Find the modules that a module's source imports, also those for types.

    Only modules of pamctl and of the module's own package count. The sources are searched, not
    parsed: that would take longer than to load the machine code.
    """
    found: set[str] = set()
    house = {*_HOUSE, _root_package(module)}
    for origin, names, modules in _IMPORT.findall(_source_of(module).read_bytes()):
        if modules:
            found |= {*_split_names(modules)}
        else:
            source = _name_source(origin.decode(), module)
            found |= {source, *(f"{source}.{name}" for name in _split_names(names))}
    found = {n for n in found if _root_package(n) in house and _source_of(n).is_file()}
    return found | {*_list_added_modules(module)}


def _split_names(names: bytes) -> list[str]:
    """Return the names of a list of imports, without the names that they get."""
    plain = _COMMENT.sub(b"", names).decode().strip("() \t\n")
    return [word.split()[0] for word in plain.split(",") if word.strip()]


def _name_source(origin: str, module: str) -> str:
    """Return the module that `from origin import` names."""
    name = origin.lstrip(".")
    if name == origin:
        return name
    return resolve_name(origin, sys.modules[module].__package__)


def _source_of(module: str) -> Path:
    if _root_package(module) not in _HOUSE:  # an outside package, or a script with its own kernel
        return Path(str(getattr(sys.modules.get(module), "__file__", None)))
    path = Path(__file__).parent.parent.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
