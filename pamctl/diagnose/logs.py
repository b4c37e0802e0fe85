"""From a log, of this rig, of the simulation or imported, to a record."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import pamctl.log
from pamctl.diagnose.records import Record
from pamctl.signals import Phase


def record_of(path: str | Path) -> Record:
    """Read a log and return its measurement after homing; raises `LogError`.

    The ramp to the safe voltage at the end is left out, and so are ticks whose write failed.
    """
    measured = pamctl.log.signals(pamctl.log.read(path))
    wanted = (measured.phase != Phase.HOMING) & (measured.phase != Phase.STOPPING)
    if measured.valve_v is not None:
        wanted &= np.isfinite(measured.valve_v)
    ticks = np.flatnonzero(wanted)
    if not len(ticks):
        raise pamctl.log.LogError(f"{path} holds nothing but homing")
    part = measured[int(ticks[0]) : int(ticks[-1]) + 1]
    channels = {
        name: getattr(part, name)
        for name in ("valve_v", "pressure_pa", "position_m", "force_n")
        if getattr(part, name) is not None
    }
    return Record(Path(path).stem, part.t_s - part.t_s[0], **channels)
