"""Kernels: plain scalar functions that Python runs as they stand and numba compiles.

A kernel takes and returns floats, ints, bools and NamedTuples of them, and calls only `math`
and other kernels. `compile_kernel(kernel)` gives its machine-code twin, built from the same
source: every kernel it names is replaced by that one's twin. The loop process runs the plain
functions and never imports numba.

Kernels are functions of this house and, where a module lists their modules as `KERNEL_MODULES`,
those that outside packages add to it.
"""

from __future__ import annotations

import ast
import hashlib
import os
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, TypeVar, cast

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

_HOUSE = ("pamctl", "hal")


def compile_kernel(kernel: Kernel) -> Kernel:
    """Return the numba twin of a kernel: same arguments, same values, at machine speed.

    The first call compiles (seconds); the machine code is kept in the user's cache
    for the next process, under a key made of every source that the kernel can depend on.
    """
    return cast(Kernel, _make_twin(kernel, for_python=True))


@cache
def _make_twin(kernel: FunctionType, *, for_python: bool) -> Any:
    """Return a twin that Python can call, or one that only other twins call.

    What takes Python's tuples apart, and C's, is longer than most kernels: without it the
    closed loop compiles in less than half the time.
    """
    used = {*kernel.__code__.co_names, "__builtins__", "__name__"}
    twin = FunctionType(
        kernel.__code__,
        {
            name: _make_twin_if_kernel(kernel.__globals__[name], kernel.__module__)
            for name in used & {*kernel.__globals__}
        },
        kernel.__name__,
        kernel.__defaults__,
    )
    # numba's cache knows a function by its name: a kernel may be called both ways.
    twin.__qualname__ = kernel.__qualname__ + ("" if for_python else "_for_kernels")
    twin.__module__ = kernel.__module__
    return _import_numba(kernel.__module__).njit(
        twin,
        cache=_may_cache(),
        error_model="python",  # division by zero raises, as in the plain function
        no_cpython_wrapper=not for_python,
        no_cfunc_wrapper=True,
    )


def _make_twin_if_kernel(value: object, caller: str) -> object:
    is_kernel = isinstance(value, FunctionType) and (
        value.__module__ in _list_added_modules(caller) or _is_known(value.__module__, caller)
    )
    return _make_twin(value, for_python=False) if is_kernel else value


def _list_added_modules(module: str) -> tuple[str, ...]:
    """List the modules whose kernels a module calls without naming them in its source."""
    return getattr(sys.modules.get(module), "KERNEL_MODULES", ())


def _is_known(module: str, caller: str) -> bool:
    """Tell whether a module is of this house, or of the outside package that names it."""
    return module.split(".")[0] in (*_HOUSE, caller.split(".")[0])


def _import_numba(module: str) -> ModuleType:
    """Return numba, told to keep the code of this module's kernels by all they depend on."""
    import numba

    # numba looks only at a kernel's own file to see whether its cached code is stale;
    # ours call each other, and use each other's types, across files.
    settings: Any = numba.config
    settings.CACHE_DIR = str(_cache_home() / "pamctl" / f"kernels-{_hash_sources(module)}")
    return numba


def _cache_home() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


@cache
def _may_cache() -> bool:
    """Tell whether the user has a place of their own for machine code; /tmp is everyone's."""
    try:
        _cache_home().mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(_cache_home(), os.W_OK)


@cache
def _hash_sources(module: str) -> str:
    """Hash the sources of a module and of all kernels' modules that it imports, on any way."""
    waiting, found = [module], {module}
    while waiting:
        new = _find_imports(waiting.pop()) - found
        found |= new
        waiting += new
    digest = hashlib.sha256()
    for name in sorted(found):
        digest.update(_source_of(name).read_bytes())
    return digest.hexdigest()[:16]


@cache
def _find_imports(module: str) -> set[str]:
    """Find the modules of kernels that a module's source names, those for types included."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(_source_of(module).read_bytes())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        else:
            continue
        found |= {n for n in names if _is_known(n, module) and _source_of(n).exists()}
    return found | {*_list_added_modules(module)}


def _source_of(module: str) -> Path:
    if module.split(".")[0] not in _HOUSE:  # a script, or an outside package
        found = sys.modules.get(module)
        return Path(str(getattr(found, "__file__", None) or module))
    path = Path(__file__).parent.parent.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
