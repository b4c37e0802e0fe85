"""Does `diagnose --on-rig --then tune` pay on rigs with a hidden effect, and does it ever harm?

    python scripts/retune_after_diagnosis.py [--effect NAME[/FORM]:SIZE ...] [--law qsmc]
        [--results FILE]

The rigs are those of tests/hidden: they share no code with the plant, and run here under the loop's
own tick. Each is diagnosed from two runs of `diagnosis`. Then the search of the retuning looks for
gains, from the shipped ones on. Both track on the rig: the motion of the retuning, which decides
whether the rig keeps the new gains, and the paper's experiments, which no decision sees. Results
are kept line by line, and a study that was stopped goes on. Markdown on stdout, progress on stderr.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from resumable_study import Outcome, run_resumable

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from hidden.own_run import own_run  # noqa: E402
from hidden.plant import HiddenPlant  # noqa: E402
from hidden.rig import HiddenRig, hidden_rig  # noqa: E402
from support.runs import run  # noqa: E402

from pamctl.control.law_registry import installed_laws  # noqa: E402
from pamctl.diagnose import Diagnosis, Record, diagnose  # noqa: E402
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document  # noqa: E402
from pamctl.exit_codes import ExitCode  # noqa: E402
from pamctl.on_rig.retune import tracks_better  # noqa: E402
from pamctl.on_rig.retune_search import search_gains  # noqa: E402
from pamctl.on_rig.rig_plan import TRACKING  # noqa: E402
from pamctl.plant.model import PlantSettings  # noqa: E402
from pamctl.session.run import RunMetrics  # noqa: E402
from pamctl.settings.resolve import SECTIONS, resolve, settings_to_data  # noqa: E402
from pamctl.simulate.merit import compute_merit  # noqa: E402

HIDDEN = (
    "command_delay:10", "valve_hysteresis:5", "valve_deadband:5", "supply_droop/static:10",
    "supply_droop:10", "valve_asymmetry:10", "stribeck:10", "chamber_leak:10",
)  # fmt: skip
"""A loop can feel all of them."""
SEED = 20
MOTIONS = {"motion": TRACKING, "experiment 1": "tracking-1", "experiment 2": "tracking-2"}
"""What is tracked; an experiment by its name runs whole."""
TRIPPED = RunMetrics(math.inf, math.inf, math.inf, math.nan, math.nan, 0, 0)


def retune(hidden: str, law: str) -> Outcome:
    """Diagnose one rig, search gains, and track on the rig with the old and the new ones."""
    name, size = hidden.split(":")
    name, _, form = name.partition("/")
    rig = hidden_rig({name: (float(size), form)}, seed=SEED)
    found = _diagnose_rig(rig)
    document = build_diagnosis_document(found)
    shipped = resolve(controller=law)
    old, gains = settings_to_data(shipped.controller), None
    if found.model is not None and document["verdict"] not in ("ambiguous", "none_known"):
        noise_pa = found.model.evidence.noises["pressure_pa"].total
        noise_v = noise_pa / shipped.rig.calibration.sensor_pa_per_v
        gains = search_gains(old, found, TRACKING, noise_v)
    tracked = {"before": old, **({"after": gains} if gains else {})}
    figures = {when: _track_all(rig, data) for when, data in tracked.items()}
    kept = "after" in figures and tracks_better(*(figures[w]["motion"] for w in tracked))
    return {
        "key": f"{law} {hidden}",
        "hidden": hidden,
        "verdict": document["verdict"],
        "named": [effect["name"] for effect in document["effects"]],
        "gains": gains,
        "is_kept": kept,
        **{
            when: {
                motion: [m.max_error_m, m.rms_error_m, m.steady_error_m] for motion, m in f.items()
            }
            for when, f in figures.items()
        },
    }


def _diagnose_rig(rig: HiddenRig) -> Diagnosis:
    """Diagnose a rig from two runs of the shipped experiment."""
    runs = (own_run(rig, "diagnosis", seed) for seed in (1, 2))
    train, held_out = (Record(name=each.name, **each.columns()) for each in runs)
    return diagnose([train], [held_out], PlantSettings())


def _track_all(rig: HiddenRig, gains: dict[str, Any]) -> dict[str, RunMetrics]:
    return {name: _track(rig, gains, motion) for name, motion in MOTIONS.items()}


def _track(rig: HiddenRig, gains: dict[str, Any], motion: Any) -> RunMetrics:
    """Track on the hidden rig; errors are of the measured displacement."""
    experiment = motion if isinstance(motion, str) else "tracking-2"
    noise_v = rig.sensors.pressure_noise_pa / resolve().rig.calibration.sensor_pa_per_v
    settings = resolve(
        experiment=experiment,
        fast=True,
        seed=SEED,
        overrides=[f"rig.sim.sensor_noise_v={noise_v}"],
    ).model_copy(update={"controller": SECTIONS["controller"].validate_python(gains)})
    if experiment != motion:
        settings = settings.model_copy(update={"experiment": motion})
    done = run(settings, plant=HiddenPlant(rig))
    if done.ending.code != ExitCode.OK:
        return TRIPPED
    ticks = done.journal.ticks
    t_s = np.array([r.timing.t_s for r in ticks])
    phase = np.array([r.reference.phase for r in ticks])
    error_m = np.array([r.measurement.position_m - r.reference.reference_m for r in ticks])
    found = compute_merit(t_s, phase, error_m)
    assert found is not None
    return RunMetrics(found.max_m, found.rms_m, found.steady_m, math.nan, math.nan, len(ticks), 0)


def write_table(results: list[Outcome]) -> Iterator[str]:
    """Yield one row a rig: max / RMS in µm with the old gains, then with the new ones."""
    yield f"| hidden, size | diagnosis | {' | '.join(MOTIONS)} | the rig keeps |"
    yield f"| --- | --- | {'--- | ' * len(MOTIONS)}--- |"
    for r in results:
        named = f"{r['verdict']}: {', '.join(f'`{n}`' for n in r['named']) or '-'}"
        keeps = "the new ones" if r["is_kept"] else "the old ones"
        cells = [named, *(_compare(r, motion) for motion in MOTIONS)]
        keeps = keeps if "after" in r else "the old ones: none better found"
        yield f"| `{r['hidden'].replace(':', '`, ')} | {' | '.join(cells)} | {keeps} |"


def _compare(result: Outcome, motion: str) -> str:
    return " → ".join(
        f"{1e6 * worst_m:.0f} / {1e6 * rms_m:.1f}"
        for when in ("before", "after")
        if when in result
        for worst_m, rms_m, _ in (result[when][motion],)
    )


def describe(result: Outcome) -> str:
    """Return a few words on a result."""
    moved = "; ".join(f"{motion} {_compare(result, motion)}" for motion in MOTIONS)
    return f"{result['verdict']} {result['named']}: {moved}; kept: {result['is_kept']}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--effect", action="append", metavar="NAME[/FORM]:SIZE")
    parser.add_argument("--law", default="qsmc", choices=sorted(installed_laws()))
    parser.add_argument("--results", type=Path, default=Path("retune-study.jsonl"))
    options = parser.parse_args()
    tasks = {f"{options.law} {hidden}": hidden for hidden in options.effect or HIDDEN}
    results = run_resumable(tasks, partial(retune, law=options.law), options.results, 1, describe)
    print("\n".join(write_table([results[key] for key in tasks])))


if __name__ == "__main__":
    main()
