"""Which settings differ between runs, and what a run has for one."""

from __future__ import annotations

from collections.abc import Sequence

from pamctl.runs.run_row import RunRow

SettingValue = str | int | float | bool | None


def read_value(row: RunRow, key: str) -> SettingValue:
    """Return a setting of a run by its dotted key; None if the run does not have it."""
    value: SettingValue = row.sweep.get("point", {}).get(key, row.gains.get(key))
    return value


def find_varying_keys(rows: Sequence[RunRow], *, numbers_only: bool = True) -> list[str]:
    """Return the keys whose values differ: those of sweeps first, then in the order of the file.

    The seed is left out: it differs between repeats.
    """
    swept = dict.fromkeys(key for row in rows for key in row.sweep.get("point", {}))
    keys = [*swept, *dict.fromkeys(k for row in rows for k in row.gains if k not in swept)]
    return [key for key in keys if key != "seed" and _varies(rows, key, numbers_only=numbers_only)]


def _varies(rows: Sequence[RunRow], key: str, *, numbers_only: bool) -> bool:
    values = {read_value(row, key) for row in rows} - {None}
    return len(values) > 1 and (not numbers_only or all(map(is_number, values)))


def is_number(value: SettingValue) -> bool:
    """Tell whether a value has a place on an axis."""
    return isinstance(value, int | float) and not isinstance(value, bool)
