"""Read a log, measured, simulated or imported, into a record."""

from __future__ import annotations

import json
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path

import numpy as np

import pamctl.log
from pamctl.diagnose.measured.record import Record
from pamctl.exit_codes import ExitCode
from pamctl.log.framing import map_log_file
from pamctl.log.measured_signals import judge_ticks
from pamctl.log.moments import Moment, list_moments
from pamctl.signals import Phase


class HoldoutError(Exception):
    """A log is to be fitted and to judge the fit. The message names it."""

    exit_code = ExitCode.USAGE


def require_held_out(train: Sequence[Path], holdout: Sequence[Path]) -> None:
    """Raise HoldoutError if a log of `holdout` is fitted too, under whatever name.

    Raise `LogError` if a file cannot be read.
    """
    fitted = {_hash_content(path): path for path in train} if holdout else {}
    for path in holdout:
        same = fitted.get(_hash_content(path))
        if same is not None:
            raise HoldoutError(
                f"--holdout {path} holds the same run as {same}: a log that is fitted cannot "
                "judge the fit; give another run, or no --holdout"
            )


def _hash_content(path: Path) -> bytes:
    return sha256(map_log_file(path)).digest()


def record_of(path: str | Path) -> Record:
    """Read a log and return its measurement after homing; raises `LogError`.

    The ramp to the safe voltage at the end is left out, and so are ticks whose write failed. The
    record's notes say what is doubtful in it.
    """
    log = pamctl.log.read(path)
    doubts = judge_ticks(log)
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
    first_s = float(log["t_s"][whole][0])
    experiment = str(log.metadata.get("run", {}).get("experiment") or "")
    story = log.metadata.get("import", {})
    atmosphere = story.get("atmospheric_pressure_pa")
    return Record(
        Path(path).stem,
        part.t_s - part.t_s[0],
        **channels,
        reference_m=reference_m,
        acts_after_s=part.acts_after_s,
        held_v=part.held_v,
        notes=tuple(doubts),
        experiment=experiment,
        is_imported=log.is_imported,
        stated_noise=json.loads(story.get("noise") or "{}"),
        atmosphere_pa=None if atmosphere is None else float(atmosphere),
        moments=tuple(Moment(at_s - first_s, text) for at_s, text in list_moments(log)),
        settings=log.config,
    )
