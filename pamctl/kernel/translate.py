"""Translate kernels to C: the same functions, in the same order, with the same bits.

A kernel is a plain function of Python. It takes and returns floats, ints, bools, NamedTuples of
them, and arrays (`pamctl.kernel.layout`). Each becomes one C function for the types of its
arguments. Where Python would raise, the C code sets `failed`. What a kernel may use:

- statements: assignment (also of a tuple, or to an item of an array), `if`, `while`, `for` over
  `range`, `break`, `continue`, `return`, `pass`
- expressions: arithmetic, comparisons, `and`, `or`, `not`, `... if ... else ...`, attributes, items
  of arrays, `len`, `shape[i]`
- calls: other kernels, NamedTuples, the functions of `math` in `c_source.MATH`, `abs`, `min`,
  `max`, `round`, `int`, `float`, `bool`; a `functools.singledispatch` function stands for the
  kernel of its first argument's type
- `x is None`: the type of `x` decides it, and only one branch is translated

What C would do otherwise than Python is refused, or sets `failed`:
- a variable has one type, and a value wherever it is read; an int is not changed into a float
- a call that fills an array is a statement of its own; functions do not call themselves
- ints have 64 bits
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Iterable, Sequence
from functools import cache

from pamctl.kernel.build import CannotBuild
from pamctl.kernel.c_source import (
    GRID,
    INT,
    INTEGERS,
    NONE,
    NUMBER_TYPES,
    NUMBERS,
    CSource,
    CType,
    Kernel,
    c_name,
)
from pamctl.kernel.expressions import Expression, ExpressionWriter, NotInC, take_part


class FunctionWriter(ExpressionWriter):
    """Writes one function. It goes over the body until the types of all variables are settled."""

    def __init__(self, source: CSource, kernel: Kernel, types: Sequence[CType]) -> None:
        """Write for arguments of these types."""
        super().__init__(source, kernel, parse_kernel(kernel), types)
        self._breaks: list[list[set[str]]] = []
        self._lines: list[str] = []

    def write(self, name: str) -> tuple[str, CType]:
        """Return the C function of this name, and the type of its result."""
        settled = None
        while settled != (settled := (dict(self._locals), self._result)) or not self._lines:
            self._set = set()
            self._lines = []
            ends = self._write_block(self._definition.body, "    ")
        result = self._result or NONE
        if result is not NONE and not ends:
            raise self._refuse(self._definition, "it may end without its result")
        given, copied = [], []
        for index, (argument, its) in enumerate(self._arguments.items()):
            at = c_name(argument)
            if its.by_address and argument in self._changed:
                copied.append(f"    {its.name} {at} = *given_{index}_;")
                at = f"given_{index}_"
            if its.words:
                given.append(f"const {its.name} *{at}" if its.by_address else f"{its.name} {at}")
        declared = [
            f"    {its.name} {c_name(local)};"
            for local, its in self._locals.items()
            if its.words and local not in self._aliases
        ]
        head = f"UNUSED static inline {result.name} {name}({', '.join(given) or 'void'}) {{"
        return "\n".join([head, *copied, *declared, *self._lines, "}\n"]), result

    def list_filled(self) -> list[int]:
        """Return the numbers of the arguments whose arrays change."""
        return [at for at, name in enumerate(self._arguments) if name in self.filled]

    # Statements. Each returns whether it surely returns from the function.

    def _write_block(self, body: Iterable[ast.stmt], indent: str) -> bool:
        for statement in body:
            write = getattr(self, f"_write_{type(statement).__name__.lower()}", None)
            if write is None:
                raise self._refuse(statement)
            if write(statement, indent):
                return True
        return False

    def _write_pass(self, node: ast.Pass, indent: str) -> bool:
        return False

    def _write_expr(self, node: ast.Expr, indent: str) -> bool:
        if not isinstance(node.value, ast.Constant):  # a docstring
            self._lines.append(f"{indent}(void){self._read_whole(node.value).text};")
        return False

    def _write_return(self, node: ast.Return, indent: str) -> bool:
        given = Expression("", NONE) if node.value is None else self._read_whole(node.value)
        text, its = given.text, given.its
        self._result = self._join(self._result, its, node)
        if its is not self._result and isinstance(node.value, ast.Tuple):
            text = self._make_tuple(node.value, self._result)
        elif its is not self._result and its not in NUMBER_TYPES:
            raise self._refuse(node, f"{its.name} here is {self._result.name} elsewhere")
        if its is NONE:
            self._lines.append(f"{indent}{text and f'{text}; '}return;")
        else:
            self._lines.append(f"{indent}return {text};")
        self._set = set(self._assigned)
        return True

    def _write_assign(self, node: ast.Assign, indent: str) -> bool:
        first, *others = node.targets
        self._assign(first, node.value, indent)
        for target in others:  # the value is computed once
            if not isinstance(first, ast.Name):
                raise self._refuse(node, "its first target is no variable")
            value = ast.copy_location(ast.Name(first.id, ast.Load()), node)
            self._assign(target, value, indent)
        return False

    def _write_annassign(self, node: ast.AnnAssign, indent: str) -> bool:
        if node.value is None:
            raise self._refuse(node)
        self._assign(node.target, node.value, indent)
        return False

    def _write_augassign(self, node: ast.AugAssign, indent: str) -> bool:
        old = ast.parse(ast.unparse(node.target), mode="eval").body
        for part in ast.walk(old):
            ast.copy_location(part, node)
        whole = ast.copy_location(ast.BinOp(old, node.op, node.value), node)
        self._assign(node.target, whole, indent)
        return False

    def _assign(self, target: ast.expr, value: ast.expr, indent: str) -> None:
        has_index = any(isinstance(part, ast.Subscript) for part in ast.walk(target))
        read = self._read if has_index else self._read_whole
        if not isinstance(target, ast.Tuple):
            self._store(target, read(value), indent)
            return
        if isinstance(value, ast.Tuple) and _are_apart(target, value):
            for part, its in zip(target.elts, value.elts, strict=True):
                self._assign(part, its, indent)
            return
        given = read(value)
        if len(given.its.fields) != len(target.elts):
            raise self._refuse(target)
        if not given.is_fixed:
            self._lines.append(f"{indent}{{ const {given.its.name} all_ = {given.text};")
            given = Expression("all_", given.its, is_place=True)
        for part, (name, _) in zip(target.elts, given.its.fields, strict=True):
            if not (isinstance(part, ast.Name) and part.id == "_"):
                self._store(part, take_part(given, name), indent + "  ")
        if not given.is_fixed:
            self._lines.append(f"{indent}}}")

    def _store(self, target: ast.expr, given: Expression, indent: str) -> None:
        """Put a value into a variable, or into an array."""
        if isinstance(target, ast.Name):
            self._settle(target, given.its)
            if given.is_fixed and given.its.by_address and self._assigned[target.id] == 1:
                self._aliases[target.id] = given  # a copy would take longer than what follows
            elif given.its.words:
                self._lines.append(f"{indent}{c_name(target.id)} = {given.text};")
            elif given.text:
                self._lines.append(f"{indent}(void){given.text};")
            return
        if not isinstance(target, ast.Subscript):
            raise self._refuse(target)
        array = self._read(target.value)
        indices = self._read_indices(target)
        self._note_filled(array, target)
        if array.its.name == "Rows" and len(indices) == 1 and given.its is array.its.item:
            row = f"{given.its.name} *row_ = row_at({array.text}, {indices[0]})"
            self._lines.append(f"{indent}{{ {row}; if (row_) *row_ = {given.text}; }}")
            return
        put = {NUMBERS: "put", INTEGERS: "put_int", GRID: "put_into"}.get(array.its)
        whole = array.its is INTEGERS
        if put is None or given.its not in (NUMBER_TYPES[:2] if whole else NUMBER_TYPES):
            raise self._refuse(target)
        self._check_axes(array.its, indices, target)
        self._lines.append(f"{indent}{put}({', '.join([array.text, *indices, given.text])});")

    def _settle(self, target: ast.Name, its: CType) -> None:
        # An argument that is given another type of number keeps the wider one.
        known = self._arguments if target.id in self._arguments else self._locals
        known[target.id] = joined = self._join(known.get(target.id), its, target)
        if joined is not its and its not in NUMBER_TYPES:
            raise self._refuse(target, f"{its.name} here is {joined.name} elsewhere")
        self._set.add(target.id)

    def _write_if(self, node: ast.If, indent: str) -> bool:
        known = self._decide(node.test)
        if known is not None:
            return self._write_block(node.body if known else node.orelse, indent)
        self._lines.append(f"{indent}if ({self._read_test(node.test)}) {{")
        before = set(self._set)
        ends = self._write_block(node.body, indent + "    ")
        after, self._set = self._set, before
        if node.orelse:
            self._lines.append(f"{indent}}} else {{")
            ends = self._write_block(node.orelse, indent + "    ") and ends
        self._set &= after
        self._lines.append(f"{indent}}}")
        return ends and bool(node.orelse)

    def _write_while(self, node: ast.While, indent: str) -> bool:
        if node.orelse:
            raise self._refuse(node)
        # Where Python would have raised, numbers may be such that the loop never ends.
        self._lines.append(f"{indent}while ({self._read_test(node.test)} && !failed) {{")
        ways_out = self._write_body(node.body, indent)
        if not (isinstance(node.test, ast.Constant) and node.test.value):
            return False
        self._set = set(self._assigned).intersection(*ways_out)
        return not ways_out

    def _write_body(self, body: list[ast.stmt], indent: str) -> list[set[str]]:
        """Write a loop's body; return the variables that have a value at each `break`."""
        before = set(self._set)
        self._breaks.append([])
        self._write_block(body, indent + "    ")
        self._lines.append(f"{indent}}}")
        self._set = before
        return self._breaks.pop()

    def _write_for(self, node: ast.For, indent: str) -> bool:
        call, target = node.iter, node.target
        is_range = isinstance(call, ast.Call) and self._find(call.func) is range
        if not is_range or not isinstance(target, ast.Name) or node.orelse:
            raise self._refuse(node)
        assert isinstance(call, ast.Call)
        limits = [self._read(limit) for limit in call.args]
        if (
            call.keywords
            or not 1 <= len(limits) <= 2
            or any(limit.its is not INT for limit in limits)
        ):
            raise self._refuse(node)
        first, end = limits if len(limits) == 2 else (Expression("0", INT), limits[0])
        at, last = f"count_{len(indent)}_", f"end_{len(indent)}_"
        self._lines.append(
            f"{indent}for (long long {at} = {first.text}, {last} = {end.text}; "
            f"{at} < {last} && !failed; {at}++) {{"
        )
        before = set(self._set)
        if target.id != "_":
            self._settle(target, INT)
            self._lines.append(f"{indent}    {c_name(target.id)} = {at};")
        self._write_body(node.body, indent)
        self._set = before
        return False

    def _write_break(self, node: ast.Break, indent: str) -> bool:
        self._lines.append(f"{indent}break;")
        self._breaks[-1].append(self._set)
        self._set = set(self._assigned)
        return False

    def _write_continue(self, node: ast.Continue, indent: str) -> bool:
        self._lines.append(f"{indent}continue;")
        self._set = set(self._assigned)
        return False


