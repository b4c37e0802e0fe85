"""Call kernels: as machine code where there is a compiler, else as the Python that they are.

    fill = machine(fill_pressures)            for arrays that are given in each call
    fill(parameters, commands_v, pressures_pa)

    call = prepare(run_ticks, {...}, updates=("state",))      for numbers that stay between calls
    call.put("n", 1); call.run(); call.get("state")

The kernel is translated for the types of its first arguments. Where machine code reports an error,
plain Python runs the same call, and says what is wrong.
"""

from __future__ import annotations

import ctypes
import struct
import sys
import threading
from collections import namedtuple
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from copy import copy
from functools import cache
from operator import attrgetter
from types import FunctionType, ModuleType
from typing import Any, cast

from pamctl.kernel.build import CannotBuild, hash_package, load_function, tell_plain
from pamctl.kernel.layout import (
    WORD_BYTES,
    Block,
    NotKernelData,
    Rows,
    find_kind,
    list_fields,
    list_leaves,
)

Kernel = Callable[..., Any]
_COMPOSED: list[str] = []


def note_composed(source: str, used: Mapping[str, Any]) -> None:
    """Take note of a kernel that is made while pamctl starts: machine code depends on it."""
    modules = sorted({str(getattr(its, "__module__", "")) for its in used.values()})
    _COMPOSED.append("\n".join([source, *modules, *map(hash_package, modules)]))


class NativeCall:
    """A kernel in machine code, and one block of memory with its arguments."""

    is_native = True

    def __init__(
        self, kernel: Kernel, arguments: Mapping[str, Any], updates: tuple[str, ...] = ()
    ) -> None:
        """Build the machine code if it is missing. Raise `CannotBuild` or `NotKernelData`."""
        frame = make_frame(kernel)(**arguments)
        arguments = frame._asdict()  # in the kernel's order
        self._kernel, self._updates = kernel, updates
        self._function = load_kernel(kernel, frame, updates)
        self.blocks: dict[str, Block[Any]] = {}
        self._arrays: dict[str, Any] = {}
        end = 0
        for name, value in arguments.items():
            self.blocks[name] = Block(value, end)
            end = self.blocks[name].end
        self._own = ""
        self._hold(bytearray(WORD_BYTES * end))
        for name, value in arguments.items():
            self.put(name, value)

    def _hold(self, buffer: bytearray) -> None:
        self.buffer = buffer
        self._address = ctypes.addressof(ctypes.c_char.from_buffer(buffer))

    def fits(self, name: str, value: Any) -> bool:
        """Tell whether a value has the types that the machine code was built for."""
        return self.blocks[name].fits(value)

    def put(self, name: str, value: Any) -> None:
        """Set an argument; its type is that of the first value."""
        block = self.blocks[name]
        if block.has_arrays:
            self._arrays[name] = value
        block.write(self.buffer, value)

    def get(self, name: str) -> Any:
        """Return an argument; after `run`, of those in `updates`, the result."""
        if name in self._arrays:
            return self._arrays[name]
        return self.blocks[name].read(self.buffer)

    def reader(self, name: str, path: str) -> Callable[[], Any]:
        """Return a function that reads a part of an argument, such as `decision.tripped`."""
        part: Block[Any] = self.blocks[name].find_part(path)
        numbers, at, buffer = part.struct.unpack_from, part.begin * WORD_BYTES, self.buffer
        if len(part.leaves) == 1 and part.leaves[0].kind is not bool:
            return lambda: numbers(buffer, at)[0]
        return lambda: part.read(buffer)

    def double(self, name: str, value: Any) -> NativeCall:
        """Return another call of the same kernel, with a value of its own for one argument."""
        other = copy(self)
        other._arrays, other._own = dict(self._arrays), name
        other._hold(bytearray(self.buffer))
        other.put(name, value)
        return other

    def take_over(self, other: Any) -> None:
        """Copy all arguments of another call, but the one that this double has for itself."""
        own = self.blocks[self._own]
        begin, end = own.begin * WORD_BYTES, own.end * WORD_BYTES
        self.buffer[:begin] = other.buffer[:begin]
        self.buffer[end:] = other.buffer[end:]
        kept = self._arrays.get(self._own)
        self._arrays.update(other._arrays)
        self._arrays[self._own] = kept

    def run(self) -> None:
        """Run the kernel. Raise what it raises in Python; then no argument has changed."""
        if self._function(self._address):
            given = {name: _read_plain(self.get(name)) for name in self.blocks}
            for name, value in _run_plain(self._kernel, given, self._updates):
                self.put(name, value)


