"""Record faultless rigs in real time, and count what `diagnose` says of them: false alarms.

    python scripts/realtime_nulls.py --rounds 3 --resume nulls.jsonl > nulls.json
    python scripts/realtime_nulls.py --benches sim --keep logs > nulls.json

JSON on stdout, a line for each case and a table on stderr; exit code 3 if a faultless rig was
called faulty. With `--resume` each finished case is stored, and stored cases are not run again.
`--keep` keeps the logs of alarms.

A round records every bench with every experiment, on a PC that is left alone and on a busy one
without real-time scheduling, which misses ticks. A PC that others keep busy is left as it is.
The benches: `pamctl run` over the simulation, and
over the stand-in for NI's driver, on demand and paced by its own clock (they need gcc). The plant
that a log is compared with is the very plant that moved. Every third case has a second run, held
out; every third run over the stand-in has a pressure sensor without noise.

A case is recorded in real time and takes its 8 to 12 s; its diagnosis some seconds.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import numpy as np
from resumable_study import Outcome, run_resumable
from standin.standin import Card

import pamctl.log
from pamctl.compare.comparison import compare_model
from pamctl.diagnose import diagnose, record_of
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.processes.backends import SHARED_MEMORY

PAMCTL = [sys.executable, "-m", "pamctl"]
PATIENT = [
    "rig.limits.sample_age_s=0.5",
    "rig.limits.missed_ticks=2000",
    "rig.loop.heartbeat_ms=2000",
]
EXPERIMENTS = {
    "diagnosis": 10.0,
    "multisine-small": 12.0,
    "null-staircase": 9.0,
    "square-2": 8.0,
    "chirp": 10.0,
    "tracking-2": 12.0,
    "fill-and-hold": 12.0,
}
"""Durations in s; homing comes on top."""
BENCHES = ("sim", "on_demand", "hardware_timed")
NOISE_V = 2e-3
CLEAR = "no_discrepancy"
REFUSED = "bad_data"
PATIENCE_S = 120.0


class Case(NamedTuple):
    """What is recorded and diagnosed."""

    number: int
    bench: str
    experiment: str
    busy: bool

    @property
    def name(self) -> str:
        """What identifies the case; with `busy` in it where it is."""
        return f"{self.bench} {self.experiment}{' busy' if self.busy else ''} {self.number}"

    @property
    def held_out(self) -> bool:
        """A second run judges the fit."""
        return self.number % 3 == 2

    @property
    def noise_v(self) -> float:
        """Noise of the stand-in's pressure sensor."""
        return 0.0 if self.number % 3 == 1 else NOISE_V

    @property
    def plant(self) -> str:
        """The simulation moves any plant; the stand-in knows one only."""
        return "paper-valve109" if self.bench == "sim" and self.number % 2 else "paper"


def list_cases(rounds: int, benches: Sequence[str]) -> list[Case]:
    """List the cases in an order that mixes all kinds early."""
    kinds = [
        (bench, experiment, busy)
        for index, experiment in enumerate(EXPERIMENTS)
        for bench in BENCHES
        for busy in ((False, True) if index % 2 else (True, False))
    ]
    every = [Case(number, *kind) for number, kind in enumerate(kinds * rounds)]
    return [case for case in every if case.bench in benches]


# --- recording ---------------------------------------------------------------------------


def is_idle() -> bool:
    """Tell whether others leave this PC alone."""
    return os.getloadavg()[0] < len(os.sched_getaffinity(0))


@contextmanager
def keep_busy(wanted: bool) -> Iterator[None]:
    """Keep every CPU busy with ordinary processes."""
    count = len(os.sched_getaffinity(0)) if wanted else 0
    burning = [sys.executable, "-c", "while True: pass"]
    with ExitStack() as ended:
        for _ in range(count):
            process = subprocess.Popen(burning)
            ended.callback(process.wait)
            ended.callback(process.kill)
        yield


def record_run(case: Case, path: Path, seed: int) -> None:
    """Record one run; raise `RuntimeError` with its words where it does not end well."""
    name = f"nulls{os.getpid()}"
    settings, environment = [*PATIENT], dict(os.environ)
    if case.bench == "sim":
        settings.append(f"rig.sim.device={name}")
    else:
        card = Card(path.with_suffix(".registers"), name)
        card.registers.noise_v = case.noise_v
        card.registers.noise_state += seed
        card.registers.encoder_phase_edges = (seed % 10) / 10.0
        environment = dict(card.environment())
        settings += [f"rig.nidaq.device={name}", f"rig.nidaq.timing={case.bench}"]
        settings.append("rig.safe_volts=0.0")
    backend = "sim" if case.bench == "sim" else "nidaq"
    options = ["--experiment", case.experiment, "--duration", f"{EXPERIMENTS[case.experiment]:g}"]
    burdened = case.busy and is_idle()
    options += ["--plant", case.plant, "--seed", str(seed), *(["--rt", "off"] * burdened)]
    command = [*PAMCTL, "run", "--quiet", "--backend", backend]
    sets = [word for setting in settings for word in ("--set", setting)]
    try:
        with keep_busy(burdened):
            run = subprocess.run(
                [*command, *options, *sets, "--log", str(path)],
                env=environment,
                capture_output=True,
                text=True,
                timeout=PATIENCE_S,
            )
    finally:
        for left in SHARED_MEMORY.glob(f"pamctl-{name}*"):
            left.unlink()
    if run.returncode:
        raise RuntimeError(f"exit {run.returncode}: {run.stderr.strip()[-300:]}")


