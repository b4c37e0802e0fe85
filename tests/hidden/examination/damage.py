"""Typical faults of users' files, applied to a record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hidden.examination.cases import Damage
from hidden.rig import Record


def damaged(record: Record, damage: Damage) -> Record:
    """Return the record with the faults of a careless user."""
    pressure, position = record.pressure_pa, record.position_m
    if pressure is None or position is None:
        raise ValueError("only a whole record can be damaged")
    if damage == "clipped":
        return replace(record, pressure_pa=np.minimum(pressure, 290e3))
    if damage == "millimetres":
        return replace(record, position_m=position * 1e3)
    if damage == "stuck":
        return replace(record, position_m=np.full_like(position, position[0]))
    if damage == "shifted":
        return replace(record, pressure_pa=np.roll(pressure, 40))
    if damage == "gap":
        kept = np.ones(len(pressure), dtype=np.bool_)
        kept[len(kept) // 2 : len(kept) // 2 + 400] = False
        return replace(record, **{name: c[kept] for name, c in record.columns().items()})
    return record
