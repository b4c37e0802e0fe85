"""Do the monitor and `pamctl health` notice what changed on a rig, and name it rightly?

    python scripts/watch_study.py [--only PATTERN] [--rigs 5] [--first 800] [--no-diagnosis]
        [--jobs 1] [--results FILE] [--list]

The rigs are those of tests/hidden: they share no code with the plant. A case is one of three kinds:

- `quiet/SEED`: the monitor watches six records of a faultless rig: each alarm is false.
- `alarm/EFFECT/EXCITATION`: an effect comes, and the monitor's alarm with its explanation.
- `health/CHANGE/SEED`: a number changes, or an effect comes, between two runs of 14 s. Where
  `health` advises it, the later run is diagnosed.

Whatever comes is three times as large as what matters. Results are kept line by line, and a study
that was stopped goes on. Markdown on stdout, progress on stderr.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from measured_table import format_table
from resumable_study import Outcome, run_resumable

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from hidden.excitations import Excitation, multisine, tracking
from hidden.hostile.lab import FITTED, TRUTH_NAMES
from hidden.rig import HiddenRig, hidden_rig

from pamctl.diagnose.record import Record
from pamctl.log.measured_signals import Signals
from pamctl.plant.model import PlantSettings
from pamctl.signals import Phase
from pamctl.watch.explain_alarm import explain_record
from pamctl.watch.follow_health import MISFIT, FollowedDrift, find_changes, fit_record
from pamctl.watch.health_words import list_rivals
from pamctl.watch.watch_run import RunWatch

TIMES_SMALLEST = 3.0
HEALTH_RUN_S = 14.0
FACTORS = {
    "stiffness_n_per_m": 1.03,
    "kinetic_friction_per_m": 0.95,
    "damping_n_s_per_m": 1.05,
    "valve_gain_m2_per_v": 0.97,
    "tank_pressure_pa": 0.985,
}
"""What a number that changes is multiplied by."""
COMING = (
    "chamber_leak", "valve_deadband", "valve_hysteresis", "pressure_sensor_offset", "stribeck",
)  # fmt: skip
"""Effects that come between two runs."""
WATCHED = (
    "chamber_leak", "valve_leak", "valve_deadband", "valve_hysteresis", "command_delay",
    "supply_droop", "valve_spool", "valve_asymmetry", "creep", "stribeck", "coulomb_friction",
    "return_friction", "cubic_stiffness", "encoder_backlash",
)  # fmt: skip
"""Effects that come under the monitor's eyes."""
EXCITATIONS: dict[str, Callable[[], Excitation]] = {
    "tracking": lambda: tracking(18.0, 53),
    "multisine": lambda: multisine(2.0, 0.3, 50.0, 18.0, 53),
}
SECOND = 1000
"""Ticks that the monitor gets at a time."""


def plant_of(rig: HiddenRig) -> PlantSettings:
    """Return the plant file that belongs to a hidden rig without effects."""
    numbers = {theirs: getattr(rig.truth, TRUTH_NAMES[theirs]) for theirs in FITTED}
    return PlantSettings.model_validate({"parameters": numbers})


# --- the monitor -------------------------------------------------------------------------


def run_watched(rig: HiddenRig, excitation: Excitation) -> Signals:
    """Run a hidden rig; return its record as the monitor gets it from a log."""
    record = rig.run(excitation).record
    return Signals(
        t_s=record.t_s,
        dt_s=np.diff(record.t_s, prepend=record.t_s[0] - 1e-3),
        valve_v=record.valve_v,
        pressure_pa=record.pressure_pa,
        position_m=record.position_m,
        force_n=None,
        missed=np.zeros(len(record.t_s), dtype=np.int64),
        phase=np.full(len(record.t_s), int(Phase.TRACK)),
        held_v=excitation.rest_v,
    )


def watch_quiet(seed: int) -> Outcome:
    """Watch a faultless rig: two excitations in turn."""
    rig = hidden_rig({}, seed=seed)
    watch, alarms = RunWatch(plant_of(rig)), []
    for k in range(6):
        watch.begin_run()
        excitation = tracking(18.0, seed + k) if k % 2 else multisine(1.5, 0.3, 40.0, 18.0, k)
        reports = watch.take(run_watched(rig, excitation), 30.0 * k)
        alarms += [block for block, report in reports.items() if report.alarm]
    said = f"{len(alarms)} false alarms in {watch.windows} windows"
    return {"alarms": alarms, "windows": watch.windows, "mark": "wrong" if alarms else "quiet",
            "said": said}  # fmt: skip


def watch_change(name: str, excitation: str, diagnoses: bool) -> Outcome:
    """Watch a sound run, and then one with an effect; say when the alarm came."""
    sound, changed = (hidden_rig(e, seed=3) for e in ({}, {name: TIMES_SMALLEST}))
    plant = plant_of(sound)
    watch, before = RunWatch(plant), run_watched(sound, tracking(18.0, 3))
    watch.take(before, 0.0)
    begin_s, delay_s = len(before) * 1e-3 + 5.0, None
    watch.begin_run()
    signals = run_watched(changed, EXCITATIONS[excitation]())
    for first in range(0, len(signals), SECOND):
        reports = watch.take(signals[first : first + SECOND], begin_s + first * 1e-3)
        if delay_s is None and any(report.alarm for report in reports.values()):
            delay_s = (first + SECOND) * 1e-3
    if delay_s is None:
        return {"delay_s": None, "mark": "missed", "said": "no alarm"}
    found: Outcome = {"delay_s": delay_s, "mark": "noticed", "said": f"alarm after {delay_s:g} s"}
    record = watch.recall(begin_s)
    if diagnoses and record is not None:
        told = explain_record(record, plant, watch.recall_before(begin_s))
        found |= {"diagnosis": told, "mark": judge_names(name, told) or "wrong"}
        found["said"] += f": {told['sentence']}"
    return found


