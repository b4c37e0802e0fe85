"""Undo what is known of sensors and valve, around the law: a stage of the tick, off by default.

    shown position and pressure -> corrected ones -> filters, law
    command of the law          -> command at which the known valve opens as far -> safety

Both are plain numbers, made when the run is set up, so that no law and no tick reaches the plant.
Without a compensation (None) the tick computes what it did before there was this stage.
"""

from __future__ import annotations

from math import isfinite, isnan, sqrt
from typing import NamedTuple

from pamctl.signals import Command, Compensated, Measurement, Reference

CELLS = 32
"""Cells of a side of the valve's table. They are finest at null, and grow with the command."""


class Compensation(NamedTuple):
    """Numbers of the stage."""

    position_scale: float
    """The corrected displacement is `position_scale` times the shown one, plus the offset."""
    position_offset_m: float
    pressure_scale: float
    """The same for the absolute pressure."""
    pressure_offset_pa: float
    reach_v: float
    """Command of the law at the end of the tables."""
    fill_v: tuple[float, ...]
    """Commands for `reach_v * (i / CELLS)^2`, i from 0 to CELLS; they never fall."""
    exhaust_v: tuple[float, ...]
    """The same for the negative commands of the law; they never rise."""


def correct_measurement(compensation: Compensation | None, measurement: Measurement) -> Measurement:
    """Return displacement and pressure as ideal sensors would show them."""
    if compensation is None:
        return measurement
    return Measurement(
        compensation.position_scale * measurement.position_m + compensation.position_offset_m,
        compensation.pressure_scale * measurement.pressure_pa + compensation.pressure_offset_pa,
    )


def compensate_command(
    compensation: Compensation | None, reference: Reference, command: Command
) -> Command:
    """Return the command at which the valve opens as far as the law wants it to.

    An open-loop command is a voltage for the valve itself, and stays as it is.
    """
    if compensation is None:
        return command
    if not isnan(reference.reference_valve_v) or not isfinite(command.command_v):
        return command
    return Command(
        find_command_v(compensation, command.command_v),
        command.surface_m_per_s2,
        command.equivalent_v,
        command.robust_v,
        command.saturated,
    )


def find_command_v(compensation: Compensation, wanted_v: float) -> float:
    """Interpolate the table of the command's side; beyond its end the last command holds."""
    share = abs(wanted_v) / compensation.reach_v
    if share >= 1.0:
        return compensation.fill_v[CELLS] if wanted_v > 0.0 else compensation.exhaust_v[CELLS]
    cell = min(int(CELLS * sqrt(share)), CELLS - 1)
    along = (share * CELLS * CELLS - cell * cell) / (2 * cell + 1)
    if wanted_v > 0.0:
        begin_v, end_v = compensation.fill_v[cell], compensation.fill_v[cell + 1]
    else:
        begin_v, end_v = compensation.exhaust_v[cell], compensation.exhaust_v[cell + 1]
    return begin_v + along * (end_v - begin_v)


def follow_compensation(
    compensation: Compensation | None,
    last: Compensated | None,
    corrected: Measurement,
    command: Command,
) -> Compensated | None:
    """Return the columns that the stage adds to the log; `last` are those of the last tick."""
    if compensation is None:
        return last  # None: compiled code needs one type from both branches
    return Compensated(command.command_v, corrected.position_m, corrected.pressure_pa)


def list_wanted_v(reach_v: float) -> list[float]:
    """Return the commands of the law at which a table has its values, from null outwards."""
    return [reach_v * (i / CELLS) ** 2 for i in range(CELLS + 1)]


def limit_slope(commands_v: list[float], reach_v: float, steepest: float) -> tuple[float, ...]:
    """Return a table that rises by no more than `steepest` volts a volt, from null outwards.

    The exact inverse of a dead band jumps at null: a law would chatter there.
    """
    wanted_v = list_wanted_v(reach_v)
    limited = [commands_v[0]]
    for i in range(CELLS):
        most = steepest * abs(wanted_v[i + 1] - wanted_v[i])
        change_v = commands_v[i + 1] - limited[i]
        limited.append(limited[i] + min(max(change_v, -most), most))
    return tuple(limited)
