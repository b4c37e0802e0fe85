"""From settings to what the tick and the program need, for a run and for its replay alike.

No device is opened here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from pydantic import TypeAdapter

from hal.calibration import Calibration, Output, Zero, calibration, valve_v
from hal.rig import RawSample
from pamctl.control.course import Course, start_at_position
from pamctl.control.experiment import ExperimentSettings, plan_experiment
from pamctl.control.homing import Homing, HomingSettings
from pamctl.control.law import filter_gains
from pamctl.control.law_registry import law_of
from pamctl.plant.model import plant_parameters
from pamctl.realtime.program import Program
from pamctl.realtime.tick import TickSetup
from pamctl.safety import convert_limits
from pamctl.settings.known_effects import build_compensation
from pamctl.settings.resolve import RunSettings

_EXPERIMENT: TypeAdapter[Any] = TypeAdapter(ExperimentSettings)


def build_tick_setup(settings: RunSettings) -> TickSetup:
    """Return the setup of the tick."""
    cal, law = calibration(settings.rig.calibration), law_of(settings.controller)
    return TickSetup(
        calibration=cal,
        filters=filter_gains(settings.controller),
        gains=law.gains_within(settings.controller, settings.rig.limits.command_v),
        armed=law.armed,
        limits=convert_limits(
            settings.rig.limits,
            safe_valve_v=safe_valve_v(settings, cal),
            count_m=abs(cal.encoder_m_per_count),
            model=plant_parameters(settings.plant).paper,
            pinned=settings.readonly,
        ),
        compensation=build_compensation(settings.plant, settings.rig, settings.controller),
    )


def safe_valve_v(settings: RunSettings, cal: Calibration) -> float:
    """Return the valve command of the safe output voltage."""
    return valve_v(cal, settings.rig.safe_volts)


def build_program(settings: RunSettings, *, course_begin_s: float | None = None) -> Program:
    """Return the program of the run; with `course_begin_s` it leaves out homing."""
    plan = plan_experiment(settings.experiment)
    course = Course(plan.segments, settings.duration_s, plan.cues)
    return _make_program(settings, course_begin_s is None, course, course_begin_s)


def build_ordered_program(settings: RunSettings, order: Mapping[str, Any]) -> Program:
    """Return the program of a run that was ordered from a daemon's loop.

    `order` is the log's event: the experiment, where its motion starts, and whether to home first.
    In place of the experiment it may hold the `course`, worked out.
    """
    course = order.get("course")
    if course is None:
        plan = plan_experiment(_EXPERIMENT.validate_python(order["experiment"]))
        segments = start_at_position(plan.segments, order["start_m"])
        course = Course(segments, order["duration_s"], plan.cues)
    return _make_program(settings, order["homes"], course)


def _make_program(
    settings: RunSettings, homes: bool, course: Course, course_begin_s: float | None = None
) -> Program:
    rig, homing = settings.rig, None
    if homes and rig.homing.enabled:
        homing = Homing(choose_homing_settings(settings), rig.calibration)
    return Program(
        homing,
        course,
        safe_valve_v=safe_valve_v(settings, calibration(rig.calibration)),
        stop_ramp_s=rig.loop.stop_ramp_s,
        course_begin_s=course_begin_s,
    )


def choose_homing_settings(settings: RunSettings) -> HomingSettings:
    """Return how to home; a read-only run takes its zeros at the safe voltage, without fills."""
    homing = settings.rig.homing
    return homing.model_copy(update={"fills": 0}) if settings.readonly else homing


def nominal_zero_of(settings: RunSettings) -> Callable[[RawSample], Zero]:
    """Return the zeros before homing: the file's sensor zero, and the first encoder count."""
    sensor_zero_v = settings.rig.calibration.sensor_zero_v
    return lambda sample: Zero(sensor_zero_v, float(sample.encoder_counts))


def output_of(settings: RunSettings) -> Output:
    """Return the valve's analog output as a write to the rig realises it."""
    return settings.rig.record.output(settings.rig.device_settings)
