"""Write kernels as C: the same functions, in the same order, for a compiler without Python.

`pamctl.compiled` says what a kernel may be. Here each kernel becomes one C function for the types
of its arguments, each NamedTuple a struct, each tuple that a kernel returns a small struct.
"""

from __future__ import annotations

import ast
import inspect
import math
import textwrap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from types import BuiltinFunctionType, FunctionType
from typing import Any

from pamctl.exit_codes import ExitCode

Kernel = Callable[..., Any]


class NotInC(Exception):
    """A kernel uses something that this translation does not know. The message says what."""

    exit_code = ExitCode.UNEXPECTED


@dataclass(frozen=True)
class CType:
    """A type: a number, or a struct of numbers and structs."""

    name: str
    fields: tuple[tuple[str, CType], ...] = ()
    is_tuple: bool = False
    """An unnamed tuple: its fields have no names in Python."""

    def __getitem__(self, name: str) -> CType:
        return dict(self.fields)[name]


FLOAT, INT, BOOL, NONE = CType("double"), CType("long long"), CType("int"), CType("void")
ARRAY = CType("Numbers")
"""A tuple of any number of floats, or an array."""
_NUMBERS = (BOOL, INT, FLOAT)
"""In the order of promotion."""

PREAMBLE = """\
#include <math.h>
#include <stdlib.h>

typedef struct { const double *at; long long length; } Numbers;

/* Python's own: the first argument wins unless the second is truly larger, or smaller. */
static double larger(double a, double b) { return b > a ? b : a; }
static double smaller(double a, double b) { return b < a ? b : a; }
"""
_MATH = {
    **{getattr(math, name): name for name in (
        "exp", "expm1", "log", "log1p", "sqrt", "sin", "cos", "tan", "asin", "acos", "atan",
        "atan2", "sinh", "cosh", "tanh", "pow", "hypot", "copysign", "fabs",
    )},
    pow: "pow",
}  # fmt: skip
_TESTS = {math.isinf: "isinf", math.isnan: "isnan", math.isfinite: "isfinite"}
_BUILTINS: dict[str, Any] = {
    called.__name__: called for called in (abs, max, min, len, pow, float, int)
}
_BINARY = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
_COMPARE = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
}  # fmt: skip
_C_WORDS = frozenset({
    "auto", "break", "case", "char", "const", "continue", "default", "do", "double", "else", "enum",
    "extern", "float", "for", "goto", "if", "inline", "int", "long", "register", "restrict",
    "return", "short", "signed", "sizeof", "static", "struct", "switch", "typedef", "union",
    "unsigned", "void", "volatile", "while", "Numbers", "larger", "smaller",
})  # fmt: skip


@dataclass
class CSource:
    """C source under construction: structs, constants and functions, each written once."""

    structs: list[str] = field(default_factory=list)
    constants: list[str] = field(default_factory=list)
    functions: list[str] = field(default_factory=list)
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
        """Write a kernel for these types of arguments; return the function's name and type."""
        key = (kernel, tuple(types))
        if key not in self._written:
            name = self._make_name(kernel.__name__.lstrip("_"))
            text, result = _FunctionWriter(self, kernel, types).write(name)
            self.functions.append(text)
            self._written[key] = name, result
        return self._written[key]

    def type_of(self, value: Any) -> CType:
        """Return the type of a Python value."""
        if value is None:
            return NONE
        for kind, its in ((bool, BOOL), (int, INT), (float, FLOAT)):
            if isinstance(value, kind):
                return its
        if hasattr(value, "_fields"):
            return self.struct_of(type(value), [self.type_of(part) for part in value])
        if isinstance(value, tuple):
            return ARRAY
        raise NotInC(f"a value of the type {type(value).__name__} has no counterpart in C")

    def struct_of(self, kind: Any, types: Sequence[CType]) -> CType:
        """Return the struct of a NamedTuple; its first use settles the types of its fields."""
        if kind not in self._types:
            stated = getattr(kind, "__annotations__", {})
            settled = [
                FLOAT if its is INT and str(stated.get(name)) == "float" else its
                for name, its in zip(kind._fields, types, strict=True)
            ]
            made = CType(
                self._make_name(kind.__name__, ""), tuple(zip(kind._fields, settled, strict=True))
            )
            self._write_struct(made)
            self._types[kind] = made
        return self._types[kind]

    def tuple_of(self, types: Sequence[CType]) -> CType:
        """Return the struct of an unnamed tuple."""
        key = tuple(types)
        if key not in self._types:
            fields = tuple((f"item_{index}", its) for index, its in enumerate(types))
            made = CType(self._make_name(f"Tuple{len(self._types)}", ""), fields, is_tuple=True)
            self._write_struct(made)
            self._types[key] = made
        return self._types[key]

    def write_value(self, value: Any, kind: CType) -> str:
        """Write a value as an initialiser."""
        if kind is ARRAY:
            name = self._make_name("values")
            numbers = ", ".join(_write_float(float(number)) for number in value)
            self.constants.append(f"static const double {name}[] = {{{numbers}}};")
            return f"{{{name}, {len(value)}}}"
        if kind in _NUMBERS:
            return _write_float(float(value)) if kind is FLOAT else str(int(value))
        parts = [
            f".{_c_name(name)} = {self.write_value(part, its)}"
            for (name, its), part in zip(kind.fields, value, strict=True)
            if its is not NONE
        ]
        return f"{{{', '.join(parts) or '0'}}}"

    def _write_struct(self, made: CType) -> None:
        lines = [f"    {its.name} {_c_name(name)};" for name, its in made.fields if its is not NONE]
        inner = "\n".join(lines or ["    char nothing;"])
        self.structs.append(f"typedef struct {{\n{inner}\n}} {made.name};")

    def _make_name(self, wanted: str, prefix: str = "pam_") -> str:
        name, count = prefix + wanted, 1
        while name in self._names or name in _C_WORDS:
            count += 1
            name = f"{prefix}{wanted}_{count}"
        self._names.add(name)
        return name


