"""The measured signals of a log: the valve's command and the muscle's answer.

Offline tools that use `signals` work on runs of pamctl and on imported measurements.
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
"""Phase of the ticks of an imported log: what its loop was doing is unknown."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Signals:
    """The measured signals of a log: arrays of shape (n,), None if not measured.

    `valve_v[i]` is written at the end of tick i, after the samples of tick i, and holds
    until tick i + 1: it drives the muscle from `t_s[i]` (plus the tick's own microseconds)
    to `t_s[i + 1]`. A slice, `measured[1000:]`, is the same signals over those ticks.
    """

    t_s: Floats
    """Time of the samples, strictly rising; a whole log starts at zero."""
    dt_s: Floats
    """Time since the previous tick, by the clock; the nominal period for the first tick."""
    valve_v: Floats | None
    """Valve command as really applied, -5..5 V, positive fills; NaN if the write failed."""
    pressure_pa: Floats | None
    """Absolute pressure in the muscle."""
    position_m: Floats | None
    """Displacement, positive in contraction."""
    force_n: Floats | None
    """Pulling force at the muscle's end; only imported logs may have it."""
    missed: NDArray[np.int64]
    """Periods skipped between the previous tick and this one."""
    phase: NDArray[np.int64]
    """`pamctl.signals.Phase` of each tick; always `NO_PHASE` in an imported log.

    During homing, position and pressure refer to the nominal zeros; they jump at its end.
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
    """Return the measured signals of a log of pamctl or of an imported log.

    In a log of pamctl the valve command is the output that the converter really applied, at the
    time when it applied it: one tick later if a sample clock paces the card. The calibration in
    the log turns it back into a command; raise LogError if there is none.
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
    """Return the driver's voltage between each tick's samples and the next, shape (n,)."""
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
            f"the voltage at the valve is unknown ({error.error_count()} problems)"
        ) from error
    # Plain arithmetic works on arrays as on numbers.
    return valve_v(calibration(settings), _compute_output_v(log))  # type: ignore[arg-type,return-value]
