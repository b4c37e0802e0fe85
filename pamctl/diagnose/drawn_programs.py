"""Draw programs of valve commands within the rig's limits."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, takewhile
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hal.calibration import Calibration, CalibrationSettings, Zero, calibration, sensor_v
from hal.rig import RawSample
from pamctl.base.errors import ConfigError
from pamctl.control.course import Segment, make_valve_reference
from pamctl.control.experiment import ProgramSettings, plan_experiment
from pamctl.diagnose.record import Array, Record
from pamctl.kernel.calls import machine
from pamctl.safety import INITIAL_SAFETY_STATE, Limits, SafetyState, admit
from pamctl.settings.build import build_tick_setup
from pamctl.settings.resolve import from_resolved
from pamctl.signals import Command, Estimate, Measurement, Phase, Timing

SHORTEST_S, LONGEST_S = 5.0, 10.0
"""Length of a program, with the rests at both ends."""
REST_S = 1.0
"""Vented rest at the beginning: the noise, and the zeros of the sensors."""
STROKES_HZ, STROKES = 1.0, 2
"""The strokes that every program begins with, as the experiment `diagnosis` does. What differs
between two of them is drift, or the rig's own repeatability."""
VENT_S = 1.2
"""Venting at the end: the next run begins at rest."""
MOST_BLOCKS = 4
POOL_SHARE = 0.8
"""Share of the blocks that are taken from a pool, where there is one."""

Part = dict[str, Any]
"""A part of a program, with the keys of an experiment file."""
Block = list[Part]
"""Parts that belong together."""


def make_repeated_part(stroke_v: float, command_v: float) -> list[Part]:
    """Return the part that all programs share: the rest, and full strokes of `stroke_v` (V)."""
    stroke = {
        "wave": "square",
        "frequency_hz": STROKES_HZ,
        "amplitude_v": stroke_v,
        "cycles": STROKES,
    }
    return [_hold(-command_v, REST_S), *([stroke] if stroke_v else [])]


def make_program(parts: Sequence[Part], seed: int = 1) -> ProgramSettings:
    """Return a program of these parts."""
    return ProgramSettings.model_validate({"kind": "program", "seed": seed, "parts": [*parts]})


def make_vent(command_v: float) -> Part:
    """Return the last part of a program."""
    return _hold(-command_v, VENT_S)


@dataclass(frozen=True)
class DrawnProgram:
    """A program, and the blocks between its shared beginning and its vent."""

    program: ProgramSettings
    blocks: tuple[Block, ...]


def draw_programs(
    count: int, command_v: float, begin: Sequence[Part], seed: int, pool: Sequence[Block] = ()
) -> Iterator[DrawnProgram]:
    """Yield `count` programs whose commands stay within +-`command_v` (V); the seed fixes them.

    All begin with the parts `begin`. Blocks are drawn anew, or most of them from `pool`.
    """
    drawn = random.Random(f"deciding {seed}{' again' if pool else ''}")
    room_s = LONGEST_S - _measure_s(begin) - VENT_S

    def draw() -> Block:
        is_known = bool(pool) and drawn.random() < POOL_SHARE
        return drawn.choice(pool) if is_known else _draw_block(drawn, command_v)

    for number in range(count):
        blocks = _fit_into(room_s, [draw() for _ in range(MOST_BLOCKS)])
        if not pool:
            blocks = blocks[: drawn.randint(1, len(blocks))]
        parts = [*begin, *(part for block in blocks for part in block)]
        missing_s = SHORTEST_S - VENT_S - _measure_s(parts)
        filling = [_hold(0.0, missing_s)] if missing_s > 0.01 else []
        program = make_program([*parts, *filling, make_vent(command_v)], seed * count + number + 1)
        yield DrawnProgram(program, tuple(blocks))


def sample_commands(program: ProgramSettings, period_s: float) -> NDArray[np.float64]:
    """Return the command of each tick (V), shape (n,)."""
    return sample_levels(plan_experiment(program).segments, period_s)


def sample_levels(levels: Sequence[Segment], period_s: float) -> NDArray[np.float64]:
    """Return the command of each tick (V), shape (n,): a level begins with the tick that is due."""
    due = accumulate(level.duration_s for level in levels)
    ends = [math.ceil(t / period_s - 1e-6) for t in due]
    return np.repeat([level.valve_v for level in levels], np.diff([0, *ends]))