class _FunctionWriter:
    """Writes one function. It goes over the body until the types of all variables are settled."""

    def __init__(self, source: CSource, kernel: Kernel, types: Sequence[CType]) -> None:
        self._source, self._kernel = source, kernel
        self._definition = _parse_kernel(kernel)
        names = [argument.arg for argument in self._definition.args.args]
        self._arguments = dict(zip(names, types, strict=True))
        self._locals: dict[str, CType] = {}
        self._result: CType | None = None
        self._lines: list[str] = []

    def write(self, name: str) -> tuple[str, CType]:
        settled = None
        while settled != (settled := (dict(self._locals), self._result)) or not self._lines:
            self._lines = []
            self._write_block(self._definition.body, "    ")
        result = self._result or NONE
        given = ", ".join(
            f"{its.name} {_c_name(argument)}"
            for argument, its in self._arguments.items()
            if its is not NONE
        )
        declared = [
            f"    {its.name} {_c_name(local)};"
            for local, its in self._locals.items()
            if local not in self._arguments and its is not NONE
        ]
        head = f"static {result.name} {name}({given or 'void'}) {{"
        return "\n".join([head, *declared, *self._lines, "}\n"]), result

    # Statements.

    def _write_block(self, body: Iterable[ast.stmt], indent: str) -> bool:
        """Write statements; return whether the block surely returns."""
        for statement in body:
            write = getattr(self, f"_write_{type(statement).__name__.lower()}", None)
            if write is None:
                raise self._refuse(statement)
            if write(statement, indent):
                return True
        return False

    def _write_expr(self, node: ast.Expr, indent: str) -> bool:
        if not isinstance(node.value, ast.Constant):  # a docstring
            self._lines.append(f"{indent}(void){self._read(node.value)[0]};")
        return False

    def _write_return(self, node: ast.Return, indent: str) -> bool:
        if node.value is None:
            raise self._refuse(node)
        text, its = self._read(node.value)
        self._result = self._join(self._result, its, node)
        if its.is_tuple and its != self._result and isinstance(node.value, ast.Tuple):
            text = self._make_tuple(node.value, self._result)
        self._lines.append(f"{indent}return;" if its is NONE else f"{indent}return {text};")
        return True

    def _write_assign(self, node: ast.Assign, indent: str) -> bool:
        for target in node.targets:
            self._assign(target, node.value, indent)
        return False

    def _write_annassign(self, node: ast.AnnAssign, indent: str) -> bool:
        if node.value is None:
            raise self._refuse(node)
        self._assign(node.target, node.value, indent)
        return False

    def _write_augassign(self, node: ast.AugAssign, indent: str) -> bool:
        whole = ast.BinOp(_load(node.target), node.op, node.value)
        self._assign(node.target, ast.copy_location(whole, node), indent)
        return False

    def _assign(self, target: ast.expr, value: ast.expr, indent: str) -> None:
        if isinstance(target, ast.Name):
            text, its = self._read(value)
            self._settle(target, its)
            into = "" if its is NONE else f"{_c_name(target.id)} = "
            if into or isinstance(value, ast.Call):
                self._lines.append(f"{indent}{into}{text};")
            return
        if not isinstance(target, ast.Tuple):
            raise self._refuse(target)
        text, its = self._read(value)
        if len(its.fields) != len(target.elts):
            raise self._refuse(target)
        self._lines.append(f"{indent}{{ const {its.name} all = {text};")
        for part, (name, kind) in zip(target.elts, its.fields, strict=True):
            if not isinstance(part, ast.Name):
                raise self._refuse(part)
            if part.id != "_":
                self._settle(part, kind)
                self._lines.append(f"{indent}  {_c_name(part.id)} = all.{_c_name(name)};")
        self._lines.append(f"{indent}}}")

    def _settle(self, target: ast.Name, its: CType) -> None:
        if (argument := self._arguments.get(target.id)) is not None:
            # An argument that is given another type of number keeps the wider one.
            self._arguments[target.id] = self._join(argument, its, target)
        else:
            self._locals[target.id] = self._join(self._locals.get(target.id), its, target)

    def _write_if(self, node: ast.If, indent: str) -> bool:
        known = self._decide(node.test)
        if known is not None:
            return self._write_block(node.body if known else node.orelse, indent)
        self._lines.append(f"{indent}if ({self._read(node.test)[0]}) {{")
        ends = self._write_block(node.body, indent + "    ")
        if node.orelse:
            self._lines.append(f"{indent}}} else {{")
            ends = self._write_block(node.orelse, indent + "    ") and ends
        self._lines.append(f"{indent}}}")
        return ends and bool(node.orelse)

    def _write_while(self, node: ast.While, indent: str) -> bool:
        if node.orelse:
            raise self._refuse(node)
        self._lines.append(f"{indent}while ({self._read(node.test)[0]}) {{")
        self._write_block(node.body, indent + "    ")
        self._lines.append(f"{indent}}}")
        return False

    def _write_for(self, node: ast.For, indent: str) -> bool:
        call = node.iter
        if (
            not isinstance(call, ast.Call)
            or ast.unparse(call.func) != "range"
            or not isinstance(node.target, ast.Name)
            or not 1 <= len(call.args) <= 2
            or node.orelse
        ):
            raise self._refuse(node)
        limits = [self._read(limit)[0] for limit in call.args]
        first = limits[0] if len(limits) == 2 else "0"
        counter = f"count_{len(indent)}"
        self._lines.append(
            f"{indent}for (long long {counter} = {first}, end = {limits[-1]}; "
            f"{counter} < end; {counter}++) {{"
        )
        if node.target.id != "_":
            self._settle(node.target, INT)
            self._lines.append(f"{indent}    {_c_name(node.target.id)} = {counter};")
        self._write_block(node.body, indent + "    ")
        self._lines.append(f"{indent}}}")
        return False

    def _write_break(self, node: ast.Break, indent: str) -> bool:
        self._lines.append(f"{indent}break;")
        return True

    def _write_continue(self, node: ast.Continue, indent: str) -> bool:
        self._lines.append(f"{indent}continue;")
        return True

    def _write_pass(self, node: ast.Pass, indent: str) -> bool:
        return False

    # Expressions: each returns its text and its type.

    def _read(self, node: ast.expr) -> tuple[str, CType]:
        read: Any = getattr(self, f"_read_{type(node).__name__.lower()}", None)
        if read is None:
            raise self._refuse(node)
        pair: tuple[str, CType] = read(node)
        return pair

    def _read_constant(self, node: ast.Constant) -> tuple[str, CType]:
        return self._read_value(node.value)

    def _read_value(self, value: Any) -> tuple[str, CType]:
        its = self._source.type_of(value)
        if its in (*_NUMBERS, NONE):
            return ("" if its is NONE else self._source.write_value(value, its)), its
        return f"(({its.name}){self._source.write_value(value, its)})", its

    def _read_name(self, node: ast.Name) -> tuple[str, CType]:
        known = {**self._locals, **self._arguments}
        if node.id in known:
            return _c_name(node.id), known[node.id]
        scope = self._kernel.__globals__
        if node.id not in scope:
            raise self._refuse(node)
        return self._read_value(scope[node.id])

    def _read_attribute(self, node: ast.Attribute) -> tuple[str, CType]:
        if isinstance(node.value, ast.Name) and self._find(node.value) is math:
            return self._read_value(getattr(math, node.attr))
        text, its = self._read(node.value)
        if node.attr not in dict(its.fields):
            raise self._refuse(node)
        return f"{text}.{_c_name(node.attr)}", its[node.attr]

    def _read_subscript(self, node: ast.Subscript) -> tuple[str, CType]:
        text, its = self._read(node.value)
        index, kind = self._read(node.slice)
        if its is not ARRAY or kind is not INT:
            raise self._refuse(node)
        return f"{text}.at[{index}]", FLOAT

    def _read_tuple(self, node: ast.Tuple) -> tuple[str, CType]:
        its = self._source.tuple_of([self._read(part)[1] for part in node.elts])
        return self._make_tuple(node, its), its

    def _make_tuple(self, node: ast.Tuple, its: CType) -> str:
        parts = [self._read(part)[0] for part in node.elts]
        return f"(({its.name}){{{', '.join(parts)}}})"

    def _read_binop(self, node: ast.BinOp) -> tuple[str, CType]:
        (left, one), (right, other) = self._read(node.left), self._read(node.right)
        if one not in _NUMBERS or other not in _NUMBERS:
            raise self._refuse(node)
        if isinstance(node.op, ast.Pow):
            return f"pow({left}, {right})", FLOAT
        if type(node.op) not in _BINARY:
            raise self._refuse(node)
        its = FLOAT if isinstance(node.op, ast.Div) else self._join(self._join(INT, one), other)
        left = f"(double){left}" if isinstance(node.op, ast.Div) and one is not FLOAT else left
        return f"({left} {_BINARY[type(node.op)]} {right})", its

    def _read_unaryop(self, node: ast.UnaryOp) -> tuple[str, CType]:
        text, its = self._read(node.operand)
        sign = {ast.USub: "-", ast.UAdd: "+", ast.Not: "!"}.get(type(node.op))
        if sign is None or its not in _NUMBERS:
            raise self._refuse(node)
        return f"({sign}{text})", BOOL if sign == "!" else self._join(INT, its)

    def _read_boolop(self, node: ast.BoolOp) -> tuple[str, CType]:
        parts = [self._read(part) for part in node.values]
        if any(its is not BOOL for _, its in parts):
            raise self._refuse(node)
        sign = " && " if isinstance(node.op, ast.And) else " || "
        return f"({sign.join(text for text, _ in parts)})", BOOL

    def _read_compare(self, node: ast.Compare) -> tuple[str, CType]:
        known = self._decide(node)
        if known is not None:
            return str(int(known)), BOOL
        terms = [self._read(term) for term in (node.left, *node.comparators)]
        if any(its not in _NUMBERS for _, its in terms):
            raise self._refuse(node)
        tests = []
        for (left, _), sign, (right, _) in zip(terms, node.ops, terms[1:], strict=False):
            if type(sign) not in _COMPARE:
                raise self._refuse(node)
            tests.append(f"{left} {_COMPARE[type(sign)]} {right}")
        return f"({' && '.join(tests)})", BOOL

    def _read_ifexp(self, node: ast.IfExp) -> tuple[str, CType]:
        known = self._decide(node.test)
        if known is not None:
            return self._read(node.body if known else node.orelse)
        (one, its), (other, kind) = self._read(node.body), self._read(node.orelse)
        return f"({self._read(node.test)[0]} ? {one} : {other})", self._join(its, kind, node)

    def _read_call(self, node: ast.Call) -> tuple[str, CType]:
        called = self._find(node.func)
        if isinstance(called, FunctionType):
            given = self._order_arguments(node, list(inspect.signature(called).parameters), called)
            name, its = self._source.add_kernel(called, [kind for _, kind in given])
            return f"{name}({_join_texts(given)})", its
        if isinstance(called, type) and hasattr(called, "_fields"):
            fields: Any = called
            given = self._order_arguments(node, list(fields._fields), called)
            its = self._source.struct_of(called, [kind for _, kind in given])
            return f"(({its.name}){{{_join_texts(given) or '0'}}})", its
        if node.keywords or not isinstance(called, (BuiltinFunctionType, type)):
            raise self._refuse(node)
        return self._read_builtin(node, called, [self._read(argument) for argument in node.args])

    def _read_builtin(
        self, node: ast.Call, called: Any, given: list[tuple[str, CType]]
    ) -> tuple[str, CType]:
        texts, kinds = [text for text, _ in given], [its for _, its in given]
        inner = ", ".join(texts)
        if called is len and kinds == [ARRAY]:
            return f"{inner}.length", INT
        if any(its not in _NUMBERS for its in kinds):
            raise self._refuse(node)
        if called in _MATH:
            return f"{_MATH[called]}({inner})", FLOAT
        if called in _TESTS:
            return f"({_TESTS[called]}({inner}) != 0)", BOOL
        if called in (max, min) and len(given) > 1:
            name, text, its = ("larger" if called is max else "smaller"), texts[0], kinds[0]
            for other, kind in zip(texts[1:], kinds[1:], strict=True):
                text, its = f"{name}({text}, {other})", self._join(its, kind, node)
            return (text if its is FLOAT else f"({its.name}){text}"), its
        if called is abs:
            return (f"fabs({inner})", FLOAT) if kinds == [FLOAT] else (f"llabs({inner})", INT)
        if called in (math.ceil, math.floor):
            return f"(long long){called.__name__}({inner})", INT
        if called in (float, int):
            its = FLOAT if called is float else INT
            return f"({its.name})({inner})", its
        raise self._refuse(node)

    def _order_arguments(
        self, node: ast.Call, names: list[str], called: Any
    ) -> list[tuple[str, CType]]:
        """Return all arguments of a call in their order, with the defaults of those left out."""
        given = dict(zip(names, (self._read(part) for part in node.args), strict=False))
        given |= {str(word.arg): self._read(word.value) for word in node.keywords}
        if isinstance(called, FunctionType):
            values = called.__defaults__ or ()
            defaults = dict(zip(names[len(names) - len(values) :], values, strict=True))
        else:
            defaults = called._field_defaults
        missing = [name for name in names if name not in given and name not in defaults]
        if missing or not given.keys() <= {*names}:
            raise self._refuse(node)
        return [
            given[name] if name in given else self._read_value(defaults[name]) for name in names
        ]

    # Helpers.

    def _find(self, node: ast.expr) -> Any:
        """Return the Python object that a name, or a name of `math`, stands for."""
        if isinstance(node, ast.Name) and node.id not in {**self._arguments, **self._locals}:
            return self._kernel.__globals__.get(node.id, _BUILTINS.get(node.id))
        if isinstance(node, ast.Attribute):
            return getattr(self._find(node.value), node.attr, None)
        return None

    def _decide(self, test: ast.expr) -> bool | None:
        """Return the outcome of `... is None`, which the types decide; None for another test."""
        if isinstance(test, ast.BoolOp):
            ends = isinstance(test.op, ast.Or)  # the value that decides the whole
            parts = [self._decide(part) for part in test.values]
            return ends if ends in parts else None if None in parts else not ends
        if (
            isinstance(test, ast.Compare)
            and len(test.ops) == 1
            and isinstance(test.ops[0], (ast.Is, ast.IsNot))
            and ast.unparse(test.comparators[0]) == "None"
        ):
            return (self._read(test.left)[1] is NONE) == isinstance(test.ops[0], ast.Is)
        return None

    def _join(self, one: CType | None, other: CType, node: ast.AST | None = None) -> CType:
        """Return the type that holds both: the wider number."""
        if one is None or one == other:
            return other
        if one in _NUMBERS and other in _NUMBERS:
            return max(one, other, key=_NUMBERS.index)
        if one.is_tuple and other.is_tuple and len(one.fields) == len(other.fields):
            pairs = zip(one.fields, other.fields, strict=True)
            return self._source.tuple_of([self._join(a, b, node) for (_, a), (_, b) in pairs])
        raise self._refuse(node or self._definition)

    def _refuse(self, node: ast.AST) -> NotInC:
        return NotInC(
            f"{self._kernel.__module__}.{self._kernel.__qualname__}: `{ast.unparse(node)}` cannot "
            "be written as C; a kernel for an FMU uses floats, ints, bools, NamedTuples and math"
        )


def _parse_kernel(kernel: Kernel) -> ast.FunctionDef:
    # Composed kernels (`pamctl.plant.chains`) bring the source that they were made of.
    source = kernel.__dict__.get("source") or textwrap.dedent(inspect.getsource(kernel))
    definition = ast.parse(source).body[0]
    if not isinstance(definition, ast.FunctionDef):
        raise NotInC(f"{kernel.__module__}.{kernel.__qualname__} is not a plain function")
    return definition


def _load(target: ast.expr) -> ast.expr:
    return ast.parse(ast.unparse(target), mode="eval").body


def _join_texts(given: Iterable[tuple[str, CType]]) -> str:
    return ", ".join(text for text, its in given if its is not NONE)


def _write_float(value: float) -> str:
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0.0 else "(-INFINITY)"
    return repr(value)


def _c_name(name: str) -> str:
    return f"{name}_" if name in _C_WORDS else name
