"""Does `pamctl health` notice what changed between two runs, and name it rightly?

    python scripts/health_study.py [--rigs 5] [--first 800] [--no-diagnosis] [--results FILE]

The rigs are those of tests/hidden: they share no code with the plant. Each tracks 14 s, then again
with one thing changed by some three times what matters: a number of the plant, or an effect that
comes. Both runs are fitted and compared as `health` does. Where it says that an effect moved a
number or left a misfit, the later run is diagnosed, as its advice is. Results are kept line by
line, and a study that was stopped goes on. Markdown on stdout, progress on stderr.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

from resumable_study import Outcome, run_resumable

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from hidden.excitations import tracking
from hidden.rig import HiddenRig, hidden_rig
from monitor_study import plant_of

from pamctl.diagnose.record import Record
from pamctl.health.follow_health import MISFIT, FollowedDrift, find_changes, fit_record
from pamctl.health.health_words import list_rivals
from pamctl.monitor.explain_alarm import explain_record

RUN_S = 14.0
SMALLEST = 3.0
"""Times the smallest size that matters: of an effect."""
NUMBERS = {
    "stiffness_n_per_m": ("stiffness", 1.03),
    "kinetic_friction_per_m": ("mu_k", 0.95),
    "damping_n_s_per_m": ("damping", 1.05),
    "valve_gain_m2_per_v": ("valve_m2_per_v", 0.97),
    "tank_pressure_pa": ("supply_pa", 0.985),
}
"""Number of the plant: its name in the hidden rig, and by which factor it changes."""
EFFECTS = (
    "chamber_leak", "valve_deadband", "valve_hysteresis", "pressure_sensor_offset", "stribeck",
)  # fmt: skip


def change(name: str, seed: int) -> HiddenRig:
    """Return the rig of a seed after a change."""
    if name not in NUMBERS:
        return hidden_rig({name: SMALLEST}, seed=seed)
    rig = hidden_rig({}, seed=seed)
    field, factor = NUMBERS[name]
    changed = {field: factor * getattr(rig.truth, field)}
    return replace(rig, truth=rig.truth._replace(**changed))


def examine(task: tuple[str, int], diagnoses: bool) -> Outcome:
    """Compare a run before and after a change; diagnose the later one where that is the advice."""
    name, seed = task
    before, plant = hidden_rig({}, seed=seed), plant_of(hidden_rig({}, seed=seed))
    records = [
        Record(name=when, **rig.run(tracking(RUN_S, 1000 * seed + k)).record.columns())
        for k, (when, rig) in enumerate({"before": before, "after": change(name, seed)}.items())
    ]
    fitted = [
        replace(fit_record(record, plant), name=record.name, when_s=100.0 * k)
        for k, record in enumerate(records)
    ]
    changes = find_changes(fitted)
    misfits = [c.name for c in changes if c.name.endswith(MISFIT)]
    moved = {
        c.name: [c.relative, *list_rivals(FollowedDrift(c, None, bool(misfits)))]
        for c in changes
        if c.name not in misfits
    }
    found = {"key": f"{name} {seed}", "changed": name, "misfits": misfits, "moved": moved}
    asks = misfits or any(len(rivals) > 1 for rivals in moved.values())
    if diagnoses and asks:
        found["diagnosis"] = explain_record(records[1], plant, records[0])
    return found


def judge(found: Outcome) -> str:
    """Return named, diagnosed, set, lead, wrong or missed."""
    name, moved, told = found["changed"], found["moved"], found.get("diagnosis")
    if not moved and not found["misfits"]:
        return "missed"
    if told and told["verdict"] == "miscalibrated":  # so no effect: the numbers that moved
        return "diagnosed" if [*moved] == [name] else "wrong"
    if told and [name] == told["effects"] and not told["not_refuted"]:
        return "diagnosed"
    if told and name in (*told["effects"], *told["not_refuted"]):
        return "set"
    sets = [{number, *rivals} for number, (_, *rivals) in moved.items()]
    if not found["misfits"] and all(name in each for each in sets):
        return "set" if any(len(each) > 1 for each in sets) else "named"
    return "lead" if found["misfits"] else "wrong"


def describe(found: Outcome) -> str:
    """Return a few words on a pair."""
    told = found.get("diagnosis", {})
    return f"{judge(found)}: {found['moved']} {found['misfits']} {told.get('sentence', '')}"


def write_table(results: list[Outcome]) -> Iterator[str]:
    """Yield a row for each change, and the sum."""
    kinds = ("named", "diagnosed", "set", "lead", "wrong", "missed")
    yield f"| changed | pairs | {' | '.join(kinds)} |"
    yield f"| --- | --- | {' | '.join('---' for _ in kinds)} |"
    for name in (*NUMBERS, *EFFECTS, ""):
        said = [judge(r) for r in results if r["changed"] == name or not name]
        cells = [f"`{name}`" if name else "all", len(said), *map(said.count, kinds)]
        yield "| " + " | ".join(map(str, cells)) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rigs", type=int, default=5)
    parser.add_argument("--first", type=int, default=800, help="the first rig's seed")
    parser.add_argument("--no-diagnosis", action="store_true", help="compare only")
    parser.add_argument("--results", type=Path, default=Path("health-study.jsonl"))
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.rigs)
    tasks = {f"{name} {seed}": (name, seed) for seed in seeds for name in (*NUMBERS, *EFFECTS)}
    one = partial(examine, diagnoses=not options.no_diagnosis)
    results = run_resumable(tasks, one, options.results, 1, describe)
    print("\n".join(write_table([results[key] for key in tasks])))


if __name__ == "__main__":
    main()
