"""Read a TDMS file: the channels of all groups, with their units and their times.

A channel is called by its own name if no other group has it, else `group/channel`. Its property
`unit_string` is its unit. A waveform's property `wf_increment` makes the time column.
"""

from __future__ import annotations

import logging
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from nptdms import TdmsFile

from pamctl.log.importing.measured_table import Floats, ImportRefused, MeasuredTable

TIME = "time_s"
MOST_VALUES = 250_000_000


class _Complaints(logging.Handler):
    """Keeps what the parser says of a damaged file."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.texts.append(record.getMessage())


def parse_tdms(path: Path) -> MeasuredTable:
    """Return the channels; raise ImportRefused if waveforms have different times."""
    complaints = _Complaints()
    for name in ("nptdms.reader", "nptdms.tdms_segment"):
        logging.getLogger(name).addHandler(complaints)
    with TdmsFile.open(path) as file:
        channels = [channel for group in file.groups() for channel in group.channels()]
        count = sum(len(channel) for channel in channels)
        if count > MOST_VALUES:
            raise ImportRefused(f"{path} is too large: {count} values; cut it into parts")
        names = Counter(channel.name for channel in channels)
        columns: dict[str, Floats] = {}
        units: dict[str, str] = {}
        waves: list[Any] = []
        for channel in channels:
            name = channel.name if names[channel.name] == 1 else _name_with_group(channel)
            values, unit = _read_values(channel)
            if values is None or not len(values):
                continue
            columns[name] = values
            units[name] = unit
            if "wf_increment" in channel.properties and not unit.startswith("s "):
                waves.append(channel)
        columns |= _make_time(path, columns, waves)
    if not columns:
        raise ImportRefused(f"{path} holds no channels of numbers")
    longest = max(map(len, columns.values()))
    stated = {name: unit.strip() for name, unit in units.items() if unit.strip()}
    notes = tuple(f"the file is damaged: {text}" for text in complaints.texts[:3])
    return MeasuredTable(columns, np.arange(1, longest + 1), units=stated, notes=notes)


def _name_with_group(channel: Any) -> str:
    return f"{channel.group_name}/{channel.name}"


def _read_values(channel: Any) -> tuple[Floats | None, str]:
    """Return the values and their unit; None for texts."""
    values = channel[:]
    if values.dtype.kind == "M":
        seconds = (values - values[:1]).astype("timedelta64[ns]").astype(float) * 1e-9
        return seconds, "s "
    if values.dtype.kind not in "fiub":
        return None, ""
    properties = channel.properties
    unit = properties.get("unit_string") or properties.get("NI_UnitDescription") or ""
    return values.astype(float), str(unit)


def _make_time(path: Path, columns: dict[str, Floats], waves: list[Any]) -> dict[str, Floats]:
    """Return the time column of the waveforms; none if channels hold the time themselves."""
    named = any(name.rpartition("/")[2].lower().startswith(("time", "t_")) for name in columns)
    if not waves or named:
        return {}
    kinds = {
        (
            float(channel.properties["wf_increment"]),
            float(channel.properties.get("wf_start_offset", 0.0)),
            str(channel.properties.get("wf_start_time", "")),
            len(channel),
        )
        for channel in waves
    }
    if len(kinds) > 1:
        listed = ", ".join(f"{n} every {step:g} s" for step, _, _, n in sorted(kinds))
        raise ImportRefused(
            f"{path}: the waveforms differ in start, length or interval ({listed}); "
            "resample them to one in LabVIEW, or export the channels that belong together"
        )
    step_s, offset_s, _, length = next(iter(kinds))
    if step_s <= 0.0:
        return {}
    return {TIME: np.asarray(offset_s + step_s * np.arange(length), np.float64)}