# --- judging -----------------------------------------------------------------------------


def judge_case(case: Case, logs: Sequence[Path]) -> dict[str, Any]:
    """Compare and diagnose the logs of a case against the plant that moved."""
    measured = pamctl.log.read(logs[0])
    plant = PlantSettings.model_validate(measured.config["plant"])
    signals = pamctl.log.signals(measured)
    acts_s = np.zeros(1) if signals.acts_after_s is None else signals.acts_after_s
    compared = compare_model(measured, plant_parameters(plant))
    gap_m = compared.gap(compared.coupled, "position_m")
    gap_pa = compared.gap(compared.coupled, "pressure_pa")
    records = [record_of(path) for path in logs]
    diagnosis = diagnose(records[:1], records[1:], plant)
    evidence = diagnosis.evidence
    left = {} if evidence is None else evidence.left_over_noise
    return {
        "verdict": str(diagnosis.verdict),
        "said": diagnosis.reason,
        "effects": sorted(f.name for f in diagnosis.findings),
        "left_over_noise": {channel: round(ratio, 2) for channel, ratio in left.items()},
        "coupled_um": round(gap_m.rms * 1e6, 2),
        "coupled_pa": round(gap_pa.rms, 1),
        "missed": int(signals.missed.sum()),
        "late_us": round(float(np.quantile(measured["late_s"], 0.99)) * 1e6, 1),
        "acts_after_us": [round(float(q) * 1e6, 1) for q in np.quantile(acts_s, [0, 0.5, 0.99, 1])],
    }


def examine(case: Case, keep: Path | None) -> Outcome:
    """Record and judge one case; keep the logs of an alarm."""
    with tempfile.TemporaryDirectory() as folder:
        logs = [Path(folder) / f"{case.name}-{i}.mcap" for i in range(1 + case.held_out)]
        try:
            for i, path in enumerate(logs):
                record_run(case, path, 2 * case.number + i + 1)
            found = judge_case(case, logs)
        except (RuntimeError, subprocess.TimeoutExpired, pamctl.log.LogError) as error:
            found = {"verdict": "not recorded", "reason": str(error)}
        if keep is not None and is_alarm(found):
            keep.mkdir(parents=True, exist_ok=True)
            for path in logs:
                shutil.copy(path, keep)
    return {"key": case.name, **found}


def is_alarm(found: Mapping[str, Any]) -> bool:
    """Tell whether a faultless rig was called faulty."""
    return found["verdict"] not in (CLEAR, REFUSED, "not recorded")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=2, help="of 42 cases each")
    parser.add_argument("--benches", default=",".join(BENCHES), help="[default: %(default)s]")
    parser.add_argument("--resume", type=Path, metavar="FILE", help="file that stores each case")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep the logs of alarms here")
    options = parser.parse_args()
    cases = list_cases(options.rounds, options.benches.split(","))
    tasks = {case.name: case for case in cases}
    one = partial(examine, keep=options.keep)
    results = run_resumable(tasks, one, options.resume, 1, describe)
    report = summarise(results)
    tell(report)
    alarms = {name: found for name, found in results.items() if is_alarm(found)}
    print(json.dumps({"benches": report, "alarms": alarms}, indent=1))
    return 3 if alarms else 0


def describe(found: Mapping[str, Any]) -> str:
    if "reason" in found:
        return f"{found['verdict']}: {found['reason']}"
    ratios = ", ".join(f"{b} {r:.2f} x" for b, r in found["left_over_noise"].items())
    loud = "ALARM " if is_alarm(found) else ""
    return (
        f"{loud}{found['verdict']} {' '.join(found['effects'])} {ratios}; "
        f"{found['coupled_um']} um, {found['coupled_pa']} Pa; {found['missed']} missed"
    )


def summarise(results: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the counts of each bench, quiet and busy."""
    rows: dict[str, dict[str, Any]] = {}
    for name, found in results.items():
        bench = f"{name.split()[0]}{' busy' if ' busy ' in name else ''}"
        row = rows.setdefault(bench, {"logs": 0, "clear": 0, "alarms": 0, "refused": 0})
        row["not_recorded"] = row.get("not_recorded", 0) + (found["verdict"] == "not recorded")
        if found["verdict"] == "not recorded":
            continue
        row["logs"] += 1
        row["clear"] += found["verdict"] == CLEAR
        row["refused"] += found["verdict"] == REFUSED
        row["alarms"] += is_alarm(found)
        row["missed"] = row.get("missed", 0) + found["missed"]
        row["worst_um"] = max(row.get("worst_um", 0.0), found["coupled_um"])
    return dict(sorted(rows.items()))


def tell(report: Mapping[str, Mapping[str, Any]]) -> None:
    """Print the table of all benches."""
    print(
        f"{'':<24}{'logs':>6}{'clear':>7}{'alarms':>8}{'refused':>9}{'missed':>8}{'worst um':>10}",
        file=sys.stderr,
    )
    for bench, row in report.items():
        print(
            f"{bench:<24}{row['logs']:>6}{row['clear']:>7}{row['alarms']:>8}{row['refused']:>9}"
            f"{row.get('missed', 0):>8}{row.get('worst_um', 0.0):>10.2f}",
            file=sys.stderr,
        )


if __name__ == "__main__":
    sys.exit(main())
