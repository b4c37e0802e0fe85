"""Gains for the plant that was found: better in the motion that counts, and in no other worse.

The search begins at the gains in use. Its jury is the found plant, the plants at both ends of the
found effects' intervals, as what was measured is known no better, and the found plant behind one
more tick of delay, and with twice the noise. The best of each generation then run the paper's whole
experiments on all of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from pydantic import ValidationError

from pamctl.control.experiment import Experiment
from pamctl.diagnose import Diagnosis
from pamctl.diagnose.fitting.numbers import with_values
from pamctl.plant.model import PlantSettings
from pamctl.settings.resolve import SECTIONS, resolve, settings_to_data
from pamctl.simulate.batch import simulate_run
from pamctl.tune.gains_search import GainsSearch, Jury
from pamctl.tune.gains_trial import TRIP_COST, GainsTrial, GainsVerdict
from pamctl.tune.plant_ensemble import Member

GENERATIONS = 8
BETTER = 0.98
"""Gains count as better if the errors of the motion are below this share of what they were."""
SAME = 1.02
"""No error of the paper's experiments may pass this multiple of what it was,"""
SAME_M = 1e-6
"""or this much more: the encoder counts in steps of some um."""
KEPT_KEYS = ("compensate", "command_limit_v")
"""Keys of the gains in use that no search changes."""


@dataclass(frozen=True)
class MotionTrial(GainsTrial):
    """Errors over those of the gains in use: of the motion, and of the paper's where they grow."""

    old: dict[str, Any] = field(default_factory=dict)
    """The gains in use."""
    motion: Experiment | None = None
    known: dict[str, dict[str, float]] = field(default_factory=dict)
    """Errors of the gains in use (m), by plant; found as they are needed."""

    def verdict(self, controller: Any, member: Member) -> GainsVerdict:
        """Run gains on one plant; the worst ratio counts."""
        if member.name not in self.known:
            old = SECTIONS["controller"].validate_python(self.old)
            self.known[member.name] = self._measure(old, member)
        before, after = self.known[member.name], self._measure(controller, member)
        if not after:
            return GainsVerdict(TRIP_COST, "safety trip", {}, TRIP_COST)
        ratios = {
            name: error / before[name]
            for name, error in after.items()
            if name in before
            and (name.startswith("motion") or error > SAME * before[name] + SAME_M)
        }
        why = max(ratios, key=lambda name: ratios[name], default="none")
        mean = sum(ratios.values()) / max(len(ratios), 1)
        figures_um = {name: 1e6 * error for name, error in after.items()}
        return GainsVerdict(ratios.get(why, 0.0), why, figures_um, mean)

    def _measure(self, controller: Any, member: Member) -> dict[str, float]:
        """Return the errors (m); empty where safety ends a run."""
        motion = _run_motion(controller, member, self.motion)
        paper = super().verdict(controller, member) if motion else None
        if not motion or paper is None or not paper.figures_um:
            return {}
        return {**motion, **{name: 1e-6 * um for name, um in paper.figures_um.items()}}


def _run_motion(controller: Any, member: Member, motion: Any) -> dict[str, float]:
    base = resolve(experiment="tracking-2")
    sim = base.rig.device_settings.model_copy(
        update={
            "sensor_noise_v": member.noise_v,
            "output_delay_ticks": member.output_delay_ticks,
        }
    )
    changed = {
        "controller": controller,
        "plant": member.plant,
        "rig": base.rig.model_copy(update={"sim": sim}),
        "experiment": motion,
        "seed": member.seed,
    }
    found = simulate_run(base.model_copy(update=changed)).merit()
    return {} if found is None else {"motion RMS": found.rms_m, "motion max": found.max_m}


def search_gains(
    old: dict[str, Any], found: Diagnosis, motion: Experiment, noise_v: float
) -> dict[str, Any] | None:
    """Return gains that are better on every plant of the jury; None where none were found.

    `old` are the gains in use (in mm), `noise_v` the noise of the pressure sensor. Raises
    `ValueError` where the law has no search space.
    """
    members = (
        Member("one tick later", found.plant, noise_v, output_delay_ticks=1),
        *(Member(name, plant, noise_v) for name, plant in _list_plants(found)),
        Member("twice the noise", found.plant, 2.0 * noise_v),
    )
    trial = MotionTrial("short", old, motion)
    search = GainsSearch(str(old["law"]), Jury((), members), 0, dict(old), trial=trial)
    elite: list[dict[str, Any]] = []
    for _ in range(GENERATIONS):
        kept = {key: old[key] for key in KEPT_KEYS if key in old}
        if (gains := {**search.advance().gains, **kept}) not in elite:
            elite.append(gains)
    whole = MotionTrial("whole", old, motion)
    for gains in reversed(elite):  # the last one is the best by the short trial
        controller = SECTIONS["controller"].validate_python(gains)
        if all(whole.verdict(controller, m).worst <= BETTER for m in members):
            return settings_to_data(controller)
    return None


def _list_plants(found: Diagnosis) -> Iterator[tuple[str, PlantSettings]]:
    """Yield the found plant, and those at the ends of the intervals of what was named."""
    yield "found", found.plant
    names = found.model.names if found.model else ()
    own = [n for n in found.numbers if n.name.split(".")[0] in names]
    for end, values in (
        ("low", {n.name: n.low for n in own}),
        ("high", {n.name: n.high for n in own}),
    ):
        try:
            plant = with_values(found.plant, values)
        except ValidationError:
            continue  # the interval reaches beyond what a plant may be
        if own:
            yield end, plant
