"""Every kernel of pamctl: its types, its machine code, and values for it.

What is reached from the tick of each installed law, from the plant's step, and from the drives that
fit a plant is a kernel.
"""

from __future__ import annotations

import ctypes
import itertools
import math
import random
import struct
import subprocess
import sys
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from support.runs import run_settings

from hal.calibration import Zero
from hal.rig import RawSample
from pamctl.control.around_the_law import CELLS, Compensation
from pamctl.control.law_registry import installed_laws
from pamctl.kernel import build
from pamctl.kernel.c_source import (
    BOOL,
    FLOAT,
    GRID,
    INT,
    INTEGERS,
    NONE,
    NUMBERS,
    CSource,
    CType,
    c_name,
)
from pamctl.kernel.calls import make_frame
from pamctl.plant.catalogue import CATALOGUE, WITH_TERMS
from pamctl.plant.chamber import pressure_behind_line_pa
from pamctl.plant.effects.readings import ScaleCarrier, restart_behind_play
from pamctl.plant.parameters import PAPER, PlantParameters, parameters_of, vented_state
from pamctl.plant.required_force import fill_required_force
from pamctl.plant.simulated import advance_delayed_plant
from pamctl.plant.step import (
    advance_plant,
    pressure_block_step,
    sensed_position_m,
    sensed_pressure_pa,
)
from pamctl.plant.terms import DRIVERS, LOCATIONS, OPERATORS, Terms, fill_undone
from pamctl.realtime.tick import TickSetup, TickState, first_state, step
from pamctl.settings.build import build_tick_setup
from pamctl.signals import Phase, Reference, Timing

Kernel = Callable[..., Any]


# --- what runs ---------------------------------------------------------------------------------

TABLE = tuple(0.5 * sign * (i / CELLS) for sign in (1.0, -1.0) for i in range(CELLS + 1))
COMPENSATION = Compensation(1.01, 1e-5, 0.99, 200.0, 5.0, TABLE[: CELLS + 1], TABLE[CELLS + 1 :])


def make_setups() -> dict[str, TickSetup]:
    """Make the set-up of each law, and of one with a compensation."""
    setups = {law: build_tick_setup(run_settings(controller=law)) for law in installed_laws()}
    first = next(iter(setups))
    return {**setups, f"{first}, compensated": setups[first]._replace(compensation=COMPENSATION)}


def begin(setup: TickSetup) -> TickState:
    return first_state(setup, Zero(0.2, 0.0))


def make_plant(chance: random.Random, *, with_terms: bool) -> PlantParameters:
    """Make a plant with some effects of the catalogue, in their ranges, some with terms."""
    values = dict(PAPER)
    for effect in CATALOGUE.values():
        if chance.random() < 0.5:
            for p in effect.parameters:
                size = chance.choice((p.start, p.smallest_of_interest, chance.uniform(0, p.high)))
                whole = p.choices and float(chance.randrange(len(p.choices)))
                values[f"{effect.name}.{p.name}"] = whole or max(size, p.low)
    if not with_terms:
        return parameters_of(values)
    parts = {location.part: location for location in chance.sample([*LOCATIONS.values()], 4)}
    for location in parts.values():
        name = location.term_name
        values |= {f"{name}.{p.name}": p.start for p in WITH_TERMS[name].parameters}
        values[f"{name}.size"] = location.usual
        values[f"{name}.operator"] = float(chance.randrange(len(OPERATORS)))
        values[f"{name}.driver"] = float(chance.randrange(len(DRIVERS)))
        values[f"{name}.inner"] = chance.choice((1.0, 0.01, 1e5))
    p = parameters_of(values)
    return p._replace(terms=p.terms or Terms())


