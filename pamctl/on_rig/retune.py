"""After the decision: gains for the plant that was found, and tracking before and after on the rig.

The search begins at the gains in use. Its jury is the found plant, and the plants at both ends of
the found effects' intervals: what was measured is known no better. New gains are tried on the rig
only if they do better before that jury, and stay only if the rig tracks better with them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from pamctl.diagnose import Diagnosis
from pamctl.diagnose.fitting.numbers import with_values
from pamctl.on_rig.decide_on_rig import Investigation
from pamctl.on_rig.rig_plan import REST_S
from pamctl.plant.model import PlantSettings
from pamctl.session.pamctl_error import translate_errors
from pamctl.session.run import RunMetrics
from pamctl.session.steered_rig import SteeredRig
from pamctl.settings.resolve import SECTIONS, settings_to_data
from pamctl.tune.gains_search import GainsSearch, Jury, compute_cost
from pamctl.tune.gains_trial import GainsTrial
from pamctl.tune.plant_ensemble import make_fixed_members

GENERATIONS = 8
BETTER = 0.98
"""Gains count as better if what counts is below this share of what it was."""
TRACKING: dict[str, Any] = {
    "kind": "tracking",
    "offset_mm": 11.8,
    "amplitude_mm": 5.4,
    "transition_s": 5.0,
    "rest_s": 0.0,
    "cycles": 1,
    "approach_s": 5.0,
    "settle_s": 2.0,
}
"""One cycle of the paper's experiment 2."""
TRACKING_S = 17.0


@dataclass(frozen=True)
class Retuning:
    """What was tried, and what the rig said to it."""

    why: str
    is_kept: bool = False
    """The rig goes on with the new gains."""
    gains: dict[str, Any] | None = None
    """The keys of a controller file; None where nothing better was found."""
    before: RunMetrics | None = None
    after: RunMetrics | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return what the document holds."""
        return {
            "why": self.why,
            "is_kept": self.is_kept,
            "gains": self.gains,
            **{
                name: None
                if run is None
                else {"max_error_m": run.max_error_m, "rms_error_m": run.rms_error_m}
                for name, run in (("before", self.before), ("after", self.after))
            },
        }


def retune_on_rig(
    rig: SteeredRig, investigation: Investigation, progress: Callable[[str], None]
) -> Retuning:
    """Search gains for the found plant; track before and after, if time is left on the rig."""
    found = investigation.diagnosis
    assert found is not None
    needed_s = 2.0 * (TRACKING_S + REST_S)
    if investigation.rig_time_s + needed_s > 60.0 * investigation.plan.budget.minutes:
        return Retuning(f"{needed_s:.0f} s on the rig are needed, and the budget has less")
    old = rig.gains
    if old.get("length_unit") == "inch":
        return Retuning("the gains in use are in inches, and a search works in mm")
    progress("retune: searching gains for the found plant")
    with translate_errors():
        gains, gain = _search_gains(old, found)
    if gain > BETTER:
        return Retuning(f"no gains were found that do better in simulation (cost {gain:.2f} x)")
    progress("retune: tracking with the gains in use")
    before = rig.run(TRACKING, name="before").metrics
    rig.sleep(REST_S)
    try:
        rig.load(gains)
        progress("retune: tracking with the new gains")
        after = rig.run(TRACKING, name="after").metrics
    except BaseException:
        _restore(rig, old)
        raise
    if after.rms_error_m <= BETTER * before.rms_error_m:
        return Retuning("the rig tracks better with them", True, gains, before, after)
    _restore(rig, old)
    return Retuning("the rig tracks no better with them", False, gains, before, after)


def _restore(rig: SteeredRig, gains: dict[str, Any]) -> None:
    """Load the gains from before, unless a fault is latched: then they come with the next start."""
    if rig.state != "fault":
        rig.load(gains)


def _search_gains(old: dict[str, Any], found: Diagnosis) -> tuple[dict[str, Any], float]:
    """Return the best gains, and their cost over that of the gains in use."""
    jury = Jury((), 1.0, tuple(make_fixed_members([*_list_plants(found)])))
    trial = GainsTrial("short")
    search = GainsSearch(str(old["law"]), jury, 0, dict(old), trial=trial)
    for _ in range(GENERATIONS):
        best = search.advance()
    controller = SECTIONS["controller"].validate_python(old)
    cost = compute_cost(controller, 1e9, jury, trial, ()).value
    gains = settings_to_data(SECTIONS["controller"].validate_python(best.gains))
    return gains, best.cost / cost


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
