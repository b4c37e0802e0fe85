"""Does `pamctl diagnose --on-rig` find what a rig hides, behind a real daemon in real time?

    python scripts/on_rig_study.py [--rig NAME:SIZE ...] [--runs 3] [--tries 3]
        [--results FILE]

The rigs are those of tests/hidden: they share no code with the plant. Each stands behind the wires
of the simulated rig, as a backend of its own in a daemon's loop process; the daemon, its guardian
and its recorder are the real ones, and the clock is the PC's. The first program is some seconds of
full strokes, which leave much open. Limits that only a busy PC would pass are wide. A run that got
no CPU is tried again, and counted. Runs follow one another; results are kept line by line, and a
study that was stopped goes on. Markdown on stdout, progress on stderr.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from zlib import crc32

import yaml
from daemon_of_rig import PATIENCE_S, ROOT, hold_daemon, install_backend
from resumable_study import Outcome, run_resumable

RIGS = (
    "command_delay:3", "command_delay:1", "valve_spool:1", "valve_asymmetry:3", "dead_volume:3",
    "polytropic:3", "discharge_ratio:3", "chamber_leak:10", "creep:3", "stribeck:3",
    "encoder_backlash:3", "supply_droop:3",
)  # fmt: skip
FAST_STROKES = ("command_delay", "valve_spool")
"""Effects whose strokes come twice a second, as they act within milliseconds."""
CODE = '''
"""A rig of tests/hidden behind the wires of the simulated one."""
import json, os
from dataclasses import replace
from hal.sim import SIM


class LatePlant:
    """Built as the loop opens the rig: the guardian opens none, and must start at once."""

    plant = None

    def wake(self):
        from hidden.plant import HiddenPlant
        from hidden.rig import hidden_rig

        effects, seed = json.loads(os.environ["HIDDEN_EFFECTS"]), os.environ["HIDDEN_SEED"]
        rig = hidden_rig(effects, seed=int(seed))
        HiddenPlant(rig, 10.0).advance(0.0, 1e-3)  # compiled before the first tick
        self.plant = HiddenPlant(rig, 3600.0)
        return self.plant

    def advance(self, command_v, duration_s):
        if self.plant is not None:
            self.plant.advance(command_v, duration_s)

    def __getattr__(self, name):
        return getattr(self.plant, name)


def build(request):
    plant = LatePlant()
    built = SIM.build(replace(request, plant=plant))
    opened = built.rig.open

    def open_rig():
        plant.wake()
        opened()

    built.rig.open = open_rig
    return built


BACKEND = replace(SIM, name="hidden", description="A rig of the tests.", build=build)
'''
WARM_UP = "from hidden_backend import LatePlant; LatePlant().wake()"
"""Builds the rig's equations into the cache, from which the loop loads them."""
STARVED = ("starved", "did not start", "no CPU", "sample at least", "overrun", "missed")
"""Words of an ending that speak of the PC, not of the rig."""


def write_strokes(path: Path, frequency_hz: int) -> Path:
    """Write the first program: full strokes, slow and then faster."""
    strokes = [{"frequency_hz": 1, "cycles": 2}, {"frequency_hz": frequency_hz, "cycles": 5}]
    parts = [
        {"wave": "hold", "valve_v": -5, "duration_s": 1},
        *({"wave": "square", "amplitude_v": 5, **stroke} for stroke in strokes),
        {"wave": "hold", "valve_v": -5, "duration_s": 1.2},
    ]
    path.write_text(yaml.safe_dump({"kind": "program", "parts": parts}))
    return path


def examine(rig: str, runs: int, tries: int) -> Outcome:
    """Let the daemon decide what one rig hides; try again where the PC gave no time."""
    starved = 0
    while (found := _examine_once(rig, runs))["is_starved"] and starved + 1 < tries:
        starved += 1
    again = {"error": "starved"} if found["is_starved"] else {}  # the next study tries it again
    return {**found, **again, "key": rig, "starved_tries": starved + bool(again)}


