"""The truths' own way to machine code, kept apart from the plant's."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

_KERNELS = (
    "machine_code.py",
    "physics.py",
    "truth.py",
    "valve.py",
    "air.py",
    "mechanism.py",
    "advance.py",
    "passes.py",
)


def _cache_of_these_sources() -> str:
    # numba would look at one file only, and the kernels call each other across files.
    folder = Path(__file__).parent
    digest = hashlib.sha256(b"".join((folder / name).read_bytes() for name in _KERNELS))
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return str(home / "pamctl" / f"hidden-{digest.hexdigest()[:16]}")


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a function of numbers, tuples and arrays."""
    return _compiled(function, for_python=True)


def part(function: Callable[..., Any]) -> Any:
    """Compile a function that only kernels call: without what takes Python's tuples apart."""
    return _compiled(function, for_python=False)


def _compiled(function: Callable[..., Any], *, for_python: bool) -> Any:
    before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, _cache_of_these_sources()
    try:
        return numba.njit(cache=True, no_cpython_wrapper=not for_python, no_cfunc_wrapper=True)(
            function
        )
    finally:
        numba.config.CACHE_DIR = before
