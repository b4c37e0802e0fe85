"""Where the numbers of a kernel's arguments lie in memory: every one fills a word of 8 bytes.

A NamedTuple is a struct of its fields, in order. A float is a double, an int or a bool a 64-bit
integer; None takes no place. A tuple of floats and an array are not copied: their words are an
address and a length. So the memory of a value is the same for Python's `struct` and for C.
"""

from __future__ import annotations

import ctypes
import struct
from array import array
from collections.abc import Callable, Iterator
from functools import cached_property
from itertools import count
from typing import Any, Generic, NamedTuple, TypeVar

T = TypeVar("T")

WORD_BYTES = 8
_CODES = {float: "d", int: "q", bool: "q"}
_ARRAYS = {("d", 1): "Numbers", ("d", 2): "Grid", ("l", 1): "Integers", ("q", 1): "Integers"}
"""Kinds of arrays by the code of their items and their number of axes."""


class NotKernelData(TypeError):
    """A value that no kernel can take. The message says where it is, and what is allowed."""


class Leaf(NamedTuple):
    """A number, or an array, within a value."""

    path: str
    """How to reach it from `v`: `v.safety.valve_v`."""
    kind: type | str
    """float, int or bool; or the kind of array, a value of `_ARRAYS`, or `Rows`."""


def find_kind(value: object, annotation: object = None) -> type | str | None:
    """Return the kind of a leaf; None for a NamedTuple and for None. Raise `NotKernelData`.

    A number has the type that its field states, if that is `float` or `int`.
    """
    if isinstance(value, bool | int | float):
        found = next(kind for kind in (bool, int, float) if isinstance(value, kind))
        return widen(found, annotation)
    if value is None or hasattr(value, "_fields"):
        return None
    if isinstance(value, Rows):
        return "Rows"
    if isinstance(value, tuple) and all(isinstance(part, float | int) for part in value):
        return "Numbers"
    dtype: Any = getattr(value, "dtype", None)
    key = (str(getattr(dtype, "char", "")), int(getattr(value, "ndim", 0)))
    if isinstance(value, array):
        key = (value.typecode, 1)
    is_word = getattr(value, "itemsize", 0) == WORD_BYTES and getattr(dtype, "isnative", True)
    if key in _ARRAYS and is_word:
        return _ARRAYS[key]
    raise NotKernelData(
        f"{type(value).__name__} is not a float, int, bool, NamedTuple, tuple of floats, or array "
        "of float64 or int64"
    )


def widen(found: type, annotation: object) -> type:
    """Return the type of a number in a field: the stated one, where that can hold it."""
    stated = _read_stated(annotation)
    if stated is float or (stated is int and found is bool):
        return stated
    return found


def _read_stated(annotation: object) -> type | None:
    text = getattr(annotation, "__forward_arg__", getattr(annotation, "__name__", annotation))
    return {"float": float, "int": int}.get(str(text))


def list_leaves(template: object, path: str = "v", annotation: object = None) -> Iterator[Leaf]:
    """List the leaves of a value in their order. Raise `NotKernelData`."""
    try:
        kind = find_kind(template, annotation)
    except NotKernelData as error:
        raise NotKernelData(f"{path}: {error}") from None
    if kind is not None:
        yield Leaf(path, kind)
    elif template is not None:
        for name, part, stated in list_fields(template):
            yield from list_leaves(part, f"{path}.{name}", stated)


def list_fields(value: Any) -> Iterator[tuple[str, Any, object]]:
    """List name, value and annotation of the fields of a NamedTuple."""
    stated = getattr(type(value), "__annotations__", {})
    for name, part in zip(value._fields, value, strict=True):
        yield name, part, stated.get(name)


_LENGTHS = {"Numbers": 1, "Integers": 1, "Grid": 2, "Rows": 2}
"""Words of an array after its address: its lengths, and the stride of rows."""


