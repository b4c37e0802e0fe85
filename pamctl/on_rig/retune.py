"""After the decision: gains for the plant that was found, and tracking before and after on the rig.

search  begins at the gains in use; its jury is the found plant, and the plants at both ends of the
        found effects' intervals: what was measured is known no better
whole   the best of each generation track the paper's whole experiments on every plant, also behind
        one more tick of delay and twice the noise; no figure may be worse than with the old gains
rig     the rig tracks with the old gains and with the new ones, which stay only if it tracks better
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from math import inf
from typing import Any

from pydantic import ValidationError

from pamctl.diagnose import Diagnosis
from pamctl.diagnose.fitting.numbers import with_values
from pamctl.on_rig.decide_on_rig import Investigation
from pamctl.on_rig.retuning_result import Retuning
from pamctl.on_rig.rig_plan import REST_S
from pamctl.plant.model import PlantSettings
from pamctl.session.pamctl_error import PamctlError, translate_errors
from pamctl.session.run import RunMetrics
from pamctl.session.steered_rig import SteeredRig
from pamctl.settings.resolve import SECTIONS, settings_to_data
from pamctl.tune.gains_search import GainsSearch, Jury
from pamctl.tune.gains_trial import GainsTrial
from pamctl.tune.plant_ensemble import Member
from pamctl.tune.search_space import find_space

GENERATIONS = 8
BETTER = 0.98
"""Gains count as better if the RMS error is below this share of what it was."""
SAME = 1.02
"""No other error may pass this multiple of what it was,"""
SAME_UM = 1.0
"""or this much more: the encoder counts in steps of some um."""
KEPT_KEYS = ("compensate", "command_limit_v")
"""Keys of the gains in use that no search changes."""
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


def retune_on_rig(
    rig: SteeredRig, investigation: Investigation, progress: Callable[[str], None]
) -> None:
    """Search gains for the found plant; track before and after, if time is left on the rig.

    The investigation's `retuning` says what came of it, also where an exception ends it: then the
    gains are as before.
    """
    done = investigation.retuning = Retuning()
    found = investigation.diagnosis
    assert found is not None
    old = rig.gains
    if reason := _find_obstacle(investigation, old):
        done.why = reason
        return
    progress("retune: searching gains for the found plant")
    with translate_errors():
        gains = _search_gains(old, found, investigation)
    if gains is None:
        done.why = "no gains were found that track better in simulation, with no error larger"
        return
    progress("retune: tracking with the gains in use")
    done.runs["before"] = rig.run(TRACKING, name="before")
    rig.sleep(REST_S)
    try:
        rig.load(gains)
        done.gains = gains
        progress("retune: tracking with the new gains")
        done.runs["after"] = rig.run(TRACKING, name="after")
        done.is_kept = _is_better(done.runs["before"].metrics, done.runs["after"].metrics)
    finally:
        if not done.is_kept:
            _restore(rig, old, progress)
    better = "better" if done.is_kept else "no better"
    done.why = f"the rig tracks {better} with them"


def _restore(rig: SteeredRig, gains: dict[str, Any], progress: Callable[[str], None]) -> None:
    """Load the gains from before, even where a fault is latched; a rig that is gone keeps none."""
    try:
        rig.load(gains)
    except PamctlError as error:
        progress(f"retune: the old gains could not be loaded again: {error.reason}")


def _find_obstacle(investigation: Investigation, old: Mapping[str, Any]) -> str:
    """Return why no gains can be searched, or tried; empty where they can."""
    needed_s = 2.0 * (TRACKING_S + REST_S)
    if investigation.rig_time_s + needed_s > 60.0 * investigation.plan.budget.minutes:
        return f"{needed_s:.0f} s on the rig are needed, and the budget has less"
    if old.get("length_unit") == "inch":
        return "the gains in use are in inches, and a search works in mm"
    try:
        find_space(str(old["law"]))
    except ValueError as error:
        return str(error)
    return ""


def _is_better(before: RunMetrics, after: RunMetrics) -> bool:
    return (
        after.rms_error_m <= BETTER * before.rms_error_m
        and after.max_error_m <= SAME * before.max_error_m + 1e-6 * SAME_UM
    )


def _search_gains(
    old: dict[str, Any], found: Diagnosis, investigation: Investigation
) -> dict[str, Any] | None:
    """Return gains that track better on every plant of the jury; None where none were found."""
    plants = [*_list_plants(found)]
    noise_v = _find_noise_v(found, investigation)
    jury = Jury((), 1.0, tuple(Member(name, plant, noise_v) for name, plant in plants))
    harder = (
        Member("one tick later", found.plant, noise_v, output_delay_ticks=1),
        Member("twice the noise", found.plant, 2.0 * noise_v),
    )
    search = GainsSearch(str(old["law"]), jury, 0, dict(old))
    elite: list[dict[str, Any]] = []
    for _ in range(GENERATIONS):
        best = search.advance().gains
        kept = {key: old[key] for key in KEPT_KEYS if key in old}
        if (gains := {**best, **kept}) not in elite:
            elite.append(gains)
    members = (*jury.named, *harder)
    errors = [_track_whole(old, member) for member in members]
    ranked = [(_compare(gains, members, errors), gains) for gains in elite]
    gain, gains = min(ranked, key=lambda pair: pair[0])
    return _read_controller(gains) if gain <= BETTER else None


def _compare(
    gains: dict[str, Any], members: tuple[Member, ...], errors: list[dict[str, float]]
) -> float:
    """Return the largest RMS error over that of the old gains; infinity if any error is larger."""
    worst = 0.0
    for member, before in zip(members, errors, strict=True):
        after = _track_whole(gains, member)
        if not before:  # a rig that trips with the old gains cannot lose
            continue
        if any(after.get(n, inf) > SAME * before[n] + SAME_UM for n in before):
            return inf
        worst = max(worst, after["RMS 2"] / before["RMS 2"])
    return worst


def _track_whole(gains: dict[str, Any], member: Member) -> dict[str, float]:
    """Return the errors (um) in the paper's whole experiments; empty where safety ends one."""
    controller = SECTIONS["controller"].validate_python(gains)
    return GainsTrial("whole").verdict(controller, member).figures_um


def _read_controller(gains: dict[str, Any]) -> dict[str, Any]:
    return settings_to_data(SECTIONS["controller"].validate_python(gains))


def _find_noise_v(found: Diagnosis, investigation: Investigation) -> float:
    """Return the noise of the rig's pressure sensor (V)."""
    assert found.model is not None
    noise_pa = found.model.evidence.noises["pressure_pa"].total
    return float(noise_pa / investigation.plan.limits.calibration.sensor_pa_per_v)


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
