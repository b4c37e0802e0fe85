"""A kernel of arrays as machine code in a file: numba is imported to build it, not to run it.

To import numba and to load machine code from its cache costs most of a second in every process.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pamctl.compiled import Substitution, compile_kernel, hash_sources, progress
from pamctl.compiled_ahead.layout import NotFlat
from pamctl.compiled_ahead.library import (
    FORBIDDEN,
    KernelLibrary,
    find_library_path,
    find_linker,
)

_POINTERS = {"d": "d", "l": "i"}
"""Types of pointers by those of the arrays, float64 and int64."""


class ArrayKernel:
    """The fastest twin of a kernel that fills arrays and returns nothing.

    Its arguments are arrays of float64 or int64, NamedTuples of them, or None; what is None in the
    first call is so in all. The array that it fills is contiguous. For other arguments, and where a
    library can be neither loaded nor built, `compile_kernel`'s twin runs.
    """

    def __init__(self, kernel: Callable[..., None], substitution: Substitution | None) -> None:
        """Nothing is loaded before the first call."""
        self._kernel, self._substitution = kernel, substitution
        self._library: KernelLibrary | None = None
        self._is_loaded = False
        self._kinds: list[str] = []

    def __call__(self, *given: Any) -> None:
        """Run the kernel. Raises what plain Python would."""
        if not self._run_library(given):
            compile_kernel(self._kernel, self._substitution)(*given)

    def _run_library(self, given: tuple[Any, ...]) -> bool:
        """Run the library's kernel; return whether there is one for these, and it went through."""
        try:
            arrays = [*_list_arrays(given)]
        except NotFlat:
            return False
        kinds = [f"{array.dtype.char}{array.ndim}" for array in arrays]
        if not self._is_loaded:
            self._library, self._kinds, self._is_loaded = self._load(given), kinds, True
        if self._library is None or kinds != self._kinds:
            return False
        sizes = np.array([size for array in arrays for size in array.shape], dtype=np.int64)
        return self._library.run(*(array.ctypes.data for array in (sizes, *arrays)))

    def _load(self, example: tuple[Any, ...]) -> KernelLibrary | None:
        """Load the library, built first where that is missing; None if there cannot be one."""
        kernel, substitution = self._kernel, self._substitution
        source, names, pointers = write_array_glue(example)
        name = "_".join(part.__name__ for part in (kernel, *(substitution or ())[1:]))
        modules = (part.__module__ for part in (kernel, *(substitution or ())))
        path = find_library_path(f"arrays-{name}", source, hash_sources(*modules))
        try:
            if not path.exists():
                if os.environ.get(FORBIDDEN) or find_linker() is None:
                    return None
                progress.compiles_first = True
                path.parent.mkdir(parents=True, exist_ok=True)
                from pamctl.compiled_ahead.emit import CannotBuild, build_library

                with suppress(CannotBuild):
                    build_library(source, kernel, names, pointers, path, substitution)
            library = KernelLibrary(path)
            os.utime(path)  # those that nobody uses are removed
        except (OSError, AttributeError):
            return None
        return library


def _list_arrays(given: Any) -> Iterator[NDArray[Any]]:
    """List the arrays of nested tuples, which may hold None. Raises `NotFlat` for other parts."""
    for part in given:
        if isinstance(part, tuple):
            yield from _list_arrays(part)
        elif isinstance(part, np.ndarray) and part.dtype.char in _POINTERS:
            yield part if part.flags.c_contiguous else np.ascontiguousarray(part)
        elif part is not None:
            raise NotFlat(f"{type(part).__name__} is not an array of float64 or int64")


def write_array_glue(example: tuple[Any, ...]) -> tuple[str, dict[str, Any], str]:
    """Write the function of pointers that calls a kernel with arguments like these.

    Returns its source, the names that it uses, and the types of its pointers: first that to the
    sizes of all arrays, then one to each array.
    """
    types: dict[type, str] = {}
    pointers, sizes = ["i"], 0

    def write(part: Any) -> str:
        nonlocal sizes
        if part is None:
            return "None"
        if isinstance(part, tuple):
            name = types.setdefault(type(part), f"{type(part).__name__}_{len(types)}")
            return f"{name}({', '.join(map(write, part))})"
        pointers.append(_POINTERS[part.dtype.char])
        shape = ", ".join(f"sizes[{sizes + axis}]" for axis in range(part.ndim))
        sizes += part.ndim
        return f"carray(array_{len(pointers) - 1}, ({shape},))"

    call = ", ".join(map(write, example))
    names = ", ".join(f"array_{at}" for at in range(1, len(pointers)))
    source = f"def glue(sizes, {names}):\n    kernel({call})\n"
    scope = {name: kind for kind, name in types.items()}
    return source, scope, "".join(pointers)