def find_array(value: Any, owners: list[object]) -> tuple[int, ...]:
    """Return the words of an array: where it lies, and its lengths.

    `owners` gets what keeps it there: a tuple is copied. Raise `NotKernelData`.
    """
    if isinstance(value, tuple):
        value = array("d", value)
    owners.append(value)
    if isinstance(value, Rows):
        return value.address, value.count, value.stride_bytes
    if isinstance(value, array):
        return value.buffer_info()
    flags, its = value.flags, value.__array_interface__
    if its["strides"] is not None or not flags.aligned:
        raise NotKernelData("an array whose numbers do not follow one another in memory, in words")
    return its["data"][0], *its["shape"]


def name_kind(value: Any) -> type | str | None:
    """Return the kind of an array; of a long tuple without a look at what it holds."""
    if type(value) is tuple:
        return "Numbers"
    dtype = getattr(value, "dtype", None)
    if dtype is None or not dtype.isnative or dtype.itemsize != WORD_BYTES:
        return find_kind(value)
    return _ARRAYS.get((dtype.char, value.ndim))


class Path:
    """How an expression reaches a part of `v`: what leads to several parts is looked up once."""

    _numbers = count()

    def __init__(self, name: str, above: Path | None = None, *, is_shared: bool = False) -> None:
        """Take a field's name, and the path to its tuple."""
        self._name, self._above, self._is_shared = name, above, is_shared
        self._variable = ""

    def enter(self, name: str, part: object) -> Path:
        """Return the path to a field."""
        return Path(name, self, is_shared=hasattr(part, "_fields"))

    def write(self) -> str:
        """Return the text, for the next place from left to right."""
        if self._above is None or self._variable:
            return self._variable or self._name
        text = f"{self._above.write()}.{self._name}"
        if not self._is_shared:
            return text
        self._variable = f"part_{next(self._numbers)}"
        return f"({self._variable} := {text})"


