"""A plant's numbers as one array, for the call of compiled code.

Python hands a tuple to machine code number by number: with a plant's hundred, a short drive takes
longer to call than to run. `pack` writes nested tuples of floats and truth values into an array.
`make_unpacker` makes the kernel that builds them again, which costs nothing once it is compiled.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def pack(numbers: Any) -> Array:
    """Return the leaves of a nested tuple, in order, shape (leaves,)."""
    return np.array([*_list_leaves(numbers)], dtype=np.float64)


def _list_leaves(numbers: Any) -> Iterator[float]:
    for number in numbers:
        if isinstance(number, tuple):
            yield from _list_leaves(number)
        else:
            yield number


def make_unpacker(name: str, example: Any, apart: type | None = None) -> Callable[..., Any]:
    """Make a kernel that returns a tuple like `example` from its packed array.

    Leaves are floats, or truth values where the example has them. A part of the type `apart` is
    not packed: it is the kernel's second argument.
    """
    types: dict[str, type] = {}
    place = 0

    def write(part: Any) -> str:
        nonlocal place
        if apart is not None and isinstance(part, apart):
            return "apart"
        if isinstance(part, tuple):
            kind = f"Kind{len(types)}"
            types[kind] = type(part)
            return f"{kind}({', '.join(map(write, part))})"
        place += 1
        leaf = f"packed[{place - 1}]"
        return f"{leaf} != 0.0" if isinstance(part, bool) else leaf

    arguments = "packed" if apart is None else "packed, apart"
    source = f"def {name}({arguments}):\n    return {write(example)}"
    scope: dict[str, Any] = {"__name__": __name__, **types}
    # The cache of machine code needs a file that exists.
    exec(compile(source, __file__, "exec"), scope)
    kernel: Callable[..., Any] = scope[name]
    return kernel
