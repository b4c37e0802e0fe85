"""What may be wrong about a set-up: numbers of the plant file, and columns of the record.

A suspect is one number. At zero it changes nothing; `apply` says how a drive looks with it. The
list is made for the plant and the blocks at hand: a suspect that changes nothing is not asked.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE, Drive
from pamctl.diagnose.fitting.evidence import Evidence
from pamctl.diagnose.fitting.numbers import (
    AREA,
    calibration_of,
    list_plant_numbers,
    value_of,
)
from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.setup.altered_drive import (
    PlantChange,
    add_change,
    alter,
    interpolate_smoothly,
)
from pamctl.plant.drive import SAME_INSTANT_S
from pamctl.plant.model import PlantSettings

Kind = Literal[
    "plant_constant",
    "null_offset",
    "sign",
    "skew",
    "clock_rate",
    "decimated_command",
    "scale",
    "gauge",
    "bow",
    "filtered",
    "drift",
    "change_at_instant",
]

ATMOSPHERE = "atmospheric_pressure_pa"
OF_RECORD = "of each record"
"""Variant of a change over time: its times are shares of each record's length."""
READ_BACK = "read back"
"""Variant of a late command: the log read back what the valve held (`late_commands.py`)."""
GASES = {"heat_capacity_ratio": (1.28, 1.42)}
"""From carbon dioxide to air, with room for an estimate's error. No other gas drives muscles: what
needs another ratio has another cause."""
LOWEST_ATMOSPHERE_PA, HIGHEST_ATMOSPHERE_PA = 55e3, 105e3
"""From the highest laboratories to high pressure at sea level."""


_LABELS = {
    "plant_constant": "", "skew": "skew of ", "clock_rate": "clock of ", "filtered": "filter of ",
    "drift": "drift of ", "change_at_instant": "change of ", "scale": "scale of ",
    "null_offset": "null offset of ", "sign": "sign of ", "bow": "bow of ",
}  # fmt: skip


def label_number(kind: Kind, number: str) -> str:
    """Name what may be wrong about a number, in a few words: `scale of position_m`."""
    return f"{_LABELS.get(kind, '')}{number}"


@dataclass(frozen=True)
class Suspect:
    """One number of the set-up, with its range and the steps that show it."""

    kind: Kind
    number: str
    """A number of the plant file, or a column of the record."""
    unit: str
    low: float
    high: float
    doses: tuple[float, ...]
    """Amounts to try: small ones and large ones, of both signs where both are possible."""
    scale: float
    """A step of this size is small but visible."""
    blocks: frozenset[str]
    variant: str = ""
    always_equal: tuple[str, ...] = ()
    """Labels of other suspects that the equations make equal to this one."""
    record: str = ""
    """The record that a change belongs to; empty for all records."""
    over_s: float = 0.0
    """Above 0: grows from nothing at the start of a record to the amount after this time."""
    after_s: float = 0.0
    """Above 0: acts from this instant of a record on."""
    is_rare: bool = False
    """Said only where no effect explains as much."""
    between: tuple[float, float] = (0.0, 1.0)
    """The ends of a bowed reading, where it is right."""

    @property
    def key(self) -> tuple[str, ...]:
        """Identify the suspect, whatever its amount."""
        return (self.kind, self.number, self.variant, self.record)

    @property
    def label(self) -> str:
        """Name it for a list of what cannot be told apart."""
        variant = f" ({self.variant} sensor)" if self.number == ATMOSPHERE else ""
        return f"{label_number(self.kind, self.number)}{variant}"

    @property
    def is_timed(self) -> bool:
        """Tell whether the number acts for a part of the records only."""
        return bool(self.record or self.over_s or self.after_s)

    def apply(self, drive: Drive, amount: float) -> Drive:
        """Return the drive as it is with this amount."""
        if amount == 0.0 or drive.block not in self.blocks:
            return drive
        if self.record and drive.name != self.record:
            return drive
        return _ACTIONS[self.kind](self, drive, amount)