class Block(Generic[T]):
    """The place of values of one shape in a buffer of words."""

    def __init__(self, template: T, begin: int = 0, annotation: object = None) -> None:
        """Place values like `template` at the word `begin`. Raise `NotKernelData`."""
        self.template = template
        self.begin = begin
        self.leaves = tuple(list_leaves(template, "v", annotation))
        codes = (
            "q" * (1 + _LENGTHS[leaf.kind]) if isinstance(leaf.kind, str) else _CODES[leaf.kind]
            for leaf in self.leaves
        )
        self.struct = struct.Struct("".join(codes))
        self.end = begin + self.struct.size // WORD_BYTES
        self._offset = begin * WORD_BYTES
        self.has_arrays = any(isinstance(leaf.kind, str) for leaf in self.leaves)
        self._owners: list[object] = []

    def write(self, buffer: Any, value: T) -> None:
        """Put a value of the same shape into the buffer; its arrays stay where they are."""
        owners: list[object] = []
        self.struct.pack_into(buffer, self._offset, *self.flatten(value, owners))
        self._owners = owners

    def read(self, buffer: Any) -> T:
        """Return the value in the buffer; its arrays are those of the template."""
        return self._build(self.struct.unpack_from(buffer, self._offset))

    def find_part(self, path: str) -> Block[Any]:
        """Return the place of a part of the value, such as `safety.valve_v`; '' is the whole."""
        template: Any = self.template
        begin, annotation = self.begin, None
        for name in path.split(".") if path else ():
            for other, part, annotation in list_fields(template):
                if other == name:
                    break
                begin = Block(part, begin, annotation).end
            template = getattr(template, name)
        return Block(template, begin, annotation)

    # Made when they are needed: each takes a millisecond.

    @cached_property
    def flatten(self) -> Callable[[T, list[object]], tuple[Any, ...]]:
        """The function that lists the words of a value, and what keeps its arrays."""
        parts: list[str] = []

        def list_parts(part: Any, path: Path) -> None:
            if isinstance(find_kind(part), str):
                parts.append(f"*find_array({path.write()}, owners)")
            elif not hasattr(part, "_fields"):
                parts.extend([] if part is None else [path.write()])
            elif all(isinstance(its, bool | int | float) for its in part):
                parts.append(f"*{path.write()}")
            else:
                for name, its in zip(part._fields, part, strict=True):
                    list_parts(its, path.enter(name, its))

        list_parts(self.template, Path("v"))
        text = f"lambda v, owners: ({''.join(f'{part}, ' for part in parts)})"
        flatten: Callable[..., tuple[Any, ...]] = eval(text, {"find_array": find_array})
        return flatten

    @cached_property
    def fits(self) -> Callable[[object], bool]:
        """The function that tells whether a value has the template's types."""
        tests: list[str] = []
        types: dict[str, Any] = {}

        def test(part: Any, path: Path, stated: object = None) -> None:
            if part is None or hasattr(part, "_fields") or isinstance(part, Rows):
                name = f"Kind{len(types)}"
                types[name] = type(part)
                tests.append(f"type({path.write()}) is {name}")
            elif not isinstance(part, bool | int | float):
                types["name_kind"] = name_kind  # a tuple fits where an array does
                tests.append(f"name_kind({path.write()}) == {find_kind(part)!r}")
            elif _read_stated(stated) is not float:  # which holds every number
                kind = next(kind for kind in (bool, int, float) if isinstance(part, kind))
                tests.append(f"isinstance({path.write()}, {kind.__name__})")
            if hasattr(part, "_fields"):
                for name, its, of in list_fields(part):
                    test(its, path.enter(name, its), of)

        test(self.template, Path("v"))
        test_types: Callable[[object], bool] = eval(f"lambda v: {' and '.join(tests)}", types)
        return test_types

    @cached_property
    def _build(self) -> Callable[[tuple[Any, ...]], T]:
        """The function that builds a value of its words."""
        types: dict[type, str] = {}
        kept: list[Any] = []
        at = 0

        def build(part: Any, annotation: object = None) -> str:
            nonlocal at
            kind = find_kind(part, annotation)
            if isinstance(kind, str):
                at += 1 + _LENGTHS[kind]
                kept.append(part)
                return f"kept[{len(kept) - 1}]"
            if kind is not None:
                at += 1
                return f"w[{at - 1}] != 0" if kind is bool else f"w[{at - 1}]"
            if part is None:
                return "None"
            name = types.setdefault(type(part), f"Kind{len(types)}")
            return (
                f"{name}({', '.join(build(its, stated) for _, its, stated in list_fields(part))})"
            )

        text = f"lambda w: {build(self.template)}"
        names = {name: kind for kind, name in types.items()}
        make: Callable[[tuple[Any, ...]], T] = eval(text, {"kept": kept, **names})
        return make


class Rows(Generic[T]):
    """Many values of one shape, one after the other: a kernel and Python set them by number.

    `rows[k] = value` in a kernel is the same as here.
    """

    def __init__(self, template: T, count: int, stride_bytes: int | None = None) -> None:
        """Make room for `count` values like `template`. Raise `NotKernelData`."""
        self.block: Block[T] = Block(template)
        self.count = count
        self.stride_bytes = stride_bytes or self.block.struct.size
        self.buffer = bytearray(count * self.stride_bytes)
        self.address = ctypes.addressof(ctypes.c_char.from_buffer(self.buffer)) if count else 0

    def __len__(self) -> int:
        """Return the number of values."""
        return self.count

    def __setitem__(self, k: int, value: T) -> None:
        """Put a value; raise IndexError outside the rows."""
        if not 0 <= k < self.count:
            raise IndexError(f"row {k} of {self.count}")
        self.block.struct.pack_into(
            self.buffer, k * self.stride_bytes, *self.block.flatten(value, [])
        )

    def __getitem__(self, k: int) -> T:
        """Return a value."""
        view = memoryview(self.buffer)[k * self.stride_bytes :]
        return self.block.read(view)