def run_all(chance: random.Random, ticks: int) -> Iterator[tuple[Kernel, tuple[Any, ...]]]:
    """Run a rig under each law; yield the arguments of each kernel before it is called."""
    plain = parameters_of({})
    for setup, kind in itertools.product(make_setups().values(), ("plain", False, True)):
        p = plain if kind == "plain" else make_plant(chance, with_terms=kind is True)
        plant, state = vented_state(p), begin(setup)
        for k in range(ticks):
            pressure = p, plant.pressure_pa, plant.air, plant.sensors, plant.age_s
            yield sensed_pressure_pa, pressure
            pressure_pa = sensed_pressure_pa(*pressure)
            position = p, plant.position_m, plant.sensors, plant.age_s
            yield sensed_position_m, position
            counts = sensed_position_m(*position) / setup.calibration.encoder_m_per_count
            cal = setup.calibration
            volts = 0.2 + (pressure_pa - cal.atmospheric_pressure_pa) / cal.sensor_pa_per_v
            raw = RawSample(volts, round(counts), 10**6 * k, 10**6 * k)
            reference = Reference(int(Phase.TRACK), 1e-3 * k, 0.1, 0.0, 0.0, math.nan)
            tick = setup, state, raw, reference, Timing(k, 1e-3 * k, 1e-3, 0.0, 0)
            yield step, tick
            state, decision = step(*tick)
            advance = p, plant, decision.valve_v, 1e-3, 5e-4
            yield advance_plant, advance
            plant = advance_plant(*advance)
        commands = array("d", (0.0, 4e-4)), array("d", (1.0, -1.0)), 2, 0, 0.0, 1e-3, 5e-4
        yield advance_delayed_plant, (p, plant, *commands)
        advance_delayed_plant(p, plant, *commands)
        x, v, pressure_pa, valve, air, _, mechanics, age_s = plant
        block = p, pressure_pa, valve, air, 1.0, x, x, x + 1e-6, age_s, 5e-4
        yield pressure_block_step, block
        pressure_block_step(*block)
        yield fill_required_force, (p, mechanics, np.ones((5, 5)), 1e-3, array("d", bytes(40)))
        line = p, pressure_pa, pressure_pa, pressure_pa + 10.0, x, v, 5e-4
        yield pressure_behind_line_pa, line
        pressure_behind_line_pa(*line)
        play = p.effects.sensors.encoder_backlash, ScaleCarrier(x), x, v, x, 0.1
        yield restart_behind_play, play
        restart_behind_play(*play)
        terms = p.terms or Terms()
        columns = (array("d", (x, 1e5)) for _ in range(3))
        yield fill_undone, (True, terms, *itertools.islice(columns, 2), 1e5, next(columns))


# --- C -----------------------------------------------------------------------------------------


@dataclass(eq=False)
class Variant:
    """A kernel for the types of its arguments."""

    kernel: Kernel
    types: tuple[CType, ...]
    calls: list[tuple[Any, ...]] = field(default_factory=list)
    """Arguments that it had while a rig ran."""
    result: CType = NONE
    function: Any = None

    def __str__(self) -> str:
        return f"{self.kernel.__module__}.{self.kernel.__qualname__}"


def find_variants(chance: random.Random) -> tuple[CSource, list[Variant]]:
    """Translate all that runs, and what else the rooms have; return the source and the kernels."""
    source = CSource()
    for kernel, arguments in run_all(chance, ticks=1):
        frame = source.type_of(make_frame(kernel)(*arguments))
        source.add_kernel(kernel, [part for _, part in frame.fields])
    variants = _list_variants(source)
    record_calls(variants, chance)
    return source, variants


def _list_variants(source: CSource) -> list[Variant]:
    return [Variant(*key, result=result) for key, (_, result) in source._written.items()]


