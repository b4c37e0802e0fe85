"""After the decision: gains for the plant that was found, and tracking before and after on the rig.

New gains are tried on the rig only if they are better in simulation, on every plant of the jury.
They stay only if the rig tracks better with them; else the old gains are loaded again, however the
retuning ends: also by the daemon, where this process is killed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pamctl.on_rig.decide_on_rig import Investigation
from pamctl.on_rig.retune_search import BETTER, SAME, SAME_M, search_gains
from pamctl.on_rig.retuning_result import Retuning
from pamctl.on_rig.rig_plan import REST_S
from pamctl.session.pamctl_error import PamctlError, translate_errors
from pamctl.session.run import RunMetrics
from pamctl.session.steered_rig import SteeredRig

TRIAL_S = 15.0
"""So long after a run the daemon waits for the word that new gains stay."""


def retune_on_rig(
    rig: SteeredRig, investigation: Investigation, progress: Callable[[str], None]
) -> None:
    """Search gains for the found plant; track before and after, if time is left on the rig.

    The investigation's `retuning` says what came of it, also where an exception ends it: then the
    gains are as before.
    """
    done = investigation.retuning = Retuning()
    plan, found, old = investigation.plan, investigation.diagnosis, rig.gains
    assert found is not None
    assert found.model is not None
    needed_s = 2.0 * (plan.motion_s + REST_S)
    if investigation.rig_time_s + needed_s > 60.0 * plan.budget.minutes:
        done.why = f"{needed_s:.0f} s on the rig are needed, and the budget has less"
        return
    if old.get("length_unit") == "inch":
        done.why = "the gains in use are in inches, and a search works in mm"
        return
    progress("retune: searching gains for the found plant")
    noise_pa = found.model.evidence.noises["pressure_pa"].total
    try:
        gains = search_gains(
            old, found, plan.motion, noise_pa / plan.limits.calibration.sensor_pa_per_v
        )
    except ValueError as error:
        done.why = str(error)
        return
    if gains is None:
        done.why = "no gains were found that track better in simulation, with no error larger"
        return
    motion = plan.motion.model_dump(mode="json", exclude_none=True)
    progress("retune: tracking with the gains in use")
    done.runs["before"] = rig.run(motion, name="before")
    rig.sleep(REST_S)
    try:
        rig.load(gains, trial_s=TRIAL_S)
        done.gains = gains
        progress("retune: tracking with the new gains")
        done.runs["after"] = rig.run(motion, name="after")
        if tracks_better(done.runs["before"].metrics, done.runs["after"].metrics):
            rig.load(gains)
            done.is_kept = True
    finally:
        if not done.is_kept:
            _restore(rig, old, progress)
    better = "better" if done.is_kept else "no better"
    done.why = f"the rig tracks {better} with them"


def _restore(rig: SteeredRig, gains: dict[str, Any], progress: Callable[[str], None]) -> None:
    """Load the gains from before, even where a fault is latched; a rig that is gone keeps none."""
    try:
        with translate_errors():
            rig.load(gains)
    except PamctlError as error:
        progress(f"retune: the old gains could not be loaded again: {error.reason}")


def tracks_better(before: RunMetrics, after: RunMetrics) -> bool:
    """Tell whether the rig tracked better: its RMS error fell, its largest error did not grow."""
    return (
        after.rms_error_m <= BETTER * before.rms_error_m
        and after.max_error_m <= SAME * before.max_error_m + SAME_M
    )
