"""Refuse an experiment, before anything moves, that asks for more than rig and model can do."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from pydantic import ValidationError

from pamctl.control.course import Segment, reference_at
from pamctl.control.experiment import SequenceSettings, plan_experiment
from pamctl.control.forms import Form
from pamctl.control.law_registry import read_controller
from pamctl.plant.model import plant_parameters
from pamctl.plant.paper import PaperParameters, braid_lever_m, force_area_m2, valve_flow, volume_m3
from pamctl.plant.parameters import PlantParameters
from pamctl.realtime.gain_ramp import GainRampError, require_blendable
from pamctl.settings.resolve import RunSettings
from pamctl.signals import Reference

_MM, _KPA = 1e3, 1e-3
_INSTANT_S = 1e-6
_STEP_S = 0.97e-3
"""Not a whole millisecond: samples of a periodic wave then fall on every part of its period."""
_MOST_SAMPLES = 50_000
_FEWEST_SAMPLES = 64


class TimedReference(NamedTuple):
    """A reference, and when it comes first (s from the end of homing)."""

    t_s: float
    reference: Reference


class Demand(NamedTuple):
    """What the model needs for a motion."""

    pressure_pa: float
    """Absolute."""
    valve_v: float


class _Limit(NamedTuple):
    """One side of the envelope, in the unit of the message."""

    what: str
    """What is beyond the limit, as the object of a sentence."""
    unit: str
    low: float
    high: float
    key: str


def find_excesses(settings: RunSettings) -> list[str]:
    """Say what an experiment made of forms asks for beyond the envelope; empty if nothing.

    Each line has the figure, its time, the limit and the key of the limit. Other experiments are
    not checked.
    """
    experiment = settings.experiment
    if not isinstance(experiment, Form | SequenceSettings):
        return []
    try:
        segments = plan_experiment(experiment).segments
    except ValueError as error:
        return [str(error)]
    said: list[str] = []
    if isinstance(experiment, SequenceSettings):
        said += _judge_gains(settings, experiment)
    samples = sample_segments(segments, settings.duration_s or math.inf)
    if math.isnan(samples[0].reference.reference_valve_v):
        return [*said, *_judge_motion(settings, samples)]
    limit_v = settings.rig.limits.command_v
    valve = _Limit("for a valve command", "V", -limit_v, limit_v, "rig.limits.command_v")
    return [*said, *_judge(valve, ((t, r.reference_valve_v) for t, r in samples))]


def _judge_motion(settings: RunSettings, samples: Sequence[TimedReference]) -> Iterator[str]:
    limits, most = settings.rig.limits, settings.rig.envelope
    kinematic = (
        ("for a position", "mm", "reference_m", limits.stroke_low_mm, limits.stroke_high_mm,
         "rig.limits.stroke_low_mm and stroke_high_mm"),
        ("for a speed", "mm/s", "reference_velocity_m_per_s", -most.speed_mm_per_s,
         most.speed_mm_per_s, "rig.envelope.speed_mm_per_s"),
        ("for an acceleration", "mm/s^2", "reference_acceleration_m_per_s2",
         -most.acceleration_mm_per_s2, most.acceleration_mm_per_s2,
         "rig.envelope.acceleration_mm_per_s2"),
    )  # fmt: skip
    said = [
        line
        for what, unit, field, low, high, key in kinematic
        for line in _judge(
            _Limit(what, unit, low, high, key),
            ((t_s, getattr(reference, field) * _MM) for t_s, reference in samples),
        )
    ]
    if said:  # outside the stroke the model means nothing
        yield from said
        return
    plant = plant_parameters(settings.plant)
    command_v = min(limits.command_v, settings.controller.command_limit_v)
    valve = _Limit(
        "(by the plant's model) for a valve command",
        "V",
        -command_v,
        command_v,
        "rig.limits.command_v and controller.command_limit_v",
    )
    if plant.direct:
        yield from _judge(valve, _find_drive_commands(plant, samples))
        return
    model = plant.paper
    low_pa = model.atmospheric_pressure_pa
    high_pa = min(model.tank_pressure_pa, limits.pressure_pa)
    load_n = plant.effects.mechanics.external_load.force_n
    demands = [(sample.t_s, find_demand(model, sample, load_n)) for sample in samples]
    # The vented muscle stays at rest a little above its length of zero pressure.
    pressure = _Limit(
        "(by the plant's model) for a pressure",
        "kPa absolute",
        low_pa * _KPA - 0.1,
        high_pa * _KPA,
        "the air supply and rig.limits.pressure_pa",
    )
    said = list(_judge(pressure, ((t_s, d.pressure_pa * _KPA) for t_s, d in demands)))
    yield from said or _judge(valve, ((t_s, d.valve_v) for t_s, d in demands))


def _find_drive_commands(
    plant: PlantParameters, samples: Sequence[TimedReference]
) -> list[tuple[float, float]]:
    """Return the command (V) of an axis's drive at each sample: the force over its force a volt."""
    import numpy as np  # a command line must not wait for it

    from pamctl.plant.required_force import required_force_n

    motion = np.array([(t_s, *reference[1:4]) for t_s, reference in samples]).T
    commands_v = required_force_n(plant, *motion) / plant.drive_n_per_v
    return list(zip(motion[0].tolist(), commands_v.tolist(), strict=True))