class PlainCall:
    """A kernel in plain Python, with its arguments."""

    is_native = False

    def __init__(
        self, kernel: Kernel, arguments: Mapping[str, Any], updates: tuple[str, ...] = ()
    ) -> None:
        """Keep the arguments."""
        self._kernel, self._updates = kernel, updates
        self._values = {name: _read_plain(value) for name, value in arguments.items()}
        self._own = ""

    def put(self, name: str, value: Any) -> None:
        """Set an argument."""
        self._values[name] = _read_plain(value)

    def get(self, name: str) -> Any:
        """Return an argument; after `run`, of those in `updates`, the result."""
        return self._values[name]

    def fits(self, name: str, value: Any) -> bool:
        """Say yes: plain Python takes every type."""
        return True

    def reader(self, name: str, path: str) -> Callable[[], Any]:
        """Return a function that reads a part of an argument, such as `decision.tripped`."""
        values = self._values
        if not path:
            return lambda: values[name]
        read = attrgetter(path)
        return lambda: read(values[name])

    def double(self, name: str, value: Any) -> PlainCall:
        """Return another call of the same kernel, with a value of its own for one argument."""
        other = PlainCall(self._kernel, {**self._values, name: value}, self._updates)
        other._own = name
        return other

    def take_over(self, other: Any) -> None:
        """Copy all arguments of another call, but the one that this double has for itself."""
        self._values.update({**other._values, self._own: self._values[self._own]})

    def run(self) -> None:
        """Run the kernel. Raise what it raises; then no argument has changed."""
        self._values.update(_run_plain(self._kernel, self._values, self._updates))


Call = NativeCall | PlainCall


def _run_plain(
    kernel: Kernel, arguments: Mapping[str, Any], updates: tuple[str, ...]
) -> Iterable[tuple[str, Any]]:
    """Run a kernel in Python; return the arguments that get its results."""
    results = kernel(**arguments)
    if not updates:
        return ()
    return zip(updates, results if len(updates) > 1 else (results,), strict=True)


def _read_plain(value: Any) -> Any:
    """Return a value whose arrays give Python's own numbers: those of numpy compute otherwise."""
    if hasattr(value, "_fields"):
        return type(value)(*map(_read_plain, value))
    if hasattr(value, "dtype"):
        return memoryview(value) if value.ndim else value.item()
    return value


def prepare(kernel: Kernel, arguments: Mapping[str, Any], updates: tuple[str, ...] = ()) -> Call:
    """Return a call that keeps its arguments, by name; `updates` get the results, in order.

    An argument with arrays cannot be among them.
    """
    try:
        return NativeCall(kernel, arguments, updates)
    except CannotBuild as error:
        tell_plain(error)
        return PlainCall(kernel, arguments, updates)


def recall(kernel: Kernel, arguments: Mapping[str, Any], updates: tuple[str, ...] = ()) -> Call:
    """Return a call as `prepare` does; a thread uses the same one again for the same types."""
    known = _known.__dict__.setdefault(f"{kernel.__module__}.{kernel.__qualname__}", [])
    for call in known:
        if all(call.fits(name, value) for name, value in arguments.items()):
            for name, value in arguments.items():
                call.put(name, value)
            return cast(Call, call)
    known.append(prepare(kernel, arguments, updates))
    return cast(Call, known[-1])


_known = threading.local()


class Machine:
    """A kernel that fills arrays and returns nothing, for arguments of any types."""

    def __init__(self, kernel: Kernel) -> None:
        """Build nothing before the first call."""
        self._kernel, self._frame = kernel, make_frame(kernel)
        self._variants: list[tuple[Block[Any], Any]] = []

    def __call__(self, *arguments: Any) -> None:
        """Run the kernel. Raise what it raises in Python."""
        if not self._run_native(arguments):
            self._kernel(*map(_read_plain, arguments))

    def fill_until_it_fails(self, *arguments: Any) -> None:
        """Run the kernel; where Python would raise, what comes after that is not filled."""
        if self._run_native(arguments) is None:
            with suppress(ArithmeticError, ValueError):
                self._kernel(*map(_read_plain, arguments))

    def _run_native(self, arguments: tuple[Any, ...]) -> bool | None:
        """Return whether the machine code went through; None where there is none."""
        given = self._frame(*arguments)
        known = (variant for variant in self._variants if variant[0].fits(given))
        block, function = next(known, None) or self._add_variant(given)
        if function is None:
            return None
        owners: list[object] = []  # of the arrays, until the call is over
        try:
            words = bytearray(block.struct.pack(*block.flatten(given, owners)))
        except struct.error:  # an int of more than 64 bits
            return None
        return not function(ctypes.addressof(ctypes.c_char.from_buffer(words)))

    def _add_variant(self, example: Any) -> tuple[Block[Any], Any]:
        function = None
        try:
            function = load_kernel(self._kernel, example)
        except CannotBuild as error:
            tell_plain(error)
        self._variants.append((Block(example), function))
        return self._variants[-1]