def _change_constant(suspect: Suspect, drive: Drive, amount: float) -> Drive:
    if suspect.number == "valve_v":
        return _move_null(suspect, drive, amount)
    # With the variant, times are shares of the record's length.
    unit_s = float(np.sum(drive.step_s)) if suspect.variant == OF_RECORD else 1.0
    change = PlantChange(suspect.number, amount, unit_s * suspect.over_s, unit_s * suspect.after_s)
    if suspect.number == ATMOSPHERE and suspect.variant == "gauge":
        if drive.block == MECHANICS:
            return drive  # only the gauge pressure acts, and that is right
        return alter(add_change(drive, change), reads_gauge=True)
    return add_change(drive, change)


def _move_null(suspect: Suspect, drive: Drive, amount: float) -> Drive:
    offset_v = amount * _profile(suspect, drive)
    held_v = None if drive.held_v is None else drive.held_v - float(offset_v[0])
    return replace(drive, valve_v=drive.valve_v - offset_v, held_v=held_v)


def _profile(suspect: Suspect, drive: Drive) -> Array:
    """Return how much of an amount acts at each sample."""
    t_s = drive.times_s
    t_s = t_s / t_s[-1] if suspect.variant == OF_RECORD else t_s
    if suspect.over_s:
        return np.asarray(t_s / suspect.over_s)
    return np.asarray(t_s >= suspect.after_s, dtype=np.float64)


def _shift_column(suspect: Suspect, drive: Drive, amount: float) -> Drive:
    """Make a column late by `amount` seconds, or each second later by `amount`."""
    if suspect.number == "t_s":
        return replace(drive, step_s=drive.step_s / (1.0 + amount))
    late_s, per_s = (0.0, amount) if suspect.kind == "clock_rate" else (amount, 0.0)
    column = suspect.number
    if suspect.variant == READ_BACK:
        return replace(drive, valve_v=put_back_commands(drive.valve_v, drive.times_s, late_s))
    if column != drive.channel:
        return _shift_input(drive, column, late_s, per_s)
    if drive.has_known_start:
        before = alter(drive)
        return alter(drive, late_s=before.late_s + late_s, late_per_s=before.late_per_s + per_s)
    # Windows start from the measured output, at its instants: all others are early.
    for other in ("valve_v", "position_m", "force_n", "pressure_pa"):
        if other != column:
            drive = _shift_input(drive, other, -late_s, -per_s)
    return drive


def _shift_input(drive: Drive, column: str, late_s: float, per_s: float) -> Drive:
    t_s = drive.times_s
    shift_s = late_s + per_s * t_s
    if column == "valve_v":
        return replace(drive, acts_after_s=act_earlier(drive.acts_after_s, shift_s))
    field_name = _find_input(drive, column)
    if field_name is None:
        return drive
    shifted: Any = interpolate_smoothly(t_s + shift_s, t_s, getattr(drive, field_name))
    return replace(drive, **{field_name: shifted})


def act_earlier(acts_after_s: Array | None, shift_s: Array) -> Array:
    """Return when commands act whose column is late: they acted before they were shown."""
    return -shift_s if acts_after_s is None else acts_after_s - shift_s


def _find_input(drive: Drive, column: str) -> str | None:
    """Return the field of a drive that a column other than the command is the input of."""
    if column == "pressure_pa" and drive.pressed_pa is not None:
        return "pressed_pa"
    if drive.is_equation:
        return "driven" if column == "position_m" else None
    if drive.block == PRESSURE:
        return "driven" if column == "position_m" and drive.has_position else None
    return "driven" if column in ("force_n", "pressure_pa") else None


def _scale_column(suspect: Suspect, drive: Drive, amount: float) -> Drive:
    """Let a column show (1 + amount) times what is true."""
    gain, column = 1.0 + amount, suspect.number
    if column == AREA:
        return add_change(drive, PlantChange(AREA, amount * suspect.scale))
    if column == "valve_v":
        held_v = None if drive.held_v is None else drive.held_v / gain
        return replace(drive, valve_v=drive.valve_v / gain, held_v=held_v)
    if column == drive.channel:
        start = drive.start / gain if column == "position_m" else drive.start
        return alter(drive, gain=alter(drive).gain * gain, start=start)
    field_name = _find_input(drive, column)
    if field_name is None:
        return drive
    return replace(drive, **{field_name: getattr(drive, field_name) / gain})


def _shift_pressure(suspect: Suspect, drive: Drive, amount: float) -> Drive:
    """Let the pressure show `amount` more than is true."""
    if drive.block == PRESSURE:
        return replace(drive, measured=drive.measured - amount, start=drive.start - amount)
    return replace(drive, driven=drive.driven - amount)