def _fit_into(room_s: float, blocks: Sequence[Block]) -> Sequence[Block]:
    """Return the first blocks that last no longer; at least one."""
    ends_s = accumulate(map(_measure_s, blocks))
    return blocks[: max(1, sum(1 for _ in takewhile(lambda end_s: end_s <= room_s, ends_s)))]


def _draw_block(drawn: random.Random, largest_v: float) -> Block:
    kinds: tuple[Callable[[random.Random, float], Block], ...] = (
        _draw_square,
        _draw_staircase,
        _draw_multisine,
        _draw_chirp,
        _draw_bursts,
        _draw_ramps,
    )
    return drawn.choice(kinds)(drawn, largest_v)


def _draw_square(drawn: random.Random, largest_v: float) -> list[Part]:
    hz = _spread(drawn, 0.5, 8.0)
    size_v = drawn.choice((largest_v, _spread(drawn, 0.3 * largest_v, largest_v)))
    cycles = max(1, round(drawn.uniform(1.0, 3.0) * hz))
    return [{"wave": "square", "frequency_hz": hz, "amplitude_v": size_v, "cycles": cycles}]


def _draw_staircase(drawn: random.Random, largest_v: float) -> list[Part]:
    most_v = min(3.0, largest_v)
    levels = [_spread(drawn, 0.02 * most_v, most_v) for _ in range(drawn.randint(2, 6))]
    hold_s = _spread(drawn, 0.08, 0.25)
    return [_lift(drawn, largest_v), {"wave": "staircase", "levels_v": levels, "hold_s": hold_s}]


def _draw_multisine(drawn: random.Random, largest_v: float) -> list[Part]:
    part = {
        "wave": "multisine",
        "low_hz": _spread(drawn, 0.3, 2.0),
        "high_hz": _spread(drawn, 8.0, 120.0),
        "amplitude_v": _spread(drawn, 0.06 * largest_v, largest_v),
        "duration_s": round(drawn.uniform(2.0, 5.0), 1),
        "tones": 12,
        "bias_v": round(drawn.uniform(-0.05, 0.1), 3),
    }
    return [_lift(drawn, largest_v), part]


def _draw_chirp(drawn: random.Random, largest_v: float) -> list[Part]:
    part = {
        "wave": "chirp",
        "low_hz": _spread(drawn, 0.5, 10.0),
        "high_hz": _spread(drawn, 30.0, 200.0),
        "amplitude_v": _spread(drawn, 0.1 * largest_v, largest_v),
        "duration_s": round(drawn.uniform(2.0, 5.0), 1),
    }
    return [_lift(drawn, largest_v), part]


def _draw_bursts(drawn: random.Random, largest_v: float) -> list[Part]:
    parts = []
    for _ in range(drawn.randint(1, 3)):
        parts.append(_lift(drawn, drawn.choice((largest_v, largest_v, -largest_v))))
        parts.append(_hold(0.0, drawn.uniform(0.6, 2.5)))
    return parts


def _draw_ramps(drawn: random.Random, largest_v: float) -> list[Part]:
    size_v = _spread(drawn, 0.01 * largest_v, 0.12 * largest_v)
    up_s, down_s = drawn.uniform(0.5, 2.0), drawn.uniform(0.5, 2.0)
    return [_lift(drawn, largest_v), _hold(size_v, up_s), _hold(-size_v, down_s)]


def _lift(drawn: random.Random, valve_v: float) -> Part:
    """Return a burst that moves the pressure to another level."""
    duration_s = round(_spread(drawn, 0.01, 0.1), 3)
    return {"wave": "hold", "valve_v": valve_v, "duration_s": duration_s}


def _hold(valve_v: float, duration_s: float) -> Part:
    return {"wave": "hold", "valve_v": _shorten(valve_v), "duration_s": round(duration_s, 2)}


def _measure_s(parts: Sequence[Part]) -> float:
    """Return how long parts last."""
    return sum(map(_measure_part_s, parts))


def _measure_part_s(part: Part) -> float:
    if part["wave"] == "square":
        return float(part["cycles"] / part["frequency_hz"])
    if part["wave"] == "staircase":
        return float(4 * len(part["levels_v"]) * part["hold_s"])
    return float(part["duration_s"])


def _spread(drawn: random.Random, low: float, high: float) -> float:
    """Draw a number evenly over the octaves, with three digits: people read the file."""
    number = _shorten(low * (high / low) ** drawn.random())
    return min(number, high)


def _shorten(number: float) -> float:
    if number == 0.0:
        return 0.0
    digits = 2 - math.floor(math.log10(abs(number)))
    return round(number, digits)


