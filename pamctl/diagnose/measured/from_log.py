"""Read a log, measured, simulated or imported, into a record."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import pamctl.log
from pamctl.diagnose.measured.record import Record
from pamctl.signals import Phase


def record_of(path: str | Path) -> Record:
    """Read a log and return its measurement after homing; raises `LogError`.

    The ramp to the safe voltage at the end is left out, and so are ticks whose write failed.
    """
    log = pamctl.log.read(path)
    measured = pamctl.log.signals(log)
    usable = (measured.phase != Phase.HOMING) & (measured.phase != Phase.STOPPING)
    if measured.valve_v is not None:
        usable &= np.isfinite(measured.valve_v)
    ticks = np.flatnonzero(usable)
    if not len(ticks):
        raise pamctl.log.LogError(f"{path} holds nothing but homing")
    whole = slice(int(ticks[0]), int(ticks[-1]) + 1)
    part = measured[whole]
    channels = {
        name: getattr(part, name)
        for name in ("valve_v", "pressure_pa", "position_m", "force_n")
        if getattr(part, name) is not None
    }
    column = log.columns.get("reference_m")  # an imported log may not have it
    reference_m = None if column is None or not np.isfinite(column).any() else column[whole]
    experiment = str(log.metadata.get("run", {}).get("experiment") or "")
    return Record(
        Path(path).stem,
        part.t_s - part.t_s[0],
        **channels,
        reference_m=reference_m,
        experiment=experiment,
    )
