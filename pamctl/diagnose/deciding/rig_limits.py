"""Would the rig's own safety let a program through: its limits, checked on a simulated run."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from hal.calibration import Calibration, CalibrationSettings, Zero, calibration, sensor_v
from hal.rig import RawSample
from pamctl.control.course import make_valve_reference
from pamctl.diagnose.measured.record import Array, Record
from pamctl.safety import INITIAL_SAFETY_STATE, Limits, admit
from pamctl.settings.build import build_tick_setup
from pamctl.settings.problems import ConfigError
from pamctl.settings.resolve import from_resolved
from pamctl.signals import Command, Estimate, Measurement, Phase, Timing

SPARE_SHARE = 0.03
"""A program keeps this share of what a limit allows to itself: a model is not the rig."""


class ProgramRun(NamedTuple):
    """What a plant would do under a program, without the faults of the measuring chain."""

    pressure_pa: Array
    position_m: Array


DATA_SHEETS = calibration(CalibrationSettings())
MOST_V = 5.0
"""The largest command of an experiment file."""


@dataclass(frozen=True)
class RigLimits:
    """What a program may ask of this rig: the rig file's limits, or what the records reached."""

    command_v: float
    pressure_pa: float
    low_m: float
    high_m: float
    safety: Limits | None = None
    """All rules of the rig's safety; None where no log says them."""
    calibration: Calibration = DATA_SHEETS
    sensor_zero_v: float = 0.0
    """What the pressure sensor shows at atmospheric pressure."""
    spare_share: float = SPARE_SHARE
    source: str = "the rig's limits"

    def allows(self, run: ProgramRun) -> bool:
        """Tell whether a run's highest pressure and its stroke stay inside, quickly."""
        spare_pa = self.spare_share * (self.pressure_pa - self.calibration.atmospheric_pressure_pa)
        spare_m = self.spare_share * (self.high_m - self.low_m)
        finite = np.isfinite(run.pressure_pa).all() and np.isfinite(run.position_m).all()
        return bool(
            finite
            and run.pressure_pa.max() <= self.pressure_pa - spare_pa
            and run.position_m.max() <= self.high_m - spare_m
            and run.position_m.min() >= min(self.low_m + spare_m, 0.0)
        )

    def admits(self, commands_v: Array, run: ProgramRun, period_s: float) -> bool:
        """Tell whether the rig's safety, tick by tick, would let a whole run pass."""
        if self.safety is None:
            return True
        zero = Zero(self.sensor_zero_v, 0.0)
        state = INITIAL_SAFETY_STATE._replace(
            valve_v=float(commands_v[0]),
            position_m=float(run.position_m[0]),
            model_pressure_pa=float(run.pressure_pa[0]),
        )
        none = Estimate(0.0, 0.0, 0.0, 0.0, 0.0)
        signals = zip(commands_v, run.position_m, run.pressure_pa, strict=True)
        for tick, (command_v, position_m, pressure_pa) in enumerate(signals):
            raw = RawSample(sensor_v(self.calibration, zero, pressure_pa), 0, 0, 0)
            decision, state = admit(
                self.safety,
                state,
                raw,
                Measurement(position_m, pressure_pa),
                make_valve_reference(int(Phase.OPEN_LOOP), command_v),
                none,
                Command(command_v, math.nan, math.nan, math.nan, saturated=False),
                Timing(tick, tick * period_s, period_s, 0.0, 0),
            )
            if decision.tripped:
                return False
        return True


def find_rig_limits(records: Sequence[Record]) -> RigLimits:
    """Return the limits of the rig that made the newest log; else what the records reached."""
    for record in reversed(records):
        if record.settings.get("rig"):
            try:
                return read_rig_limits(record.settings, record.name)
            except ConfigError:
                continue  # an older log, whose settings no longer hold
    return RigLimits(
        min(max(float(np.max(np.abs(r["valve_v"]))) for r in records), MOST_V),
        max(float(np.max(r["pressure_pa"])) for r in records),
        min(float(np.min(r["position_m"])) for r in records),
        max(float(np.max(r["position_m"])) for r in records),
        spare_share=0.0,
        source="what the records reached",
    )


def read_rig_limits(resolved: Mapping[str, Any], name: str) -> RigLimits:
    """Return the limits of a run's resolved settings; raises `ConfigError`."""
    settings = from_resolved(json.dumps(dict(resolved)), name)
    setup = build_tick_setup(settings)
    limits = setup.limits
    return RigLimits(
        min(limits.command_v, MOST_V),
        limits.pressure_pa,
        limits.stroke_low_m,
        limits.stroke_high_m,
        limits,
        setup.calibration,
        settings.rig.calibration.sensor_zero_v,
    )
