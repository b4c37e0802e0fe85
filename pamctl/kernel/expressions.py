"""The expressions of a kernel, in C: what each means, and of which type it is."""

from __future__ import annotations

import ast
import inspect
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from types import BuiltinFunctionType, FunctionType
from typing import Any, NamedTuple

from pamctl.base.errors import ExitCode
from pamctl.kernel.c_source import (
    BOOL,
    BUILTINS,
    COMPARE,
    FLOAT,
    FLOAT_OPERATORS,
    GRID,
    INT,
    INT_OPERATORS,
    INTEGERS,
    MATH,
    NONE,
    NUMBER_TYPES,
    NUMBERS,
    TESTS,
    CSource,
    CType,
    Kernel,
    c_name,
)
from pamctl.kernel.layout import NotKernelData


class NotInC(Exception):
    """A kernel uses something that this translation does not know. The message says where."""

    exit_code = ExitCode.UNEXPECTED


class Expression(NamedTuple):
    """An expression in C."""

    text: str
    its: CType
    is_place: bool = False
    """It has an address."""
    argument: str = ""
    """The argument that it is, or is a part of."""

    @property
    def is_fixed(self) -> bool:
        """Nothing in this function changes it: it is an argument, or a part of one."""
        return bool(self.argument)


class ExpressionWriter:
    """Writes the expressions of a kernel. It knows the types of its variables."""

    def __init__(
        self, source: CSource, kernel: Kernel, definition: ast.FunctionDef, types: Sequence[CType]
    ) -> None:
        """Write for arguments of these types."""
        self._source, self._kernel, self._definition = source, kernel, definition
        given = self._definition.args
        names = [argument.arg for argument in (*given.posonlyargs, *given.args)]
        if given.vararg or given.kwonlyargs or given.kwarg:
            raise self._refuse(self._definition, "its arguments must have names and an order")
        if len(names) != len(types):
            raise self._refuse(self._definition, f"has {len(names)} of {len(types)} arguments")
        self._arguments = dict(zip(names, types, strict=True))
        self._assigned = _count_assigned(self._definition)
        self._changed = {name for name in names if self._assigned[name]}
        self._set: set[str] = set()
        """The local variables that surely have a value here: all, where no one comes."""
        self._whole: ast.expr | None = None
        """The expression that a statement computes: no part of another one."""
        self.filled: set[str] = set()
        """The arguments whose arrays change."""
        self._locals: dict[str, CType] = {}
        self._aliases: dict[str, Expression] = {}
        self._result: CType | None = None
        self._lines: list[str] = []

    def _read_whole(self, node: ast.expr) -> Expression:
        """Write the expression that a statement computes."""
        self._whole = node
        return self._read(node)

    def _read(self, node: ast.expr) -> Expression:
        """Write an expression."""
        found = self._find(node)
        if found is not None and not callable(found):
            return self._read_value(found, node)
        read = getattr(self, f"_read_{type(node).__name__.lower()}", None)
        if read is None:
            raise self._refuse(node)
        term: Expression = read(node)
        return term

    def _read_test(self, node: ast.expr) -> str:
        given = self._read(node)
        if given.its not in NUMBER_TYPES:
            raise self._refuse(node)
        return given.text

    def _read_constant(self, node: ast.Constant) -> Expression:
        return self._read_value(node.value, node)

    def _read_value(self, value: Any, node: ast.expr) -> Expression:
        """Write a value that Python knows now."""
        try:
            its = self._source.type_of(value)
            text = "" if its is NONE else self._source.write_value(value, its)
        except NotKernelData as error:
            raise self._refuse(node, str(error)) from None
        if its is NONE:
            return Expression("", NONE)
        if its in NUMBER_TYPES:
            return Expression(f"({text})", its)
        return Expression(f"(({its.name}){text})", its, is_place=True)

    def _read_name(self, node: ast.Name) -> Expression:
        its = {**self._locals, **self._arguments}.get(node.id)
        if node.id not in self._arguments and node.id in self._assigned.keys() - self._set:
            raise self._refuse(node, "this variable may have no value here")
        if its is None:
            raise self._refuse(node, "this name is no variable, number or kernel")
        if node.id in self._aliases:
            return self._aliases[node.id]
        if not its.words:
            return _make_nothing(its)
        name = c_name(node.id)
        is_given = node.id in self._arguments and node.id not in self._changed
        if its.by_address and is_given:
            name = f"(*{name})"
        return Expression(name, its, is_place=True, argument=node.id if is_given else "")

    def _read_attribute(self, node: ast.Attribute) -> Expression:
        whole = self._read(node.value)
        if node.attr not in dict(whole.its.fields):
            raise self._refuse(node)
        return take_part(whole, node.attr)

    def _read_subscript(self, node: ast.Subscript) -> Expression:
        if isinstance(node.value, ast.Attribute) and node.value.attr == "shape":
            array = self._read(node.value.value)
            one = ("length",)
            sizes = {GRID: ("rows", "columns"), NUMBERS: one, INTEGERS: one}.get(array.its, ())
            axis = self._find(node.slice)
            if axis not in range(len(sizes)):
                raise self._refuse(node)
            return Expression(f"{array.text}.{sizes[axis]}", INT)
        text, its, *_ = self._read(node.value)
        get = {NUMBERS: "get", INTEGERS: "get_int", GRID: "get_from"}.get(its)
        indices = self._read_indices(node)
        if get is None or its.item is None:
            raise self._refuse(node)
        self._check_axes(its, indices, node)
        return Expression(f"{get}({', '.join([text, *indices])})", its.item)

    def _read_indices(self, node: ast.Subscript) -> list[str]:
        nodes = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        terms = [self._read(index) for index in nodes]
        if any(term.its is not INT for term in terms):
            raise self._refuse(node)
        return [term.text for term in terms]

    def _check_axes(self, its: CType, indices: list[str], node: ast.expr) -> None:
        if len(indices) != (2 if its is GRID else 1):
            raise self._refuse(node)

    def _read_tuple(self, node: ast.Tuple) -> Expression:
        its = self._source.tuple_of([self._read(part).its for part in node.elts])
        return Expression(self._make_tuple(node, its), its)

    def _make_tuple(self, node: ast.Tuple, its: CType) -> str:
        return f"(({its.name}){{{_join_texts(self._read(part) for part in node.elts) or '0'}}})"

    def _read_binop(self, node: ast.BinOp) -> Expression:
        (left, one, *_), (right, other, *_) = self._read(node.left), self._read(node.right)
        if one not in NUMBER_TYPES or other not in NUMBER_TYPES:
            raise self._refuse(node)
        kind = type(node.op)
        if kind is ast.Div and FLOAT not in (one, other):
            left, right = f"exact({left})", f"exact({right})"
        if FLOAT in (one, other) or kind is ast.Div:
            if kind not in FLOAT_OPERATORS:
                raise self._refuse(node)
            return Expression(FLOAT_OPERATORS[kind].format(left, right), FLOAT)
        if kind not in INT_OPERATORS:
            raise self._refuse(node)
        return Expression(INT_OPERATORS[kind].format(left, right), INT)

    def _read_unaryop(self, node: ast.UnaryOp) -> Expression:
        text, its, *_ = self._read(node.operand)
        if its not in NUMBER_TYPES:
            raise self._refuse(node)
        if isinstance(node.op, ast.Not):
            return Expression(f"(!{text})", BOOL)
        wide = FLOAT if its is FLOAT else INT
        if isinstance(node.op, ast.USub):
            return Expression(f"(-{text})" if its is FLOAT else f"subtracted(0, {text})", wide)
        if isinstance(node.op, ast.UAdd):
            return Expression(text, wide)
        raise self._refuse(node)

    def _read_boolop(self, node: ast.BoolOp) -> Expression:
        known = self._decide(node)
        if known is not None:
            return Expression(str(int(known)), BOOL)
        # What the types decide is left out: it may not be in C at all.
        parts = [self._read(part) for part in node.values if self._decide(part) is None]
        if any(part.its is not BOOL for part in parts):
            raise self._refuse(node)
        sign = " && " if isinstance(node.op, ast.And) else " || "
        return Expression(f"({sign.join(part.text for part in parts)})", BOOL)

    def _read_compare(self, node: ast.Compare) -> Expression:
        known = self._decide(node)
        if known is not None:
            return Expression(str(int(known)), BOOL)
        terms = [self._read(term) for term in (node.left, *node.comparators)]
        if any(term.its not in NUMBER_TYPES for term in terms):
            raise self._refuse(node)
        if any(type(sign) not in COMPARE for sign in node.ops):
            raise self._refuse(node)
        signs = (COMPARE[type(sign)] for sign in node.ops)
        pairs = zip(terms, signs, terms[1:], strict=False)
        tests = []
        for left, sign, right in pairs:
            # Python compares an int with a float by their values: the int is not rounded.
            is_mixed = FLOAT in (left.its, right.its) and left.its is not right.its
            one, other = (
                f"exact({term.text})" if is_mixed and term.its is not FLOAT else term.text
                for term in (left, right)
            )
            tests.append(f"{one} {sign} {other}")
        return Expression(f"({' && '.join(tests)})", BOOL)

    def _read_ifexp(self, node: ast.IfExp) -> Expression:
        known = self._decide(node.test)
        if known is not None:
            return self._read(node.body if known else node.orelse)
        one, other = self._read(node.body), self._read(node.orelse)
        its = self._join(one.its, other.its, node)
        if one.its is not other.its and its not in NUMBER_TYPES:
            raise self._refuse(node, f"{one.its.name} here is {other.its.name} elsewhere")
        return Expression(f"({self._read_test(node.test)} ? {one.text} : {other.text})", its)

    def _read_call(self, node: ast.Call) -> Expression:
        called = self._find(node.func)
        if isinstance(called, FunctionType):
            given = self._order_arguments(node, list(inspect.signature(called).parameters), called)
            if hasattr(called, "dispatch"):
                called = self._choose(called, given[0].its, node)
            if called in self._source.under_way:
                raise self._refuse(node, "it calls itself")
            name, its = self._source.add_kernel(called, [term.its for term in given])
            filled = [given[at] for at in self._source.filled[name]]
            if (filled or its is NONE) and node is not self._whole:
                # C may compute the parts of a whole in any order.
                raise self._refuse(
                    node, "it changes an array, or gives nothing: let it be a statement of its own"
                )
            for array in filled:
                self._note_filled(array, node)
            return Expression(f"{name}({_join_texts(map(_pass_on, given))})", its)
        if isinstance(called, type) and hasattr(called, "_fields"):
            fields: Any = called
            given = self._order_arguments(node, list(fields._fields), called)
            its = self._source.struct_of(called, [term.its for term in given])
            for (name, field), term in zip(its.fields, given, strict=True):
                if field is FLOAT and term.its is not FLOAT:
                    raise self._refuse(node, f"the field {name} is a float, and an int is given")
            return Expression(f"(({its.name}){{{_join_texts(given) or '0'}}})", its)
        if node.keywords or not isinstance(called, (BuiltinFunctionType, type)):
            raise self._refuse(node)
        return self._read_builtin(node, called, [self._read(argument) for argument in node.args])

    def _note_filled(self, array: Expression, node: ast.expr) -> None:
        if not array.argument:
            raise self._refuse(node, "a kernel fills arrays that are its arguments")
        self.filled.add(array.argument)

    def _choose(self, dispatched: Any, its: CType, node: ast.expr) -> Kernel:
        """Return the kernel that `singledispatch` has for a type."""
        python = {FLOAT: float, INT: int, BOOL: bool, NONE: type(None)}.get(its, its.python)
        kernel: Kernel = dispatched.dispatch(python or object)
        if kernel is dispatched.dispatch(object):
            raise self._refuse(node, f"there is no kernel for {its.name}")
        return kernel

    def _read_builtin(self, node: ast.Call, called: Any, given: list[Expression]) -> Expression:
        texts, kinds = [term.text for term in given], [term.its for term in given]
        if called is len and len(kinds) == 1 and kinds[0].item is not None:
            return Expression(f"{texts[0]}.{'rows' if kinds[0] is GRID else 'length'}", INT)
        if not kinds or any(its not in NUMBER_TYPES for its in kinds):
            raise self._refuse(node)
        whole = FLOAT not in kinds
        if called in MATH:
            if len(given) != 1 + ("{1}" in MATH[called]) or (whole and called is pow):
                raise self._refuse(node)
            return Expression(MATH[called].format(*texts), FLOAT)
        if called in (max, min) and len(given) > 1:
            if not whole and kinds != [FLOAT] * len(kinds):
                raise self._refuse(node, "an int would become a float: write it as one")
            name = ("larger" if called is max else "smaller") + ("_int" if whole else "")
            text = texts[0]
            for other in texts[1:]:
                text = f"{name}({text}, {other})"
            return Expression(text, INT if whole else FLOAT)
        if len(given) != 1:
            raise self._refuse(node)
        text = texts[0]
        if called in TESTS:
            return Expression(
                "0"
                if whole and called is not math.isfinite
                else f"({TESTS[called]}((double){text}) != 0)",
                BOOL,
            )
        if called is abs:
            return (
                Expression(f"magnitude_int({text})", INT)
                if whole
                else Expression(f"MAGNITUDE({text})", FLOAT)
            )
        if called in (math.ceil, math.floor):
            return Expression(text if whole else f"to_int({called.__name__}({text}))", INT)
        if called is round:
            return Expression(text if whole else f"to_int(rint({text}))", INT)
        if called is int:
            return Expression(text if whole else f"to_int({text})", INT)
        if called is float:
            return Expression(f"((double){text})", FLOAT)
        if called is bool:
            return Expression(f"({text} != 0)", BOOL)
        raise self._refuse(node)

    def _order_arguments(self, node: ast.Call, names: list[str], called: Any) -> list[Expression]:
        """Return all arguments of a call in their order, with the defaults of those left out."""
        given: dict[str, Expression] = {}
        order = iter(names)
        for part in node.args:
            if isinstance(part, ast.Starred):
                raise self._refuse(node)
            name = next(order, None)
            if name is None:
                raise self._refuse(node)
            given[name] = self._read(part)
        for word in node.keywords:
            if word.arg is None or word.arg in given:
                raise self._refuse(node)
            given[word.arg] = self._read(word.value)
        if isinstance(called, FunctionType):
            values = called.__defaults__ or ()
            defaults = dict(zip(names[len(names) - len(values) :], values, strict=True))
        else:
            defaults = called._field_defaults
        missing = [name for name in names if name not in given and name not in defaults]
        if missing or not given.keys() <= {*names}:
            raise self._refuse(node)
        return [
            given[name] if name in given else self._read_value(defaults[name], node)
            for name in names
        ]

    # Helpers.

    def _find(self, node: ast.expr) -> Any:
        """Return the Python object that a name, or an attribute of one, stands for; else None."""
        if isinstance(node, ast.Constant):
            return node.value
        if isinstance(node, ast.Name) and node.id not in {*self._arguments, *self._assigned}:
            known = self._kernel.__globals__.get(node.id, BUILTINS.get(node.id))
            return range if known is None and node.id == "range" else known
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
            return (self._read(test.left).its is NONE) == isinstance(test.ops[0], ast.Is)
        return None

    def _join(self, one: CType | None, other: CType, node: ast.AST | None = None) -> CType:
        """Return the type that holds both: the wider number."""
        if one is None or one is other:
            return other
        if {one, other} == {BOOL, INT}:
            return INT
        if FLOAT in (one, other) and one in NUMBER_TYPES and other in NUMBER_TYPES:
            # Not all that an int gives is what the float would give: -0 is 0, and -0.0 is not.
            why = "an int here is a float elsewhere: write it as one, such as 0.0"
            raise self._refuse(node or self._definition, why)
        if one.python is tuple and other.python is tuple and len(one.fields) == len(other.fields):
            pairs = zip(one.fields, other.fields, strict=True)
            return self._source.tuple_of([self._join(a, b, node) for (_, a), (_, b) in pairs])
        raise self._refuse(node or self._definition, f"{one.name} here is {other.name} elsewhere")

    def _refuse(self, node: ast.AST, why: str = "") -> NotInC:
        code = getattr(self._kernel, "__code__", None)
        line = getattr(node, "lineno", 1) - 1 + getattr(code, "co_firstlineno", 1)
        said = ast.unparse(node).partition("\n")[0]
        why = why or "a kernel may not use this; pamctl.kernel.translate lists what it may"
        where = getattr(code, "co_filename", self._kernel.__module__)
        return NotInC(f"{where}:{line}: {self._kernel.__qualname__}: `{said}`: {why}")


def _count_assigned(definition: ast.FunctionDef) -> Counter[str]:
    names = (node for node in ast.walk(definition) if isinstance(node, ast.Name))
    return Counter(node.id for node in names if isinstance(node.ctx, ast.Store))


def take_part(whole: Expression, name: str) -> Expression:
    """Return a field of a struct."""
    its = whole.its[name]
    if not its.words:
        return _make_nothing(its)
    return Expression(f"{whole.text}.{c_name(name)}", its, whole.is_place, whole.argument)


def _make_nothing(its: CType) -> Expression:
    return Expression("" if its is NONE else f"(({its.name}){{0}})", its)


def _pass_on(term: Expression) -> Expression:
    """Return an argument as a function takes it: a large struct by its address."""
    if not term.its.by_address:
        return term
    at = f"&{term.text}" if term.is_place else f"({term.its.name}[1]){{{term.text}}}"
    return Expression(at, term.its)


def _join_texts(given: Iterable[Expression]) -> str:
    return ", ".join(term.text for term in given if term.its.words)
