"""What every offline tool needs of a log: the valve's command, and what the muscle did.

A run of pamctl and a measurement that was imported look alike from here. Build on
`signals`, and a tool serves both.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from hal.calibration import CalibrationSettings, calibration, valve_v
from pamctl.log.framing import LogError
from pamctl.log.reader import Log

NO_PHASE = -1
"""Phase of a tick of an imported log: nobody knows what its loop was doing."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Signals:
    """The measured signals of a log, each an array of shape (n,), None where not measured.

    `valve_v[i]` is written at the end of tick i, after the samples of tick i, and holds
    until tick i + 1: it drives the muscle from `t_s[i]` (plus the tick's own microseconds)
    to `t_s[i + 1]`. A slice, `measured[1000:]`, is the same signals over those ticks.
    """

    t_s: Floats
    """Time of the samples, rising strictly; it starts at zero in a whole log."""
    dt_s: Floats
    """Time since the previous tick, by the clock; of the first one, the nominal period."""
    valve_v: Floats | None
    """Valve command as really put out, -5..5 V, positive fills; NaN where the write failed."""
    pressure_pa: Floats | None
    """Absolute pressure in the muscle."""
    position_m: Floats | None
    """Displacement; contraction is positive."""
    force_n: Floats | None
    """Pull at the muscle's end; no rig of ours measures it, an imported log may."""
    missed: NDArray[np.int64]
    """Periods skipped between the previous tick and this one."""
    phase: NDArray[np.int64]
    """`pamctl.signals.Phase` of each tick, `NO_PHASE` throughout in an imported log.

    While homing, position and pressure are by the nominal zeros, and jump at its end.
    """

    def __len__(self) -> int:
        """Return the number of ticks."""
        return len(self.t_s)

    def __getitem__(self, ticks: slice) -> Signals:
        """Return the signals over some of the ticks."""
        parts: dict[str, Any] = {}
        for field in fields(self):
            whole = getattr(self, field.name)
            parts[field.name] = None if whole is None else whole[ticks]
        return Signals(**parts)


def signals(log: Log) -> Signals:
    """Return the measured signals of a log, whatever its origin.

    Of a run of ours the valve command is what the converter applied, when it did: a tick later
    where a sample clock paces it. It is turned back by the calibration in the log; raise LogError
    if there is none.
    """
    count = len(log)
    return Signals(
        t_s=log["t_s"],
        dt_s=log["dt_s"],
        valve_v=log.columns.get("valve_v") if log.is_imported else _compute_applied_valve_v(log),
        pressure_pa=log.columns.get("pressure_pa"),
        position_m=log.columns.get("position_m"),
        force_n=log.columns.get("force_n"),
        missed=log["missed"],
        phase=np.full(count, NO_PHASE) if log.is_imported else log["phase"],
    )


def _compute_output_v(log: Log) -> Floats:
    """Return the driver's voltage from each tick's samples to the next ones, shape (n,)."""
    applied_v: Floats = log["applied_v"]
    rig = log.metadata.get("rig", {})
    if rig.get("output_delay_ticks", "0") == "0" or not len(log):
        return applied_v
    before_v = np.concatenate(([float(rig["safe_output_v"])], applied_v[:-1]))
    if "sample_clock" not in rig:  # put out when the loop reads next
        return before_v
    # A device with a clock of its own puts it out at its next edge, even if the loop missed it: of
    # a tick of several periods the first has the old voltage and the others the new. Their mean
    # moves as much air.
    old_share = 1.0 / (1.0 + np.concatenate((log["missed"][1:], [0])))
    return np.asarray(old_share * before_v + (1.0 - old_share) * applied_v)


def _compute_applied_valve_v(log: Log) -> Floats:
    written: Any = log.config.get("rig", {}).get("calibration")
    try:
        settings = CalibrationSettings.model_validate(written)
    except ValidationError as error:
        raise LogError(
            f"{log.path} carries no calibration of the valve's driver: "
            f"what was applied to the valve cannot be told ({error.error_count()} problems)"
        ) from error
    # Plain arithmetic, and so the same on an array as on a number.
    return valve_v(calibration(settings), _compute_output_v(log))  # type: ignore[arg-type,return-value]