@cache
def machine(kernel: Kernel) -> Machine:
    """Return a kernel's `Machine`; there is one of each."""
    return Machine(kernel)


@cache
def make_frame(kernel: Kernel) -> Any:
    """Return the NamedTuple of a kernel's arguments."""
    code = kernel.__code__
    names = code.co_varnames[: code.co_argcount]
    return namedtuple("Arguments", names, module=kernel.__module__)


def load_kernel(kernel: Kernel, frame: Any, updates: tuple[str, ...] = ()) -> Any:
    """Return the C function of a kernel for arguments like those in `frame`.

    It takes the address of their block, puts the results into those of `updates`, and returns 0.
    Where Python would raise, it returns another number, and changes no argument. Raise
    `CannotBuild`, `NotKernelData`, or `NotInC`.
    """
    kernels, constants = _list_used(kernel)
    modules = sorted({*(its.__module__ for its in kernels), *_list_modules(frame)})
    try:
        described = "\n".join(_describe(frame))
    except NotKernelData:
        [*list_leaves(frame, kernel.__name__)]  # which says where it is
        raise
    parts = (
        f"{kernel.__module__}.{kernel.__qualname__}", repr(updates), described,
        *map(hash_package, modules), *_COMPOSED, repr(sorted(constants.items())),
    )  # fmt: skip
    if not all(getattr(sys.modules.get(module), "__file__", None) for module in modules):
        # A notebook has no file that tells when its kernels change.
        parts = (*parts, write_source(kernel, frame, updates))
    return load_function(kernel.__name__, parts, lambda: write_source(kernel, frame, updates))


def _list_used(kernel: Any) -> tuple[set[Any], dict[str, Any]]:
    """List the kernels that a kernel reaches, and by name the constants that they may read."""
    kernels: set[Any] = set()
    constants: dict[str, Any] = {}
    found = [kernel]
    while found:
        its = found.pop()
        if not isinstance(its, FunctionType) or its in kernels:
            continue
        kernels.add(its)
        found += getattr(its, "registry", {}).values()
        names = its.__code__.co_names
        for name in names:
            part = its.__globals__.get(name)
            if isinstance(part, ModuleType):
                found += [getattr(part, of, None) for of in names]
            else:
                found.append(part)
            if isinstance(part, int | float) or hasattr(part, "_fields"):
                constants[f"{its.__module__}.{name}"] = part
    return kernels, constants


def write_source(kernel: Kernel, frame: Any, updates: tuple[str, ...] = ()) -> str:
    """Return the C source of a library: the kernel, and the function `run` that calls it."""
    from pamctl.kernel.c_source import NONE, CSource, c_name, write_call
    from pamctl.kernel.expressions import NotInC

    source = CSource()
    its = source.type_of(frame)
    name, result = source.add_kernel(kernel, [part for _, part in its.fields])
    call = write_call(name, {f"words->{c_name(of)}": part for of, part in its.fields})
    lines = [f"    {'' if result is NONE else f'{result.name} done = '}{call};"]
    lines += ["    if (failed) return 1;"]
    results = result.fields if len(updates) > 1 else (("", result),)
    if updates and [part for _, part in results] != [its[into] for into in updates]:
        raise NotInC(f"{kernel.__qualname__}: its results are not of the types of {updates}")
    for (of, part), into in zip(results if updates else (), updates, strict=True):
        if part.words:
            lines.append(f"    words->{c_name(into)} = done{of and '.'}{of and c_name(of)};")
    body = "\n".join(["    failed = 0;", *lines, "    return 0;"])
    export = '__attribute__((visibility("default")))'
    source.functions.append(f"{export} int run({its.name} *words) {{\n{body}\n}}\n")
    return source.text()


def _describe(value: Any, annotation: object = None) -> Iterator[str]:
    """Describe the types in a value, for the name of its machine code."""
    if value is None or hasattr(value, "_fields"):
        yield f"{type(value).__module__}.{type(value).__qualname__}("
        for name, part, stated in () if value is None else list_fields(value):
            yield f"{name}: {stated}"
            yield from _describe(part, stated)
        yield ")"
    elif isinstance(value, Rows):
        yield "rows"
        yield from _describe(value.block.template)
    else:
        yield str(find_kind(value, annotation))


def _list_modules(value: Any) -> Iterator[str]:
    """List the modules that the NamedTuples in a value come from."""
    if isinstance(value, Rows):
        yield from _list_modules(value.block.template)
    elif hasattr(value, "_fields"):
        yield type(value).__module__
        for part in value:
            yield from _list_modules(part)


__all__ = ["Call", "Machine", "NotKernelData", "Rows", "machine", "prepare"]
