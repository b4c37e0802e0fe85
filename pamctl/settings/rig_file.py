"""A rig file: backend, calibration, limits, homing and loop of one test rig.

There is one model per installed backend, made from the backend's record. `RigSettings` is
their union, with the key `backend` as discriminator.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import Field, TypeAdapter, create_model, model_validator

from hal.backend import Backend, find_backends, get_backend
from hal.calibration import CalibrationSettings, Configured
from hal.faulty import FaultSettings
from hal.rig import RigError
from pamctl.base.chosen_model import ChosenModel, build_once
from pamctl.control.homing import HomingSettings
from pamctl.realtime.clock import LoopSettings
from pamctl.safety import LimitSettings

SafeVolts = Annotated[
    float,
    Field(ge=-10, le=10, description="output V that is safe: 0 vents, driver_offset_v holds"),
]
_Faults = Annotated[
    tuple[FaultSettings, ...], Field(description="faults to inject, for rehearsals")
]


class EnvelopeSettings(Configured):
    """The fastest motion that an experiment made of forms may ask for.

    Position, pressure and valve command have their limits under `limits`.
    """

    speed_mm_per_s: Annotated[float, Field(gt=0, le=1e5)] = 500.0
    acceleration_mm_per_s2: Annotated[float, Field(gt=0, le=1e8)] = 50_000.0


class RigFile(Configured):
    """The keys that all rig files share."""

    calibration: CalibrationSettings = CalibrationSettings()
    limits: LimitSettings = LimitSettings()
    envelope: EnvelopeSettings = EnvelopeSettings()
    homing: HomingSettings = HomingSettings()
    loop: LoopSettings = LoopSettings()
    compensate: Annotated[
        tuple[str, ...],
        Field(
            description="effects of the plant file that the tick undoes around the law, such as "
            "`valve_deadband`; see `pamctl manual diagnose-a-log`"
        ),
    ] = ()

    if TYPE_CHECKING:  # each backend's model declares these, with its own name and default
        backend: str
        safe_volts: float

    @property
    def record(self) -> Backend[Any]:
        """The record of the backend."""
        return get_backend(self.backend)

    @property
    def device_settings(self) -> Configured:
        """The settings under the backend's own key."""
        settings: Configured = getattr(self, self.backend)
        return settings

    @property
    def faults_to_inject(self) -> tuple[FaultSettings, ...]:
        """The faults of a simulated rig; empty for a real rig."""
        return getattr(self, "faults", ())

    @model_validator(mode="after")
    def _check_driver_range(self) -> Self:
        """Refuse commands that the driver would clip: safety must know the true command."""
        cal, limit_v = self.calibration, self.limits.command_v
        reach_v = [cal.driver_offset_v + cal.driver_gain * v for v in (-limit_v, limit_v)]
        for name, volts in (("limits.command_v", reach_v), ("safe_volts", [self.safe_volts])):
            if min(volts) < cal.driver_low_v - 1e-9 or max(volts) > cal.driver_high_v + 1e-9:
                shown = " to ".join(f"{v:g}" for v in volts)
                raise ValueError(
                    f"{name} means {shown} V at the valve driver, which takes "
                    f"{cal.driver_low_v:g} to {cal.driver_high_v:g} V (calibration.driver_*)"
                )
        return self

    @model_validator(mode="after")
    def _check_safe_volts(self) -> Self:
        """Refuse a safe voltage outside the output's range (within one code)."""
        output = self.record.output(self.device_settings)
        step_v = 2.0 * output.converter.full_scale_v / output.converter.levels
        if not output.lowest_v - step_v <= self.safe_volts <= output.highest_v + step_v:
            low_v, high_v = round(output.lowest_v, 3), round(output.highest_v, 3)
            raise ValueError(f"safe_volts must lie within the output's range, {low_v} to {high_v}")
        return self

    @model_validator(mode="after")
    def _check_device(self) -> Self:
        self.record.check(self.device_settings, self.loop.rate_hz)
        return self


@build_once
def _find_model(backend: str) -> type[RigFile] | None:
    """Return the model of a backend's rig files; a section with all defaults is optional."""
    try:
        record = get_backend(backend)
    except RigError:
        return None
    section = record.settings
    needed = any(field.is_required() for field in section.model_fields.values())
    fields: dict[str, Any] = {
        "backend": (Literal[record.name], ...),
        "safe_volts": (SafeVolts, ... if record.safe_volts is None else record.safe_volts),
        record.name: (section, ... if needed else section()),
    }
    if record.is_simulated:
        fields["faults"] = (_Faults, ())
    name = f"{record.name.capitalize()}{_OF_FILES}"
    return create_model(
        name, __base__=RigFile, __doc__=record.description, __module__=__name__, **fields
    )


_OF_FILES = "RigSettings"


def __getattr__(name: str) -> type[RigFile]:
    """Return a model by its name: pickle looks for it here."""
    model = _find_model(name.removesuffix(_OF_FILES).lower()) if name.endswith(_OF_FILES) else None
    if model is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return model


RigSettings = Annotated[RigFile, ChosenModel("backend", lambda: find_backends().found, _find_model)]


def read_resolved_rig(resolved: Mapping[str, Any]) -> RigFile:
    """Return the rig file of a run that is resolved: the guardian needs nothing else of it."""
    adapter: TypeAdapter[RigFile] = TypeAdapter(RigSettings)
    return adapter.validate_json(json.dumps(resolved["rig"]), strict=True)
