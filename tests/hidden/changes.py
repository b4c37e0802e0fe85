"""The same records in other words: whatever is said of them must not change.

Each change takes (records to fit, records to judge by), the plant file and a number, and returns
what a user would hand in instead.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hidden.rig import Record
from hidden.rungs import Said
from hidden.score_list import Handed, Made, import_file

Plant = Mapping[str, Any]

GUESSED = ("mass_kg", "damping_n_s_per_m", "stiffness_n_per_m", "kinetic_friction_per_m")
"""Numbers that a user guesses; the others are measured with a rule, or stand on a plate."""

COLUMN_MAP = """
time: {column: time_ms, unit: ms}
valve: {column: valve_mv, unit: mV}
pressure: {column: pressure_bar, unit: bar, gauge: true}
position: {column: position_mm, unit: mm}
force: {column: force_kn, unit: kN}
"""
SCALES = {
    "t_s": ("time_ms", 1e3), "valve_v": ("valve_mv", 1e3), "pressure_pa": ("pressure_bar", 1e-5),
    "position_m": ("position_mm", 1e3), "force_n": ("force_kn", 1e-3),
}  # fmt: skip


def _each(change: Callable[[Record], list[Record]], handed: Handed) -> Handed:
    train, held_out = ([piece for r in part for piece in change(r)] for part in handed)
    return train, held_out


def _rows(record: Record, rows: slice, name: str = "") -> Record:
    cut = {key: column[rows] for key, column in record.columns().items()}
    cut["t_s"] = cut["t_s"] - cut["t_s"][0]
    return replace(record, name=name or record.name, **cut)


def cut(handed: Handed, plant: Plant, count: float) -> Made:
    """Cut each file into `count` of one length."""

    def pieces(r: Record) -> list[Record]:
        at = np.linspace(0, len(r.t_s), int(count or 2) + 1).astype(int)
        return [_rows(r, slice(*at[k : k + 2]), f"{r.name}-{k}") for k in range(len(at) - 1)]

    return _each(pieces, handed), plant


def half_rate(handed: Handed, plant: Plant, _: float) -> Made:
    """Log every second tick. The command between is then not in the file."""
    return _each(lambda r: [_rows(r, slice(None, None, 2))], handed), plant


def start_late(handed: Handed, plant: Plant, seconds: float) -> Made:
    """Leave the first seconds out."""

    def late(r: Record) -> list[Record]:
        return [_rows(r, slice(int(np.searchsorted(r.t_s, r.t_s[0] + (seconds or 1.0))), None))]

    return _each(late, handed), plant


def guess(handed: Handed, plant: Plant, factor: float) -> Made:
    """Type other guesses into the plant file."""
    numbers = dict(plant["parameters"])
    numbers |= {name: numbers[name] * factor for name in GUESSED if name in numbers}
    return handed, {**plant, "parameters": numbers}


def reorder(handed: Handed, plant: Plant, _: float) -> Made:
    """Hand the files in in another order."""
    return (handed[0][::-1], handed[1][::-1]), plant


def exchange(handed: Handed, plant: Plant, _: float) -> Made:
    """Fit on what judged, and judge by what was fitted."""
    return (handed[1], handed[0]), plant


def units(handed: Handed, plant: Plant, _: float) -> Made:
    """Write CSV files in ms, mV, bar of gauge pressure, mm and kN, and import them."""
    return _each(lambda r: [_through_file(r)], handed), plant


def _through_file(record: Record) -> Record:
    from pamctl.diagnose import record_of

    columns = dict(record.columns())
    if "pressure_pa" in columns:
        columns["pressure_pa"] = columns["pressure_pa"] - 101.3e3
    names = [SCALES[name][0] for name in columns]
    table = np.stack([column * SCALES[name][1] for name, column in columns.items()], axis=1)
    lines = COLUMN_MAP.strip().splitlines()
    with tempfile.TemporaryDirectory() as folder:
        path, column_map = Path(folder) / "run.csv", Path(folder) / "map.yaml"
        np.savetxt(path, table, "%.10g", ",", header=",".join(names), comments="")
        column_map.write_text("\n".join(x for x in lines if any(n in x for n in names)) + "\n")
        read = record_of(import_file(path, column_map))
    return Record(record.name, read.t_s, read.valve_v, read.pressure_pa, read.position_m,
                  read.force_n)  # fmt: skip


CHANGES: dict[str, Callable[[Handed, Plant, float], Made]] = {
    change.__name__: change
    for change in (cut, half_rate, start_late, guess, reorder, exchange, units)
}


def compare_said(plain: Said, other: Said) -> list[str]:
    """Return in words what differs: names, sets, places and kinds, numbers outside intervals."""
    found = []
    if (plain.names, set(plain.sets), plain.places) != (
        other.names, set(other.sets), other.places,
    ) or bool(plain.refusal) != bool(other.refusal):  # fmt: skip
        found.append(f"{plain.words()} -> {other.words()}")
    for name in sorted({*plain.numbers} & {*other.numbers}):
        (value, low, high), (its, its_low, its_high) = plain.numbers[name], other.numbers[name]
        if its_high < low or its_low > high:
            found.append(f"{name} {value:.4g} ({low:.4g} to {high:.4g}) -> {its:.4g} "
                         f"({its_low:.4g} to {its_high:.4g})")  # fmt: skip
    return found
