"""C source under construction: types, structs, constants and functions, each written once."""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pamctl.kernel.layout import NotKernelData, Rows, find_kind, list_fields, widen

Kernel = Callable[..., Any]


@dataclass(frozen=True, eq=False)
class CType:
    """A type: a number, an array, or a struct. Each type of a source exists once."""

    name: str
    fields: tuple[tuple[str, CType], ...] = ()
    python: type | None = None
    """The NamedTuple that a struct stands for; `tuple` for a tuple without names."""
    item: CType | None = None
    """What an array holds."""
    words: int = 1
    """What is none takes no place, in a struct or among arguments: None, and a NamedTuple of it."""

    def __getitem__(self, name: str) -> CType:
        return dict(self.fields)[name]

    @property
    def by_address(self) -> bool:
        """A function gets a large struct by its address: a copy would take longer than many do."""
        return self.words > LARGEST_COPY


LARGEST_COPY = 4
"""Words of the largest struct that is copied into a call."""

FLOAT, INT, BOOL = CType("double"), CType("long long"), CType("long long")
NONE = CType("void", words=0)
NUMBERS = CType("Numbers", item=FLOAT, words=2)
INTEGERS = CType("Integers", item=INT, words=2)
GRID = CType("Grid", item=FLOAT, words=3)
NUMBER_TYPES = (BOOL, INT, FLOAT)
"""In the order of promotion."""
_PYTHON = {bool: BOOL, int: INT, float: FLOAT}
_ARRAYS = {"Numbers": NUMBERS, "Integers": INTEGERS, "Grid": GRID}

PREAMBLE = (Path(__file__).parent / "preamble.h").read_text("utf-8")
C_WORDS = frozenset({
    "alignas", "alignof", "asm", "auto", "bool", "break", "case", "char", "const", "constexpr",
    "continue", "default", "do", "double", "else", "enum", "extern", "false", "float", "for",
    "goto", "if", "inline", "int", "long", "nullptr", "register", "restrict", "return", "short",
    "signed", "sizeof", "static", "struct", "switch", "true", "typedef", "typeof", "union",
    "unsigned", "void", "volatile", "while",
    "failed", "linux", "unix", "INFINITY", "NAN",
    *(name for name, its in vars(math).items() if callable(its)),
    *re.findall(r"static [\w ]*\b(\w+)\(", PREAMBLE.replace("*", " ")),
    *re.findall(r"(?:\} |#define )(\w+)", PREAMBLE),
})  # fmt: skip
"""Names that C, its library, its compilers, or the preamble use."""


# What operators and functions of Python are in C.

MATH = {
    getattr(math, name): f"checked_{name}({{0}})"
    for name in (
        "exp", "expm1", "log", "log2", "log10", "log1p", "sin", "cos", "tan", "asin", "acos",
        "atan", "sinh", "cosh", "tanh",
    )
} | {
    math.sqrt: "root({0})",
    math.fabs: "MAGNITUDE({0})",
    math.copysign: "copysign({0}, {1})",
    math.atan2: "atan2({0}, {1})",
    math.pow: "raised({0}, {1})",
    pow: "raised({0}, {1})",
}  # fmt: skip
TESTS = {math.isinf: "isinf", math.isnan: "isnan", math.isfinite: "isfinite"}
BUILTINS = {
    called.__name__: called for called in (abs, max, min, len, pow, round, float, int, bool)
}
FLOAT_OPERATORS = {
    ast.Add: "({0} + {1})", ast.Sub: "({0} - {1})", ast.Mult: "({0} * {1})",
    ast.Div: "divided({0}, {1})", ast.Mod: "remainder_of({0}, {1})",
    ast.FloorDiv: "floor_divided({0}, {1})", ast.Pow: "raised({0}, {1})",
}  # fmt: skip
INT_OPERATORS = {
    ast.Add: "added({0}, {1})", ast.Sub: "subtracted({0}, {1})", ast.Mult: "multiplied({0}, {1})",
    ast.Mod: "remainder_int({0}, {1})", ast.FloorDiv: "floor_divided_int({0}, {1})",
    ast.BitOr: "({0} | {1})", ast.BitAnd: "({0} & {1})", ast.BitXor: "({0} ^ {1})",
    ast.LShift: "shifted_left({0}, {1})", ast.RShift: "shifted_right({0}, {1})",
}  # fmt: skip
COMPARE = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
}  # fmt: skip