def find_demand(model: PaperParameters, sample: TimedReference, load_n: float = 0.0) -> Demand:
    """Return what Eq. 4 to 8 need for a motion; the pressure has Eq. 5's friction in it.

    The load, N, pulls against the contraction. The valve command is without the jump of pressure at
    a reversal, which no valve can follow.
    """
    _, x, v, a, j, _ = sample.reference
    gauge_pa = _find_gauge_pa(model, load_n, x, v, a, with_friction=False)
    later = x + v * _INSTANT_S, v + a * _INSTANT_S, a + j * _INSTANT_S
    later_pa = _find_gauge_pa(model, load_n, *later, with_friction=False)
    pressure_pa = gauge_pa + model.atmospheric_pressure_pa
    growth = (later_pa - gauge_pa) / _INSTANT_S * volume_m3(model, x)
    inflow = (growth + pressure_pa * force_area_m2(model, x) * v) / model.specific_energy_j_per_kg
    per_volt = abs(valve_flow(model, math.copysign(1.0, inflow), pressure_pa))
    return Demand(
        _find_gauge_pa(model, load_n, x, v, a, with_friction=True) + model.atmospheric_pressure_pa,
        inflow / per_volt if per_volt > 0.0 else 0.0,
    )


def _find_gauge_pa(
    model: PaperParameters, load_n: float, x: float, v: float, a: float, *, with_friction: bool
) -> float:
    """Return the gauge pressure that balances the forces of Eq. 4 to 6 and a load."""
    force_n = load_n + model.mass_kg * a + model.damping_n_s_per_m * v + model.stiffness_n_per_m * x
    area_m2 = force_area_m2(model, x)
    if with_friction and v > 0.0 and force_n > 0.0:
        area_m2 -= model.friction_area_m * (braid_lever_m(model, x) + v)
    return force_n / area_m2 if area_m2 > 0.0 else math.inf


def _judge(limit: _Limit, samples: Iterable[tuple[float, float]]) -> Iterator[str]:
    """Say which extreme lies farthest outside a limit."""
    listed = list(samples)
    lowest, highest = min(listed, key=lambda s: s[1]), max(listed, key=lambda s: s[1])
    over, under = highest[1] - limit.high, limit.low - lowest[1]
    if max(over, under) <= 1e-9 * (abs(limit.low) + abs(limit.high)):
        return
    t_s, value = highest if over >= under else lowest
    yield (
        f"asks {limit.what} of {value:.4g} {limit.unit} at {t_s:.3g} s; the limits are "
        f"{limit.low:.4g} to {limit.high:.4g} ({limit.key})"
    )


def _judge_gains(settings: RunSettings, experiment: SequenceSettings) -> Iterator[str]:
    """Say which gain change of a sequence cannot be made while the muscle moves."""
    before = settings.controller
    for change in experiment.find_gain_changes():
        keys = {**before.model_dump(mode="json"), **change.set}
        named = ", ".join(f"{key}: {value}" for key, value in change.set.items())
        try:
            after = read_controller(keys)
            require_blendable(before, after)
            changed = settings.model_copy(update={"controller": after})
            RunSettings.model_validate(changed.model_dump())
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            where = f"{first['loc'][-1]}: " if first["loc"] else ""
            yield f"changes gains to {named}: {where}{first['msg']}"
        except GainRampError as error:
            yield f"changes gains to {named}: {error}"
        else:
            before = after


def sample_segments(segments: Sequence[Segment], before_s: float) -> list[TimedReference]:
    """Evaluate every segment that begins before a time closely; a repeated one, once."""
    samples: list[TimedReference] = []
    seen: set[int] = set()
    begin_s = 0.0
    for segment in segments:
        if begin_s >= before_s:
            break
        if id(segment) not in seen:
            seen.add(id(segment))
            count = round(segment.duration_s / _STEP_S)
            count = min(max(count, _FEWEST_SAMPLES), _MOST_SAMPLES)
            step_s = segment.duration_s / count
            samples += (
                TimedReference(begin_s + i * step_s, reference_at(segment, i * step_s))
                for i in range(count + 1)
            )
        begin_s += segment.duration_s
    return samples
