"""Mend a record before it is used: what sensors and software added is taken off or left out.

Stamps that scatter give way to the regular grid, outliers and dropouts are bridged and do not
count, mains hum is taken off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.measured.noise.hum import Hum, remove_hum
from pamctl.diagnose.measured.noise.outliers import bridge, find_outliers
from pamctl.diagnose.measured.noise.time_stamps import cut_even_stretches, find_regular_times
from pamctl.diagnose.measured.record import CHANNELS, Array, Record

FaultKind = Literal["jitter", "outliers", "dropouts", "hum", "filtered", "unused"]


class SensorFault(NamedTuple):
    """What is wrong with a channel beside its noise."""

    channel: str
    """The channel; `t_s` for the time stamps."""
    kind: FaultKind
    says: str
    """What was found, with the number and its unit, and what was done about it."""


def mend_records(records: Sequence[Record]) -> tuple[list[Record], list[SensorFault]]:
    """Return the records of a rig without what can be mended, and what was found.

    A record that cannot be used at all is returned as it is: the checks of the data refuse it.
    """
    mended, faults = [*records], list[SensorFault]()
    usable = [k for k, record in enumerate(records) if _is_usable(record)]
    grids = find_regular_times([records[k] for k in usable])
    for k, times in zip(usable, grids, strict=True):
        record = records[k]
        if times is not None:
            scatter_s = float(np.std(record.t_s - times))
            says = f"{record.name}: the time stamps scatter by {scatter_s * 1e3:.3g} ms while the "
            says += "samples are regular; the regular grid is used"
            faults.append(SensorFault("t_s", "jitter", says))
            record = replace(record, t_s=times)
        mended[k], found = _mend_channels(record)
        faults += found
    return mended, faults


def _is_usable(record: Record) -> bool:
    usable = len(record) >= 100 and bool(np.all(record.step_s > 0.0))
    return usable and all(np.isfinite(record[c]).all() for c in record.channels)


def _mend_channels(record: Record) -> tuple[Record, list[SensorFault]]:
    """Bridge outliers and dropouts, and take off hum."""
    faults: list[SensorFault] = []
    counts = np.ones(len(record), np.bool_)
    mended: dict[str, Any] = {}
    for channel in (c for c in record.channels if c != "valve_v"):
        spikes, dropouts = find_outliers(record, channel)
        lost = spikes | dropouts
        counts &= ~lost
        faults += _describe_lost(record.name, channel, "outliers", spikes)
        faults += _describe_lost(record.name, channel, "dropouts", dropouts)
        values, hums = _remove_hums(record, bridge(record[channel], lost))
        faults += [
            SensorFault(
                channel,
                "hum",
                f"{record.name}: {channel} has {hum.frequency_hz:.0f} Hz of hum, amplitude "
                f"{hum.amplitude:.3g} {CHANNELS[channel]}; it is taken off",
            )
            for hum in hums
        ]
        mended[channel] = values
    return replace(record, **mended, counts=None if counts.all() else counts), faults


def _describe_lost(
    name: str, channel: str, kind: FaultKind, lost: NDArray[np.bool_]
) -> list[SensorFault]:
    if not lost.any():
        return []
    says = f"{name}: {channel} has {int(lost.sum())} samples that are {kind}, the first in row "
    return [SensorFault(channel, kind, f"{says}{int(np.argmax(lost))}; they do not count")]


def _remove_hums(record: Record, values: Array) -> tuple[Array, list[Hum]]:
    """Remove hum from each stretch without a missed sample."""
    values, found = values.copy(), []
    for part in cut_even_stretches(record):
        command = None if record.valve_v is None else record.valve_v[part]
        values[part], hums = remove_hum(values[part], record.period_s, command)
        found += hums
    return values, found
