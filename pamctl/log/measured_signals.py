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
from pamctl.log.command_instants import find_output_steps, find_sample_times
from pamctl.log.framing import LogError
from pamctl.log.reader import Log

NO_PHASE = -1
"""Phase of the ticks of an imported log: what its loop was doing is unknown."""

Floats = NDArray[np.float64]

SIGNAL_FIELDS = (
    *("tick", "t_s", "dt_s", "missed", "phase"),
    *("late_s", "read_s", "compute_s", "write_s", "true_pressure_pa"),
    *("applied_v", "valve_v", "pressure_pa", "position_m", "force_n"),
)
"""The columns of a log that `signals` needs, of those that it has."""


@dataclass(frozen=True)
class Signals:
    """The measured signals of a log: arrays of shape (n,), None if not measured.

    `valve_v[i]` is written at the end of tick i, after the samples of tick i. It drives the muscle
    from `t_s[i] + acts_after_s[i]` until the next command acts. A slice, `measured[1000:]`, is the
    same signals over those ticks.
    """

    t_s: Floats
    """Time of the encoder's samples, as taken and not as planned; strictly rising, from zero."""
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
    acts_after_s: Floats | None = None
    """Time from sample i to the instant from which `valve_v[i]` acts; None: all act at the sample.

    Negative for a command that acted before its sample, at an edge of a card's clock that the loop
    missed.
    """
    held_v: float | None = None
    """The command before the first one here, which acts until that one does; None: unknown."""

    def __len__(self) -> int:
        """Return the number of ticks."""
        return len(self.t_s)

    def __getitem__(self, ticks: slice) -> Signals:
        """Return the signals over some of the ticks."""
        parts: dict[str, Any] = {}
        for field in fields(self):
            whole = getattr(self, field.name)
            parts[field.name] = whole[ticks] if isinstance(whole, np.ndarray) else whole
        first = ticks.indices(len(self))[0]
        if first and self.valve_v is not None:
            parts["held_v"] = find_held_v(self.valve_v, first)
        return Signals(**parts)


def signals(log: Log) -> Signals:
    """Return the measured signals of a log of pamctl or of an imported log.

    In a log of pamctl the valve command is the output that the converter really applied, at the
    tick at which it applied it: one tick later if a sample clock paces the card. The calibration in
    the log turns it back into a command; raise LogError if there is none.
    """
    count = len(log)
    held_v = None
    if log.is_imported:
        valve, acts_after_s = log.columns.get("valve_v"), _find_stated_delay(log)
    else:
        output = find_output_steps(log)
        valve, acts_after_s = _compute_valve_v(log, output.output_v), output.acts_after_s
        if output.held_v is not None:
            held_v = float(_compute_valve_v(log, np.array(output.held_v)))
    t_s = find_sample_times(log)
    return Signals(
        t_s=t_s,
        dt_s=log["dt_s"] + np.diff(t_s - log["t_s"], prepend=0.0),
        valve_v=valve,
        pressure_pa=log.columns.get("pressure_pa"),
        position_m=log.columns.get("position_m"),
        force_n=log.columns.get("force_n"),
        missed=log["missed"],
        phase=np.full(count, NO_PHASE) if log.is_imported else log["phase"],
        acts_after_s=acts_after_s,
        held_v=held_v,
    )


def find_held_v(valve_v: Floats, first: int) -> float | None:
    """Return the command before a row; None if that write failed."""
    held_v = float(valve_v[first - 1])
    return held_v if np.isfinite(held_v) else None


def _find_stated_delay(log: Log) -> Floats | None:
    """Return the constant that the map of an import stated."""
    stated_s = float(log.metadata.get("import", {}).get("acts_after_s", 0.0))
    return np.full(len(log), stated_s) if stated_s else None


def _compute_valve_v(log: Log, output: Floats) -> Floats:
    written: Any = log.config.get("rig", {}).get("calibration")
    try:
        settings = CalibrationSettings.model_validate(written)
    except ValidationError as error:
        raise LogError(
            f"{log.path} carries no calibration of the valve's driver: "
            f"the voltage at the valve is unknown ({error.error_count()} problems)"
        ) from error
    # Plain arithmetic works on arrays as on numbers.
    return valve_v(calibration(settings), output)  # type: ignore[arg-type,return-value]
