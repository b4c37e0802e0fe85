"""Where the numbers of nested NamedTuples lie in a buffer of 8-byte words.

Machine code knows no NamedTuples. Floats are kept as doubles, ints and bools as 64-bit ints.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from typing import Any, Generic, NamedTuple, TypeVar

T = TypeVar("T")

WORD_BYTES = 8
LONGEST_TABLE = 64
"""Numbers of a plain tuple; machine code would copy a longer one in every call."""
_CODES = {float: "d", int: "q", bool: "q"}


class NotFlat(TypeError):
    """A value that is not made of NamedTuples and short tuples of float, int and bool."""


class Leaf(NamedTuple):
    """One number."""

    path: str
    """How to reach it: `safety.valve_v`; empty for a number that stands alone."""
    kind: type
    """float, int or bool."""


def list_leaves(template: object, path: str = "") -> Iterator[Leaf]:
    """List the numbers of a value in order; None is no number. Raises `NotFlat`."""
    if template is None:
        return
    if isinstance(template, tuple) and hasattr(template, "_fields"):
        for name, part in zip(template._fields, template, strict=True):
            yield from list_leaves(part, f"{path}.{name}" if path else name)
        return
    if isinstance(template, tuple) and 0 < len(template) <= LONGEST_TABLE:
        for at, part in enumerate(template):
            yield from list_leaves(part, f"{path}[{at}]")
        return
    kind = next((kind for kind in (bool, int, float) if isinstance(template, kind)), None)
    if kind is None:
        raise NotFlat(f"{path}: {type(template).__name__} is not a float, int or bool")
    yield Leaf(path, kind)


def write_constructor(
    template: object, write_leaf: Callable[[int, type], str], types: dict[type, str], begin: int = 0
) -> str:
    """Return the expression that builds a value like `template` from its words.

    `write_leaf` gives the expression of the word at an index. `types` collects the NamedTuple
    types that the expression names, with their names.
    """
    counted = iter(range(begin, 1 << 30))

    def write(part: Any) -> str:
        if part is None:
            return "None"
        if not isinstance(part, tuple):
            return write_leaf(next(counted), next(list_leaves(part)).kind)
        if type(part) is tuple:
            return f"({', '.join(map(write, part))},)"
        name = types.setdefault(type(part), f"{type(part).__name__}_{len(types)}")
        return f"{name}({', '.join(map(write, part))})"

    return write(template)


class Block(Generic[T]):
    """The place of one value in a buffer."""

    def __init__(self, template: T, begin: int) -> None:
        """Place a value like `template` at the word `begin`. Raises `NotFlat`."""
        self.template = template
        self.begin = begin
        self.leaves = tuple(list_leaves(template))
        self.end = begin + len(self.leaves)
        self._offset = begin * WORD_BYTES
        self._struct = struct.Struct("<" + "".join(_CODES[leaf.kind] for leaf in self.leaves))
        types: dict[type, str] = {}
        # numbers of a bool's word are 0 or 1
        built = write_constructor(
            template, lambda at, kind: f"w[{at}] != 0" if kind is bool else f"w[{at}]", types
        )
        names = {name: kind for kind, name in types.items()}
        self._build: Callable[[tuple[Any, ...]], T] = eval(f"lambda w: {built}", names)
        # `v.path`, or `v` and `v[0]` of a value that is no NamedTuple
        parts = ", ".join(f"v.{leaf.path}".replace(".[", "[").rstrip(".") for leaf in self.leaves)
        self._flatten: Callable[[T], tuple[Any, ...]] = eval(f"lambda v: ({parts},)")

    def write(self, buffer: Any, value: T) -> None:
        """Put a value of the same shape into the buffer."""
        self._struct.pack_into(buffer, self._offset, *self._flatten(value))

    def read_numbers(self, buffer: Any) -> tuple[float, ...]:
        """Return the numbers of the value in the buffer, in their order."""
        return self._struct.unpack_from(buffer, self._offset)

    def read(self, buffer: Any) -> T:
        """Return the value in the buffer."""
        return self._build(self._struct.unpack_from(buffer, self._offset))


def construct(block: Block[Any], types: dict[type, str]) -> str:
    """Write the expression that makes a block's value of its words."""
    return write_constructor(block.template, _read_word, types, block.begin)


def _read_word(at: int, kind: type) -> str:
    if kind is float:
        return f"floats[{at}]"
    return f"ints[{at}] != 0" if kind is bool else f"ints[{at}]"


def store(block: Block[Any], prefix: str) -> list[str]:
    """Write the lines that put the numbers of `prefix` into a block's words."""
    return [
        f"floats[{at}] = {prefix}{leaf.path}"
        if leaf.kind is float
        else f"ints[{at}] = int({prefix}{leaf.path})"
        for at, leaf in enumerate(block.leaves, block.begin)
    ]