def _straighten_pressure(suspect: Suspect, drive: Drive, amount: float) -> Drive:
    """Let the pressure show `amount` more than is true in the middle between the ends."""
    field_name = "measured" if drive.block == PRESSURE else "driven"
    straight: Any = straighten(getattr(drive, field_name), suspect.between, amount)
    return replace(drive, **{field_name: straight})


def straighten(shown: Array, between: tuple[float, float], amount: float) -> Array:
    """Return a bowed reading without its parabola of a height `amount`."""
    share = (shown - between[0]) / (between[1] - between[0])
    return np.asarray(shown - amount * 4.0 * share * (1.0 - share))


def _filter_output(suspect: Suspect, drive: Drive, amount: float) -> Drive:
    """Filter what the model shows as the column was filtered; an input stays as it is."""
    if suspect.number != drive.channel:
        return drive
    return alter(drive, filtered_hz=1.0 / (2.0 * np.pi * amount))


def _restore_command(suspect: Suspect, drive: Drive, amount: float) -> Drive:
    return replace(drive, valve_v=restore_command(drive.valve_v, round(amount)))


def find_decimation(valve_v: np.ndarray) -> int:
    """Return how many samples each command of a lively record is held; 1 where none is visible.

    A record counts only where most of the possible instants show a change: a square wave changes
    rarely, and says nothing about the rate of its log.
    """
    changes = np.flatnonzero(np.diff(valve_v)) + 1
    if len(changes) < 20:
        return 1
    held = int(np.gcd.reduce(np.diff(changes)))
    span = changes[-1] - changes[0]
    return held if held > 1 and len(changes) > 0.5 * span / held else 1


