"""A rig file: backend, calibration, limits, homing and loop of one test rig."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from hal.calibration import CalibrationSettings
from hal.configured import Configured
from hal.faulty import FaultSettings
from hal.nidaq.card_settings import NidaqSettings
from hal.sim.sim_rig import SimSettings
from pamctl.control.homing import HomingSettings
from pamctl.realtime.loop_settings import LoopSettings
from pamctl.safety import LimitSettings

SafeVolts = Annotated[
    float,
    Field(ge=-10, le=10, description="output V that is safe: 0 vents, driver_offset_v holds"),
]


class _Rig(Configured):
    calibration: CalibrationSettings = CalibrationSettings()
    limits: LimitSettings = LimitSettings()
    homing: HomingSettings = HomingSettings()
    loop: LoopSettings = LoopSettings()

    @model_validator(mode="after")
    def _check_driver_range(self) -> Self:
        """Safety reasons about the command it admits: what the driver would cut must not occur."""
        cal, limit_v = self.calibration, self.limits.command_v
        reach_v = [cal.driver_offset_v + cal.driver_gain * v for v in (-limit_v, limit_v)]
        safe_volts = getattr(self, "safe_volts", cal.driver_offset_v)
        for name, volts in (("limits.command_v", reach_v), ("safe_volts", [safe_volts])):
            if min(volts) < cal.driver_low_v - 1e-9 or max(volts) > cal.driver_high_v + 1e-9:
                shown = " to ".join(f"{v:g}" for v in volts)
                raise ValueError(
                    f"{name} means {shown} V at the valve driver, which takes "
                    f"{cal.driver_low_v:g} to {cal.driver_high_v:g} V (calibration.driver_*)"
                )
        return self


class SimRigSettings(_Rig):
    """A simulated rig; what it moves is the plant."""

    backend: Literal["sim"]
    safe_volts: SafeVolts = 0.0
    sim: SimSettings = SimSettings()
    faults: Annotated[
        tuple[FaultSettings, ...], Field(description="what goes wrong, for rehearsals")
    ] = ()


class NidaqRigSettings(_Rig):
    """An NI card. `safe_volts` has no default: only its owner knows what is safe."""

    backend: Literal["nidaq"]
    safe_volts: SafeVolts
    nidaq: NidaqSettings = NidaqSettings()

    @model_validator(mode="after")
    def _check_safe_volts(self) -> NidaqRigSettings:
        low_v, high_v = self.nidaq.output_low_v, self.nidaq.output_high_v
        if not low_v <= self.safe_volts <= high_v:
            raise ValueError(f"safe_volts must lie within the output's range, {low_v} to {high_v}")
        return self

    @model_validator(mode="after")
    def _check_timeout(self) -> NidaqRigSettings:
        periods = self.nidaq.timeout_s * self.loop.rate_hz
        if self.nidaq.timing == "hardware_timed" and periods < 2:
            raise ValueError(
                f"nidaq.timeout_s {self.nidaq.timeout_s:g} is less than two periods of "
                f"loop.rate_hz {self.loop.rate_hz:g}: a hardware-timed read waits for one"
            )
        return self


RigSettings = Annotated[SimRigSettings | NidaqRigSettings, Field(discriminator="backend")]