def compile_variants(source: CSource, variants: list[Variant], folder: Path) -> None:
    """Build one library of all, with the compiler and the flags that pamctl uses."""
    for index, variant in enumerate(variants):
        name, result = source.add_kernel(variant.kernel, variant.types)
        its = source.struct_of(make_frame(variant.kernel), variant.types)
        given = ", ".join(
            f"{'&' if part.by_address else ''}words->{c_name(of)}"
            for of, part in its.fields
            if part.words
        )
        into, out = ("", "") if result is NONE else (f"{result.name} done = ", "*out = done;")
        source.functions.append(
            f'__attribute__((visibility("default"))) int call_{index}({its.name} *words, '
            f"{result.name if result.words else 'char'} *out) {{\n"
            f"    failed = 0;\n    {into}{name}({given});\n"
            f"    if (failed) return 1;\n    {out}\n    return 0;\n}}\n"
        )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "kernel.c").write_text(source.text())
    compiler = build.find_compiler()
    assert compiler is not None
    command = [*compiler, *build._FLAGS, "kernel.c", "-o", "kernel.so", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    library = ctypes.CDLL(str(folder / "kernel.so"))
    for index, variant in enumerate(variants):
        variant.function = getattr(library, f"call_{index}")
        variant.function.argtypes = (ctypes.c_void_p, ctypes.c_void_p)


def run(variant: Variant, words: bytearray) -> tuple[Any, ...] | None:
    """Call the machine code; return the numbers of its result, or None if it failed."""
    room = bytearray(8 * (variant.result.words + 1))
    places = (ctypes.c_char.from_buffer(memory or bytearray(8)) for memory in (words, room))
    if variant.function(*map(ctypes.addressof, places)):
        return None
    codes = "".join(CODES[kind] for kind in leaf_types(variant.result))
    return struct.unpack_from(codes, room)


# --- values ------------------------------------------------------------------------------------

ARRAYS = (NUMBERS, INTEGERS, GRID)
COLUMNS = 4
"""Of each array with two axes."""


class Row(list[Any]):
    """Plain numbers as a kernel sees an array of one axis; those of numpy would raise nothing."""

    @property
    def shape(self) -> tuple[int]:
        return (len(self),)


class Grid:
    """Plain floats as a kernel sees an array of two axes."""

    def __init__(self, items: list[float]) -> None:
        self.items = items
        self.shape = len(items) // COLUMNS, COLUMNS

    def __len__(self) -> int:
        return self.shape[0]

    def _place(self, at: tuple[int, int]) -> int:
        return range(self.shape[0])[at[0]] * COLUMNS + range(COLUMNS)[at[1]]

    def __getitem__(self, at: tuple[int, int]) -> float:
        return self.items[self._place(at)]

    def __setitem__(self, at: tuple[int, int], value: float) -> None:
        self.items[self._place(at)] = float(value)


def leaf_types(its: CType) -> Iterator[CType]:
    """Yield the types of the numbers and arrays in a type."""
    if its.fields:
        for _, part in its.fields:
            yield from leaf_types(part)
    elif its.words:
        yield its


def flatten(value: Any, its: CType) -> Iterator[Any]:
    """Yield the numbers in a value of a type; its arrays as lists."""
    if its.fields:
        for part, (_, kind) in zip(value, its.fields, strict=True):
            yield from flatten(part, kind)
    elif its.words:
        yield Row(getattr(value, "items", value)) if its in ARRAYS else value


def gather(its: CType, leaves: Iterator[Any]) -> Any:
    """Make a value of a type from what `flatten` yields; the lists stay themselves."""
    if its is NONE:
        return None
    if its.python is not None:
        parts = [gather(part, leaves) for _, part in its.fields]
        return tuple(parts) if its.python is tuple else its.python(*parts)
    return {FLOAT: float, INT: int, BOOL: bool, GRID: Grid}.get(its, lambda row: row)(next(leaves))


def fits(value: Any, its: CType) -> bool:
    """Tell whether a value has a type."""
    if its is NONE:
        return value is None
    if its.python is not None:
        return type(value) is its.python and all(
            fits(part, kind) for part, (_, kind) in zip(value, its.fields, strict=True)
        )
    if its in ARRAYS:
        return isinstance(value, tuple | array)
    return type(value) in {FLOAT: (float, int), INT: (int,), BOOL: (bool,)}[its]


CODES = {FLOAT: "d", INT: "q", BOOL: "q", NUMBERS: "qq", INTEGERS: "qq", GRID: "qqq"}


def pack(leaves: Sequence[Any], kinds: Sequence[CType]) -> tuple[bytearray, list[array[Any]]]:
    """Return the words of arguments in C, and the arrays that they point to."""
    words, arrays = bytearray(), []
    for leaf, kind in zip(leaves, kinds, strict=True):
        numbers: tuple[Any, ...] = (leaf,)
        if kind in ARRAYS:
            arrays.append(array("q" if kind is INTEGERS else "d", leaf))
            at, length = arrays[-1].buffer_info()
            numbers = (at, length // COLUMNS, COLUMNS) if kind is GRID else (at, length)
        words += struct.pack(CODES[kind], *numbers)
    return words, arrays


def bits(number: Any, kind: CType = FLOAT) -> bytes:
    """Return the bits of a number; all NaN are one."""
    return struct.pack(CODES[kind], math.nan if number != number else number)


def record_calls(variants: list[Variant], chance: random.Random, most: int = 4) -> None:
    """Keep the arguments of some calls of each kernel while a rig runs in plain Python."""
    by_code: dict[Any, list[Variant]] = {}
    for variant in variants:
        by_code.setdefault(getattr(variant.kernel, "__code__", None), []).append(variant)
    seen: dict[Any, int] = {}

    def note(frame: Any, event: str, _: Any) -> None:
        if event != "call" or frame.f_code not in by_code:
            return
        code = frame.f_code
        seen[code] = seen.get(code, 0) + 1
        if chance.random() * seen[code] > 2 * most:
            return
        given = tuple(frame.f_locals[name] for name in code.co_varnames[: code.co_argcount])
        for variant in by_code[code]:
            if all(map(fits, given, variant.types)):
                if len(variant.calls) == most:
                    variant.calls.pop(chance.randrange(most))
                variant.calls.append(given)

    sys.setprofile(note)
    try:
        for _ in run_all(chance, ticks=8):
            pass
    finally:
        sys.setprofile(None)


def make_call(variant: Variant) -> tuple[Any, ...]:
    """Make arguments of a kernel's types."""
    of_arrays = {NUMBERS: (0.0, 0.5, 1.0, 2.0), INTEGERS: (0, 1, 2, 3), GRID: (0.25,) * 20}
    kinds = (kind for its in variant.types for kind in leaf_types(its))
    leaves = iter([Row(of_arrays[kind]) if kind in ARRAYS else 1 for kind in kinds])
    return tuple(gather(kind, leaves) for kind in variant.types)
