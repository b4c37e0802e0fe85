"""A rig file: backend, calibration, limits, homing and loop of one test rig."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from hal.calibration import CalibrationSettings
from hal.configured import Configured
from hal.faulty import FaultSettings
from hal.sim import SimSettings
from pamctl.control.homing import HomingSettings
from pamctl.realtime.pace import LoopSettings
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
    device: Annotated[str, Field(min_length=1, pattern="^[A-Za-z][A-Za-z0-9_]*$")] = "Dev1"


RigSettings = Annotated[SimRigSettings | NidaqRigSettings, Field(discriminator="backend")]