@dataclass
class CSource:
    """A source: `add_kernel` writes a kernel and all that it calls."""

    structs: list[str] = field(default_factory=list)
    constants: list[str] = field(default_factory=list)
    functions: list[str] = field(default_factory=list)
    filled: dict[str, list[int]] = field(default_factory=dict)
    """The arguments, by number, whose arrays a function changes."""
    under_way: list[Kernel] = field(default_factory=list)
    """The kernels that are being written: each calls the next one."""
    _types: dict[Any, CType] = field(default_factory=dict)
    _written: dict[Any, tuple[str, CType]] = field(default_factory=dict)
    _names: set[str] = field(default_factory=set)

    def text(self) -> str:
        """Return the whole source."""
        return "\n".join([PREAMBLE, *self.structs, *self.constants, "", *self.functions])

    def add_constant(self, name: str, value: Any) -> CType:
        """Write a value (a NamedTuple, or a number) as a constant; return its type."""
        kind = self.type_of(value)
        text = self.write_value(value, kind)
        self.constants.append(f"static const {kind.name} {name} = {text};")
        return kind

    def add_kernel(self, kernel: Kernel, types: Sequence[CType]) -> tuple[str, CType]:
        """Write a kernel for these types of arguments; return the function's name and type.

        Raise `NotInC`.
        """
        from pamctl.kernel.translate import FunctionWriter

        key = (kernel, tuple(types))
        if key not in self._written:
            name = self._make_name(kernel.__name__.strip("_"))
            writer = FunctionWriter(self, kernel, types)
            self.under_way.append(kernel)
            text, result = writer.write(name)
            self.under_way.pop()
            self.functions.append(text)
            self.filled[name] = writer.list_filled()
            self._written[key] = name, result
        return self._written[key]

    def type_of(self, value: Any, annotation: object = None) -> CType:
        """Return the type of a Python value. Raise `NotKernelData`."""
        kind = find_kind(value, annotation)
        if isinstance(value, Rows):
            item = self.type_of(value.block.template)
            return self._types.setdefault(("Rows", item), CType("Rows", item=item, words=3))
        if kind is None:
            if value is None:
                return NONE
            parts = [self.type_of(part, stated) for _, part, stated in list_fields(value)]
            return self.struct_of(type(value), parts)
        return _ARRAYS[kind] if isinstance(kind, str) else _PYTHON[kind]

    def struct_of(self, kind: Any, types: Sequence[CType]) -> CType:
        """Return the struct of a NamedTuple with fields of these types.

        A number has the type that its field states, where that can hold it.
        """
        stated = getattr(kind, "__annotations__", {})
        settled = tuple(
            _PYTHON[widen(_as_python(its), stated.get(name))] if its in NUMBER_TYPES else its
            for name, its in zip(kind._fields, types, strict=True)
        )
        return self._add_struct(kind, kind.__name__, tuple(zip(kind._fields, settled, strict=True)))

    def tuple_of(self, types: Sequence[CType]) -> CType:
        """Return the struct of an unnamed tuple."""
        fields = tuple((f"item_{index}", its) for index, its in enumerate(types))
        return self._add_struct(tuple, "Tuple", fields)

    def _add_struct(self, kind: type, name: str, fields: tuple[tuple[str, CType], ...]) -> CType:
        key = (kind, tuple(its for _, its in fields))
        if key not in self._types:
            words = sum(its.words for _, its in fields)
            name = name.strip("_")
            name = self._make_name(name[:1].upper() + name[1:], "")
            made = CType(name, fields, kind, words=words)
            lines = [f"    {its.name} {c_name(of)};" for of, its in fields if its.words]
            inner = "\n".join(lines or ["    char nothing;"])
            self.structs.append(f"typedef struct {{\n{inner}\n}} {made.name};")
            self._types[key] = made
        return self._types[key]

    def write_value(self, value: Any, kind: CType) -> str:
        """Write a value as an initialiser."""
        if kind is NUMBERS and isinstance(value, tuple):
            name = self._make_name("values")
            numbers = ", ".join(_write_float(float(number)) for number in value) or "0"
            self.constants.append(f"static double {name}[] = {{{numbers}}};")
            return f"{{{name}, {len(value)}}}"
        if kind in NUMBER_TYPES:
            if kind is not FLOAT and abs(value) >= 2**63:
                raise NotKernelData("an int of more than 64 bits")
            return _write_float(float(value)) if kind is FLOAT else str(int(value))
        if kind.item is not None:
            raise NotKernelData("an array is no constant: give it as an argument, or as a tuple")
        parts = [
            f".{c_name(name)} = {self.write_value(part, its)}"
            for (name, its), part in zip(kind.fields, value, strict=True)
            if its.words
        ]
        return f"{{{', '.join(parts) or '0'}}}"

    def _make_name(self, wanted: str, prefix: str = "pam_") -> str:
        name, count = prefix + wanted, 1
        while name in self._names or name in C_WORDS:
            count += 1
            name = f"{prefix}{wanted}_{count}"
        self._names.add(name)
        return name


def write_call(function: str, given: Mapping[str, CType]) -> str:
    """Write the call of a kernel's function with these places, by their texts."""
    texts = (f"{'&' if its.by_address else ''}{at}" for at, its in given.items() if its.words)
    return f"{function}({', '.join(texts)})"


def _as_python(its: CType) -> type:
    return next(python for python, known in _PYTHON.items() if known is its)


def _write_float(value: float) -> str:
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0.0 else "(-INFINITY)"
    return repr(value)


def c_name(name: str) -> str:
    """Return the name in C of a variable, or of a field.

    It differs from all that C uses itself, and from what the translation makes: functions begin
    with `pam_`, structs with a capital, and its own variables, as `row_`, end with one underscore.
    """
    is_free = name[0].islower() and not name.startswith("pam_") and not name.endswith("_")
    return name if is_free and name not in C_WORDS else f"{name}_"