# --- health ------------------------------------------------------------------------------


def change(name: str, seed: int) -> HiddenRig:
    """Return the rig of a seed after a change."""
    if name not in FACTORS:
        return hidden_rig({name: TIMES_SMALLEST}, seed=seed)
    rig = hidden_rig({}, seed=seed)
    mine = TRUTH_NAMES[name]
    return replace(
        rig, truth=rig.truth._replace(**{mine: FACTORS[name] * getattr(rig.truth, mine)})
    )


def follow_health(name: str, seed: int, diagnoses: bool) -> Outcome:
    """Compare a run before and after a change; diagnose the later one where that is the advice."""
    before = hidden_rig({}, seed=seed)
    plant = plant_of(before)
    records = [
        Record(name=when, **rig.run(tracking(HEALTH_RUN_S, 1000 * seed + k)).record.columns())
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
    found: Outcome = {"misfits": misfits, "moved": moved, "said": f"{moved} {misfits}"}
    if diagnoses and (misfits or any(len(rivals) > 1 for rivals in moved.values())):
        found["diagnosis"] = explain_record(records[1], plant, records[0])
        found["said"] += f" {found['diagnosis']['sentence']}"
    return found | {"mark": judge_health(name, found)}


def judge_health(name: str, found: Outcome) -> str:
    """Return named, diagnosed, set, lead, wrong or missed."""
    moved, misfits, told = found["moved"], found["misfits"], found.get("diagnosis")
    if not moved and not misfits:
        return "missed"
    if told and told["verdict"] == "miscalibrated":  # so no effect: the numbers that moved
        return "diagnosed" if [*moved] == [name] else "wrong"
    if told and (mark := judge_names(name, told)):
        return mark
    sets = [{number, *rivals} for number, (_, *rivals) in moved.items()]
    if not misfits and all(name in each for each in sets):
        return "set" if any(len(each) > 1 for each in sets) else "named"
    return "lead" if misfits else "wrong"


def judge_names(name: str, told: Outcome) -> str:
    """Return diagnosed, set (one of several), or nothing: a diagnosis does not hold the name."""
    if told["effects"] == [name] and not told["not_refuted"]:
        return "diagnosed"
    return "set" if name in (*told["effects"], *told["not_refuted"]) else ""


# --- the study ---------------------------------------------------------------------------


def list_cases(rigs: int, first: int) -> list[str]:
    """Return every case by its key."""
    seeds = range(first, first + rigs)
    quiet = [f"quiet/{seed}" for seed in seeds]
    alarm = [f"alarm/{name}/{excitation}" for name in WATCHED for excitation in EXCITATIONS]
    health = [f"health/{name}/{seed}" for seed in seeds for name in (*FACTORS, *COMING)]
    return [*quiet, *alarm, *health]


def examine(key: str, diagnoses: bool) -> Outcome:
    """Examine one case."""
    kind, what, *rest = key.split("/")
    if kind == "quiet":
        found = watch_quiet(int(what))
    elif kind == "alarm":
        found = watch_change(what, rest[0], diagnoses)
    else:
        found = follow_health(what, int(rest[0]), diagnoses)
    return {"key": key, **found}


def format_study(results: list[Outcome]) -> Iterator[str]:
    """Yield a table a kind: a row for each change, with its marks and delays."""
    for kind in dict.fromkeys(r["key"].split("/")[0] for r in results):
        mine = [r for r in results if r["key"].startswith(f"{kind}/")]
        marks = list(dict.fromkeys(r["mark"] for r in mine))
        groups: dict[str, list[Outcome]] = {}
        for r in mine:
            groups.setdefault("rigs" if kind == "quiet" else r["key"].split("/")[1], []).append(r)
        rows = []
        for name, of_name in {**groups, "all": mine}.items():
            counts = [sum(r["mark"] == mark for r in of_name) for mark in marks]
            delays = [f"{r['delay_s']:g}" for r in of_name if r.get("delay_s") and name != "all"]
            rows.append([name, *map(str, (len(of_name), *counts)), ", ".join(delays)])
        yield format_table([kind, "cases", *marks, "alarm after, s"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--only", default="", help="only cases whose key has this pattern")
    parser.add_argument("--rigs", type=int, default=5, help="of quiet and health")
    parser.add_argument("--first", type=int, default=800, help="the first rig's seed")
    parser.add_argument("--no-diagnosis", action="store_true", help="notice only")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--results", type=Path, default=Path("logs/watch.jsonl"))
    parser.add_argument("--list", action="store_true", help="print the cases and stop")
    options = parser.parse_args()
    keys = [key for key in list_cases(options.rigs, options.first) if re.search(options.only, key)]
    if options.list:
        print("\n".join(keys))
        return
    one = partial(examine, diagnoses=not options.no_diagnosis)
    tasks = {key: key for key in keys}
    found = run_resumable(
        tasks, one, options.results, options.jobs, lambda r: f"{r['mark']}: {r['said']}"
    )
    print("\n\n".join(format_study([found[key] for key in keys])))


if __name__ == "__main__":
    main()