SPARE_SHARE = 0.03
"""A program keeps this share of what a limit allows to itself: a model is not the rig."""


class ProgramRun(NamedTuple):
    """What a plant would do under a program, without the faults of the measuring chain."""

    pressure_pa: Array
    position_m: Array


DATA_SHEETS = calibration(CalibrationSettings())
MOST_V = 5.0
"""The largest command of an experiment file."""


@dataclass(frozen=True)
class RigLimits:
    """What a program may ask of this rig: the rig file's limits, or what the records reached."""

    command_v: float
    pressure_pa: float
    low_m: float
    high_m: float
    safety: Limits | None = None
    """All rules of the rig's safety; None where no log says them."""
    calibration: Calibration = DATA_SHEETS
    sensor_zero_v: float = 0.0
    """What the pressure sensor shows at atmospheric pressure."""
    spare_share: float = SPARE_SHARE
    source: str = "the rig's limits"

    def allows(self, run: ProgramRun) -> bool:
        """Tell whether a run's highest pressure and its stroke stay inside, quickly."""
        spare_pa = self.spare_share * (self.pressure_pa - self.calibration.atmospheric_pressure_pa)
        spare_m = self.spare_share * (self.high_m - self.low_m)
        finite = np.isfinite(run.pressure_pa).all() and np.isfinite(run.position_m).all()
        return bool(
            finite
            and run.pressure_pa.max() <= self.pressure_pa - spare_pa
            and run.position_m.max() <= self.high_m - spare_m
            and run.position_m.min() >= min(self.low_m + spare_m, 0.0)
        )

    def admits(self, commands_v: Array, run: ProgramRun, period_s: float) -> bool:
        """Tell whether the rig's safety, tick by tick, would let a whole run pass."""
        if self.safety is None:
            return True
        state = INITIAL_SAFETY_STATE._replace(
            valve_v=float(commands_v[0]),
            position_m=float(run.position_m[0]),
            model_pressure_pa=float(run.pressure_pa[0]),
        )
        tripped = np.zeros(1)
        machine(rehearse)(
            self.safety, state, self.calibration, Zero(self.sensor_zero_v, 0.0), commands_v,
            run.pressure_pa, run.position_m, period_s, tripped,
        )  # fmt: skip
        return not tripped.any()


def rehearse(
    limits: Limits,
    state: SafetyState,
    cal: Calibration,
    zero: Zero,
    commands_v: Array,
    pressures_pa: Array,
    positions_m: Array,
    period_s: float,
    tripped: Array,
) -> None:
    """Kernel: let safety judge the ticks of a run; `tripped`, shape (1,), gets 1 if it trips."""
    for tick in range(len(commands_v)):
        command_v, pressure_pa = commands_v[tick], pressures_pa[tick]
        decision, state = admit(
            limits,
            state,
            RawSample(sensor_v(cal, zero, pressure_pa), 0, 0, 0),
            Measurement(positions_m[tick], pressure_pa),
            make_valve_reference(int(Phase.OPEN_LOOP), command_v),
            Estimate(0.0, 0.0, 0.0, 0.0, 0.0),
            Command(command_v, math.nan, math.nan, math.nan, False),
            Timing(tick, tick * period_s, period_s, 0.0, 0),
        )
        if decision.tripped:
            tripped[0] = 1.0
            break


def find_rig_limits(records: Sequence[Record]) -> RigLimits:
    """Return the limits of the rig that made the newest log; else what the records reached."""
    for record in reversed(records):
        if record.settings.get("rig"):
            try:
                return read_rig_limits(record.settings, record.name)
            except ConfigError:
                continue  # an older log, whose settings no longer hold
    return RigLimits(
        min(max(float(np.max(np.abs(r["valve_v"]))) for r in records), MOST_V),
        max(float(np.max(r["pressure_pa"])) for r in records),
        min(float(np.min(r["position_m"])) for r in records),
        max(float(np.max(r["position_m"])) for r in records),
        spare_share=0.0,
        source="what the records reached",
    )


def read_rig_limits(resolved: Mapping[str, Any], name: str) -> RigLimits:
    """Return the limits of a run's resolved settings; raises `ConfigError`."""
    settings = from_resolved(json.dumps(dict(resolved)), name)
    setup = build_tick_setup(settings)
    limits = setup.limits
    return RigLimits(
        min(limits.command_v, MOST_V),
        limits.pressure_pa,
        limits.stroke_low_m,
        limits.stroke_high_m,
        limits,
        setup.calibration,
        settings.rig.calibration.sensor_zero_v,
    )
