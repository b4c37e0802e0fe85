"""How well gains do on a plant: each error over its bound in Table IV, the worst counts.

The paper's two experiments in full would take a search too long. One cycle of experiment 1 has
all their parts: the transitions, and a steady state at each end. Its rests keep their length: the
steady error counts after 5 s of rest. With shorter rests the law would need so strong an integral
that it hunts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from pamctl.control.experiment import TrackingSettings
from pamctl.settings.resolve import RunSettings, resolve
from pamctl.signals import Phase
from pamctl.simulate.closed_loop import SimulatedRun, simulate_run
from pamctl.simulate.merit import TABLE_IV, compute_merit
from pamctl.tune.plant_ensemble import Member

_MEAN_WEIGHT = 0.1
"""Weight of the mean error beside the worst one."""
TRIP_COST = 100.0
"""Cost of a run that safety ended at its beginning; less, the longer the run lasted."""

SHORT = TrackingSettings(kind="tracking", rest_s=10.0, cycles=1, approach_s=3.0, settle_s=0.5)
SHORT_S, WHOLE_S = 33.5, 67.0 + 37.0
"""How long that takes, and both experiments."""


class Bounds(NamedTuple):
    """The strictest column of Table IV, in m."""

    max_m: float
    rms_m: float
    moving_rms_m: float
    """RMS of experiment 2, where nothing rests."""
    steady_m: float


def _find_strictest_bounds() -> Bounds:
    resting = [row.merit for row in TABLE_IV if row.experiment == "tracking-1"]
    moving = [row.merit for row in TABLE_IV if row.experiment == "tracking-2"]
    return Bounds(
        min(m.max_m for m in resting),
        min(m.rms_m for m in resting),
        min(m.rms_m for m in moving),
        min(m.steady_m for m in resting),
    )


BOUNDS = _find_strictest_bounds()


class GainsVerdict(NamedTuple):
    """How gains did on one plant."""

    worst: float
    """The largest error over its bound; below 1 is inside Table IV."""
    why: str
    """Which error that is, or that safety ended the run."""
    figures_um: dict[str, float]
    mean: float
    """Mean of all errors over their bounds."""

    @property
    def cost(self) -> float:
        """The cost in a search: the worst error, and with a small weight the others.

        Many gains have the same worst error: the steady error is a whole number of counts.
        """
        return self.worst + _MEAN_WEIGHT * self.mean

    @property
    def is_inside(self) -> bool:
        """Every error is within its bound."""
        return self.worst <= 1.0


_Errors = dict[str, tuple[float, float]]
"""Errors and their bounds, in m, by name."""


@dataclass(frozen=True)
class GainsTrial:
    """A set-up in which gains are tried: `short` for a search, `whole` for what is reported."""

    length: Literal["short", "whole"] = "short"

    @property
    def duration_s(self) -> float:
        """How long the muscle moves for a verdict."""
        return SHORT_S if self.length == "short" else WHOLE_S

    def verdict(self, controller: Any, member: Member) -> GainsVerdict:
        """Run gains (a controller's settings) on one plant."""
        if self.length == "short":
            return _judge_short(simulate_run(_make_settings(controller, member, SHORT)))
        errors: _Errors = {}
        for name in ("tracking-1", "tracking-2"):
            batch = simulate_run(_make_settings(controller, member, None, name))
            if batch.run.tripped_tick >= 0:
                return _judge_tripped(batch)
            errors |= _errors_of(batch, name)
        return _make_verdict(errors)


def _make_settings(
    controller: Any, member: Member, experiment: Any, name: str = "tracking-1"
) -> RunSettings:
    base = _resolve_base(name)
    sim = base.rig.device_settings.model_copy(
        update={
            "sensor_noise_v": member.noise_v,
            "output_delay_ticks": member.output_delay_ticks,
        }
    )
    return base.model_copy(
        update={
            "controller": controller,
            "plant": member.plant,
            "rig": base.rig.model_copy(update={"sim": sim}),
            "experiment": experiment or base.experiment,
            "seed": member.seed,
        }
    )


_bases: dict[str, RunSettings] = {}


def _resolve_base(name: str) -> RunSettings:
    if name not in _bases:
        _bases[name] = resolve(experiment=name)
    return _bases[name]


def _judge_short(batch: SimulatedRun) -> GainsVerdict:
    if batch.run.tripped_tick >= 0:
        return _judge_tripped(batch)
    found = compute_merit(batch.t_s, batch.run["phase"].astype(np.int64), batch.error_m)
    assert found is not None
    moving = batch.run["phase"] == Phase.TRACK
    moving_rms_m = float(np.sqrt(np.mean(batch.error_m[moving] ** 2)))
    return _make_verdict(
        {
            "max": (found.max_m, BOUNDS.max_m),
            "RMS": (found.rms_m, BOUNDS.rms_m),
            "moving RMS": (moving_rms_m, BOUNDS.moving_rms_m),
            "steady": (found.steady_m, BOUNDS.steady_m),
        }
    )


def _errors_of(batch: SimulatedRun, name: str) -> _Errors:
    found = batch.merit()
    assert found is not None
    bounds = [row.merit for row in TABLE_IV if row.experiment == name]
    number = name[-1]
    errors = {
        f"max {number}": (found.max_m, min(b.max_m for b in bounds)),
        f"RMS {number}": (found.rms_m, min(b.rms_m for b in bounds)),
    }
    if name == "tracking-1":
        errors["steady 1"] = (found.steady_m, BOUNDS.steady_m)
    return errors


def _make_verdict(errors: _Errors) -> GainsVerdict:
    ratios = {name: error / bound for name, (error, bound) in errors.items()}
    why = max(ratios, key=lambda name: ratios[name])
    figures_um = {name: error * 1e6 for name, (error, _) in errors.items()}
    return GainsVerdict(ratios[why], why, figures_um, sum(ratios.values()) / len(ratios))


def _judge_tripped(batch: SimulatedRun) -> GainsVerdict:
    share = len(batch.t_s) / len(batch.run.reference)
    lost = TRIP_COST * (1.0 - 0.9 * share)
    return GainsVerdict(lost, "safety trip", {}, lost)