def restore_command(valve_v: np.ndarray, held: int) -> np.ndarray:
    """Return the command between the rows at which it was logged, where it ran smoothly.

    Between two rows that differ by much more than usual the command stays as it was logged.
    """
    changes = np.flatnonzero(np.diff(valve_v)) + 1
    if held < 2 or not len(changes):
        return valve_v
    from scipy.interpolate import CubicSpline  # slow to import

    first = int(changes[0]) % held
    knots = np.arange(first, len(valve_v), held)
    restored = CubicSpline(knots, valve_v[knots])(np.arange(len(valve_v)))
    steps = np.abs(np.diff(valve_v[knots]))
    usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    jumps = np.append(steps > 6.0 * usual, True)  # a step stays a step
    held_here = jumps[np.clip((np.arange(len(valve_v)) - first) // held, 0, len(knots) - 1)]
    return np.asarray(np.where(held_here | (np.arange(len(valve_v)) < first), valve_v, restored))


def find_shown_rows(t_s: Array, late_s: float) -> NDArray[np.intp]:
    """Return the row whose command was held `late_s` before each row, shape (n,)."""
    rows = np.searchsorted(t_s, t_s - late_s + SAME_INSTANT_S, "right") - 1
    return np.asarray(np.clip(rows, 0, len(t_s) - 1))


def put_back_commands(valve_v: Array, t_s: Array, late_s: float) -> Array:
    """Return the commands in their own rows; what no row shows is between its neighbours."""
    rows, first = np.unique(find_shown_rows(t_s, late_s), return_index=True)
    return np.asarray(np.interp(np.arange(len(t_s)), rows, valve_v[first]))


_ACTIONS = {
    "plant_constant": _change_constant,
    "drift": _change_constant,
    "change_at_instant": _change_constant,
    "null_offset": _move_null,
    "skew": _shift_column,
    "clock_rate": _shift_column,
    "scale": _scale_column,
    "sign": _scale_column,
    "decimated_command": _restore_command,
    "gauge": _shift_pressure,
    "bow": _straighten_pressure,
    "filtered": _filter_output,
}

# Turns and temperature are not here: a recalibration imitates them exactly (`symmetries.py`).
CONSTANTS: dict[str, tuple[frozenset[str], float]] = {
    # name: (blocks that show it, step of a small change as a share)
    "rest_length_m": (frozenset({PRESSURE, MECHANICS}), 2e-3),
    "braid_length_m": (frozenset({PRESSURE, MECHANICS}), 2e-3),
    "tank_pressure_pa": (frozenset({PRESSURE}), 1e-2),
    "heat_capacity_ratio": (frozenset({PRESSURE}), 1e-2),
    "valve_gain_m2_per_v": (frozenset({PRESSURE}), 1e-2),
    "mass_kg": (frozenset({MECHANICS}), 0.2),
    "damping_n_s_per_m": (frozenset({MECHANICS}), 1e-2),
    "stiffness_n_per_m": (frozenset({MECHANICS}), 1e-2),
    "kinetic_friction_per_m": (frozenset({MECHANICS}), 1e-2),
}
UNITS = {
    "rest_length_m": "m",
    "braid_length_m": "m",
    "braid_turns": "",
    "tank_pressure_pa": "Pa",
    "heat_capacity_ratio": "",
    "temperature_k": "K",
    "valve_gain_m2_per_v": "m^2/V",
    "mass_kg": "kg",
    "damping_n_s_per_m": "N s/m",
    "stiffness_n_per_m": "N/m",
    "kinetic_friction_per_m": "1/m",
    ATMOSPHERE: "Pa",
    "chamber_leak.area_m2": "m^2",
}


def list_suspects(evidence: Evidence, at_bound: Collection[str] = ()) -> tuple[Suspect, ...]:
    """Return what to ask about these records and this plant.

    A number that is recalibrated anyway is asked only where it is at a bound of its range.
    """
    return tuple(
        replace(s, blocks=s.blocks & {*evidence.blocks})
        for s in (*_list_constants(evidence.nominal, at_bound), *_list_columns(evidence))
        if s.blocks & {*evidence.blocks}
    )


def _list_constants(nominal: PlantSettings, at_bound: Collection[str]) -> Iterator[Suspect]:
    acting = list_plant_numbers(nominal)
    free = {n for block in (PRESSURE, MECHANICS) for n in calibration_of(block, nominal)}
    for name, (blocks, scale) in CONSTANTS.items():
        if name not in acting or not value_of(nominal, name):
            continue
        if name in free and name not in at_bound:
            continue
        doses = (scale, -scale, 5.0 * scale, -5.0 * scale)
        low, high = (-0.15, 0.15) if name.endswith("length_m") else (-0.6, 1.5)
        if name == "mass_kg" or nominal.actuator == "direct":
            low, high = -0.97, 30.0
        yield Suspect("plant_constant", name, UNITS[name], low, high, doses, scale, blocks)
    if nominal.actuator != "direct":
        usual = nominal.parameters.atmospheric_pressure_pa
        low, high = LOWEST_ATMOSPHERE_PA / usual - 1.0, HIGHEST_ATMOSPHERE_PA / usual - 1.0
        for variant in ("gauge", "absolute"):
            yield Suspect(
                "plant_constant",
                ATMOSPHERE,
                "Pa",
                low,
                high,
                (-0.01, 0.01, -0.08),
                5e-3,
                frozenset({PRESSURE, MECHANICS} if variant == "absolute" else {PRESSURE}),
                variant,
            )


def _list_columns(evidence: Evidence) -> Iterator[Suspect]:
    if evidence.nominal.actuator == "direct":
        yield from _list_axis_columns(evidence)
        return
    yield from _list_filters(evidence)
    both, blocks = frozenset({PRESSURE, MECHANICS}), {*evidence.blocks}
    moves = evidence.nominal.actuator == "muscle"
    period_s = _period_s(evidence)
    widest_v = 0.0
    if PRESSURE in blocks:
        widest_v = max(float(np.max(np.abs(d.valve_v))) for d in evidence.train[PRESSURE])
    if widest_v:
        null = 0.1 * widest_v
        doses = (0.02 * null, -0.02 * null, 0.2 * null, -0.2 * null)
        yield Suspect(
            "null_offset", "valve_v", "V", -null, null, doses, 0.02 * null, frozenset({PRESSURE})
        )
        # Where nothing moves, command and pressure are all that there is.
        other = () if moves else ("skew of pressure_pa",)
        early = _skew("valve_v", frozenset({PRESSURE}), period_s, sign=-1.0)
        yield replace(early, always_equal=other)
        yield _rate("valve_v", frozenset({PRESSURE}))
    if moves and (widest_v or blocks == both):
        yield _skew("pressure_pa", both, period_s)
        yield _rate("pressure_pa", both)
    if moves and blocks == both:
        yield _bow(evidence)
    if moves and MECHANICS in blocks:  # numbers hide a wrong time, but for the friction's (Eq. 5)
        yield Suspect(
            "clock_rate", "t_s", "1", -0.05, 0.05, (0.01, -0.01), 5e-3, both, is_rare=True
        )
    if blocks == both:
        doses = (0.01, -0.01, 0.05, -0.05)
        yield Suspect("scale", "position_m", "1", -0.6, 1.5, doses, 0.01, both)
        yield _skew("position_m", both, period_s)
        yield _rate("position_m", both)


def _list_axis_columns(evidence: Evidence) -> Iterator[Suspect]:
    """Yield the columns of a mechanism that a measured force, a piston or both drive.

    A column is late against the others: with one input, input and position are equal suspects.
    Scales show only where a number is known that they would change.
    """
    own, nominal = frozenset({MECHANICS}), evidence.nominal
    pressed = any(d.pressed_pa is not None for d in evidence.train.get(MECHANICS, ()))
    inputs = [c for c in ("force_n", "pressure_pa") if c in evidence.noises]
    inputs = [c for c in inputs if c == "force_n" or pressed]
    alone = len(inputs) == 1
    for column in (*inputs, *(() if alone else ("position_m",))):
        skew, rate = _skew(column, own, _period_s(evidence)), _rate(column, own)
        for suspect, word in ((skew, "skew"), (rate, "clock")):
            yield replace(suspect, always_equal=(f"{word} of position_m",) if alone else ())
    if {"mass_kg", "damping_n_s_per_m", "stiffness_n_per_m", "piston.area_m2"} & {*nominal.known}:
        for column in ("force_n", "position_m"):
            if column in evidence.noises:
                doses = (0.02, -0.02, 0.2, -0.2)
                yield Suspect("scale", column, "1", -0.97, 30.0, doses, 0.01, own)


def _list_filters(evidence: Evidence) -> Iterator[Suspect]:
    """Yield the channels that look filtered: forwards and backwards, to second order."""
    for block, drives in evidence.train.items():
        if drives[0].channel in evidence.filtered:
            shortest_s = 1.5 * _period_s(evidence) / np.pi
            doses = tuple(times * shortest_s for times in (2.0, 5.0, 12.0))
            yield Suspect(
                "filtered", drives[0].channel, "s", shortest_s, 40.0 * shortest_s, doses,
                0.2 * shortest_s, frozenset({block}),
            )  # fmt: skip


def _period_s(evidence: Evidence) -> float:
    return float(np.median(next(iter(evidence.train.values()))[0].step_s))


def _skew(
    column: str,
    blocks: frozenset[str],
    period_s: float,
    sign: float = 1.0,
) -> Suspect:
    """Return the suspect that a column is late: by milliseconds, or by some samples."""
    unit_s = max(period_s, 1e-3)
    doses = tuple(sign * d * unit_s for d in (0.5, -0.5, 2.0, -2.0))
    most_s = 12.0 * unit_s
    return Suspect("skew", column, "s", -most_s, most_s, doses, 0.2 * unit_s, blocks)


def _bow(evidence: Evidence) -> Suspect:
    """Return the suspect that the pressure sensor is not linear; its range covers the supply."""
    parameters = evidence.nominal.parameters
    shown_pa = max(float(np.max(d.measured)) for d in evidence.train[PRESSURE])
    between = parameters.atmospheric_pressure_pa, max(shown_pa, parameters.tank_pressure_pa)
    unit_pa = 1e-3 * (between[1] - between[0])
    doses = tuple(times * unit_pa for times in (2.0, -2.0, 10.0, -10.0))
    both, most_pa = frozenset({PRESSURE, MECHANICS}), 60.0 * unit_pa
    return Suspect(
        "bow", "pressure_pa", "Pa", -most_pa, most_pa, doses, unit_pa, both, between=between
    )


def _rate(column: str, blocks: frozenset[str]) -> Suspect:
    doses = (1e-4, -1e-4)
    return Suspect("clock_rate", column, "1", -5e-3, 5e-3, doses, 5e-5, blocks)
