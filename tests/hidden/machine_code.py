"""The truths' own way to machine code, kept apart from the plant's."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

_KERNELS = (
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
    before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, _cache_of_these_sources()
    try:
        return numba.njit(cache=True)(function)
    finally:
        numba.config.CACHE_DIR = before
