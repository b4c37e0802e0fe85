"""Records with a wrong column corrected, for the coupled gap and the figures."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pamctl.diagnose.measured.record import Array, Record
from pamctl.diagnose.setup.altered_drive import interpolate_smoothly
from pamctl.diagnose.setup.suspects import (
    ATMOSPHERE,
    READ_BACK,
    Suspect,
    act_earlier,
    put_back_commands,
    restore_command,
    straighten,
)
from pamctl.plant.model import PlantSettings


def mend_record(record: Record, suspect: Suspect, amount: float, nominal: PlantSettings) -> Record:
    """Return the record as it would be without the fault; unchanged where no column is wrong."""
    kind, column = suspect.kind, suspect.number
    if column == ATMOSPHERE and suspect.variant == "gauge" and record.pressure_pa is not None:
        shift_pa = amount * nominal.parameters.atmospheric_pressure_pa
        return replace(record, pressure_pa=record.pressure_pa + shift_pa)
    if column == "t_s":
        return replace(record, t_s=record.t_s / (1.0 + amount))
    if column not in record.channels:
        return record
    values, t_s = record[column], record.t_s
    if kind == "gauge":
        return replace(record, pressure_pa=values - amount)
    if kind == "bow":
        return replace(record, pressure_pa=straighten(values, suspect.between, amount))
    if kind == "null_offset":
        held_v = None if record.held_v is None else record.held_v - amount
        return replace(record, valve_v=values - amount, held_v=held_v)
    if kind == "decimated_command":
        return replace(record, valve_v=restore_command(values, round(amount)))
    if kind in ("scale", "sign"):
        if column == "valve_v" and record.held_v is not None:
            record = replace(record, held_v=record.held_v / (1.0 + amount))
        return _with_column(record, column, values / (1.0 + amount))
    if suspect.variant == READ_BACK:
        return replace(record, valve_v=put_back_commands(values, t_s, amount))
    if kind in ("skew", "clock_rate"):
        late_s = amount * (np.ones_like(t_s) if kind == "skew" else t_s - t_s[0])
        if column == "valve_v":
            return replace(record, acts_after_s=act_earlier(record.acts_after_s, late_s))
        return _with_column(record, column, interpolate_smoothly(t_s + late_s, t_s, values))
    return record


def _with_column(record: Record, column: str, values: Array) -> Record:
    changed: dict[str, Any] = {column: values}
    return replace(record, **changed)