def _examine_once(rig: str, runs: int) -> Outcome:
    name, size = rig.split(":")
    began_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="on-rig-") as made:
        folder = Path(made)
        install_backend(folder, "hidden", CODE)
        first = write_strokes(folder / "strokes.yaml", 2 if name in FAST_STROKES else 1)
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(map(str, (ROOT, folder, ROOT / "tests"))),
            "HIDDEN_EFFECTS": json.dumps({name: float(size)}),
            "HIDDEN_SEED": str(crc32(rig.encode()) % 1000),
        }
        subprocess.run([sys.executable, "-c", WARM_UP], env=environment, check=True)
        with hold_daemon(folder, "hidden", environment) as socket:
            command = [sys.executable, "-m", "pamctl", "diagnose", "--on-rig", "--yes", "--json"]
            command += ["--runs", str(runs), "--experiment", str(first), "--socket", str(socket)]
            command += ["--out", str(folder / "found")]
            done = subprocess.run(
                command, env=environment, capture_output=True, text=True, timeout=PATIENCE_S
            )
    print(done.stderr[-2000:] if done.returncode else "", file=sys.stderr)
    try:
        document = json.loads(done.stdout)
    except json.JSONDecodeError:
        document = {"reason": done.stderr[-300:]}
    return {"hidden": name, "wall_s": time.monotonic() - began_s, **_read_document(document)}


def _read_document(document: Outcome) -> Outcome:
    told = document.get("on_rig") or {"rounds": [], "stopped": str(document.get("reason"))}
    reason = f"{told['stopped']} {document.get('reason') or ''}"
    return {
        "is_starved": any(word in reason for word in STARVED),
        "rounds": [[r["verdict"], r["explanations_left"]] for r in told["rounds"]],
        "stopped": told["stopped"],
        "rig_time_s": told.get("rig_time_s"),
        "named": [effect["name"] for effect in document.get("effects", ())],
        "verdict": document.get("verdict"),
        "forecasts": [
            [f["refuted"], f["expected"], f["found"]] for f in document.get("forecasts", ())
        ],
    }


def describe(result: Outcome) -> str:
    """Return a few words on a result: first verdict, last verdict, names, time on the rig."""
    rounds = " -> ".join(f"{verdict} ({', '.join(left)})" for verdict, left in result["rounds"])
    return f"{rounds}; {result['stopped']}; {result['rig_time_s']} s on the rig"


def judge(result: Outcome) -> str:
    """Return right, WRONG, open, or not run."""
    if not result["rounds"] or result["is_starved"]:
        return "not run"
    if result["verdict"] not in ("named", "partial", "described"):
        return "open"
    return "right" if result["named"] == [result["hidden"]] else "WRONG"


def write_table(results: list[Outcome]) -> Iterator[str]:
    """Yield the lines of the table, and the sums."""
    yield "| hidden, size | after the first program | at the end | programs | on the rig | is |"
    yield "| --- | --- | --- | --- | --- | --- |"
    for r in results:
        first = " ".join([r["rounds"][0][0], *r["rounds"][0][1]]) if r["rounds"] else "-"
        last = f"{r['verdict']} {', '.join(r['named'])}"
        rig = f"{r['rig_time_s'] or 0.0:.0f} s"
        cells = (f"`{r['key'].replace(':', '`, ')}", first, last, len(r["rounds"]), rig, judge(r))
        yield "| " + " | ".join(map(str, cells)) + " |"
    kinds = [judge(r) for r in results]
    asked = [r for r in results if r["rounds"] and len(r["rounds"][0][1]) > 1]
    decided = sum(judge(r) == "right" for r in asked)
    starved = sum(r["starved_tries"] for r in results)
    sums = ", ".join(f"{kinds.count(k)} {k}" for k in ("right", "WRONG", "open", "not run"))
    yield f"\n{sums}; of {len(asked)} open ones {decided} decided rightly; {starved} starved."


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rig", action="append", metavar="NAME:SIZE")
    parser.add_argument("--runs", type=int, default=3, help="most programs, with the first")
    parser.add_argument("--tries", type=int, default=3, help="of a rig whose PC gave no time")
    parser.add_argument("--results", type=Path, default=Path("on-rig-study.jsonl"))
    options = parser.parse_args()
    rigs = options.rig or RIGS
    one = partial(examine, runs=options.runs, tries=options.tries)
    tasks = {rig: rig for rig in rigs}
    results = run_resumable(tasks, one, options.results, 1, describe)
    print("\n".join(write_table([results[rig] for rig in rigs])))


if __name__ == "__main__":
    main()