def _are_apart(target: ast.Tuple, value: ast.Tuple) -> bool:
    """Tell whether `a, b = x, y` is the same as `a = x; b = y`."""
    names = [part.id for part in target.elts if isinstance(part, ast.Name)]
    used = {node.id for node in ast.walk(value) if isinstance(node, ast.Name)}
    is_plain = len(names) == len(target.elts) == len(value.elts) and "_" not in names
    return is_plain and not {*names} & used


def parse_kernel(kernel: Kernel) -> ast.FunctionDef:
    """Return the definition of a kernel. Raise `NotInC` for what is more than a function."""
    definition = _parse_source(kernel)
    if not isinstance(definition, ast.FunctionDef):
        raise NotInC(f"{kernel.__module__}.{kernel.__qualname__} is not a plain function")
    if hasattr(kernel, "__wrapped__") or kernel.__closure__:
        code = kernel.__code__
        raise NotInC(
            f"{code.co_filename}:{code.co_firstlineno}: {kernel.__qualname__}: it is more than its "
            "source: a decorator, or a function around it, gives it something"
        )
    return definition


@cache
def _parse_source(kernel: Kernel) -> ast.stmt:
    # Composed kernels (`pamctl.plant.catalogue`) bring the source that they were made of.
    try:
        source = kernel.__dict__.get("source") or textwrap.dedent(inspect.getsource(kernel))
    except OSError as error:
        name = f"{kernel.__module__}.{kernel.__qualname__}"
        raise CannotBuild(f"{name}: its source cannot be read") from error
    return ast.parse(source).body[0]
