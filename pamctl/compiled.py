"""Kernels: plain scalar functions that Python runs as they stand and numba compiles.

A kernel takes and returns floats, ints, bools and NamedTuples of them, and calls
only `math` and other kernels of this house. `compiled(kernel)` gives its machine-code
twin, built from the same source: every kernel it names is replaced by that one's
twin. The loop process runs the plain functions and never imports numba.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, TypeVar, cast

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

_HOUSE = ("pamctl", "hal")


def compiled(kernel: Kernel) -> Kernel:
    """Return the numba twin of a kernel: same arguments, same values, at machine speed.

    The first call compiles (seconds); the machine code is kept in the user's cache
    for the next process, under a key made of all our sources.
    """
    return cast(Kernel, _twin(kernel))


@cache
def _twin(kernel: FunctionType) -> Any:
    used = {*kernel.__code__.co_names, "__builtins__", "__name__"}
    twin = FunctionType(
        kernel.__code__,
        {name: _twin_if_kernel(kernel.__globals__[name]) for name in used & {*kernel.__globals__}},
        kernel.__name__,
        kernel.__defaults__,
    )
    twin.__qualname__ = kernel.__qualname__
    twin.__module__ = kernel.__module__
    # error_model: division by zero raises, as in the plain function.
    return _numba().njit(twin, cache=_may_cache(), error_model="python")


def _twin_if_kernel(value: object) -> object:
    is_kernel = isinstance(value, FunctionType) and value.__module__.split(".")[0] in _HOUSE
    return _twin(value) if is_kernel else value


@cache
def _numba() -> ModuleType:
    import numba

    # numba looks only at a kernel's own file to see whether its cached code is stale;
    # ours call each other across files, so the key is the hash of them all.
    settings: Any = numba.config
    settings.CACHE_DIR = str(_cache_home() / "pamctl" / f"kernels-{_sources_digest()}")
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


def _sources_digest() -> str:
    package = Path(__file__).parent
    digest = hashlib.sha256()
    for source in sorted([*package.rglob("*.py"), *package.parent.glob("hal/*.py")]):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]
