"""A plant's numbers as one array, for the call of compiled code.

Python hands a tuple to machine code number by number: with a plant's hundred, a short drive takes
longer to call than to run. A `Packing` writes nested tuples of floats and truth values into an
array, and has the kernel that builds them again, which costs nothing once it is compiled.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Packing(NamedTuple):
    """Two functions made for tuples of one type."""

    list_leaves: Callable[[Any], tuple[float, ...]]
    """Returns the leaves of a nested tuple, in order."""
    unpack: Callable[..., Any]
    """Kernel; returns the nested tuple of an array of its leaves."""

    def pack(self, numbers: Any) -> Array:
        """Return the leaves of a nested tuple, shape (leaves,)."""
        return np.array(self.list_leaves(numbers), dtype=np.float64)


def make_packing(name: str, example: Any, apart: type | None = None) -> Packing:
    """Make the packing of tuples like `example`; `name` is that of the kernel.

    Leaves are floats, or truth values where the example has them. A part that is None in the
    example stays None. A part of the type `apart` is not packed: it is the kernel's second
    argument.
    """
    types: dict[str, type] = {}
    taken: list[str] = []

    def write(part: Any, path: str) -> str:
        if apart is not None and isinstance(part, apart):
            return "apart"
        if part is None:
            return "None"
        if isinstance(part, tuple):
            kind = "" if type(part) is tuple else f"Kind{len(types)}"
            types[kind] = type(part)
            inner = [write(p, f"{path}[{i}]") for i, p in enumerate(part)]
            return f"{kind}({', '.join(inner)})"
        taken.append(path)
        leaf = f"packed[{len(taken) - 1}]"
        return f"{leaf} != 0.0" if isinstance(part, bool) else leaf

    built = write(example, "numbers")
    arguments = "packed" if apart is None else "packed, apart"
    source = (
        f"def {name}({arguments}):\n    return {built}\n"
        f"def list_leaves(numbers):\n    return ({', '.join(taken)},)"
    )
    scope: dict[str, Any] = {"__name__": __name__, **types}
    # The cache of machine code needs a file that exists.
    exec(compile(source, __file__, "exec"), scope)
    return Packing(scope["list_leaves"], scope[name])
