"""How often the 90 % intervals of a diagnosis hold the truth, by simulation.

    python scripts/interval_coverage.py [--rigs own,hidden] [--effects NAME,...] [--seeds 4]
        [--program brief] [--workers 2] [--results FILE] [--json | --write]

An effect of random size (1 to 10 smallest sizes of interest), with random parameters, noise and
homing, is hidden in the project's own simulated rig (finely stepped) and in those of tests/hidden,
which share no code with it and have other equations. Only the true structure is fitted, without a
search, so that a rig takes seconds. Rigs stored in the JSONL file are not run again. The table goes
to stdout (markdown or JSON), with --write into README or manual; progress goes to stderr. The
standard error counts rigs, not numbers, because the numbers of one rig are not independent.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "scripts")]

from hidden.effects import SINGLES  # noqa: E402
from hidden.examination.cases import Case  # noqa: E402
from hidden.examination.truth_values import NEUTRAL as HIDDEN_NEUTRAL  # noqa: E402
from hidden.examination.truth_values import TRUE  # noqa: E402
from hidden.excitations import PROGRAMS  # noqa: E402
from hidden.hostile.lab import TRUTH_NAMES  # noqa: E402
from hidden.sensors import ADC_STEP_PA, ENCODER_STEP_M  # noqa: E402
from measured_table import format_table, write_measured  # noqa: E402
from resumable_study import run_resumable  # noqa: E402

from pamctl.diagnose import Record  # noqa: E402
from pamctl.diagnose.evidence.fit import WeighedModel, Weigher  # noqa: E402
from pamctl.diagnose.evidence.intervals import find_intervals  # noqa: E402
from pamctl.diagnose.evidence.name_search import NameSearch  # noqa: E402
from pamctl.diagnose.evidence.pool import PAPER_SCALES, list_effects  # noqa: E402
from pamctl.diagnose.evidence.run_pieces import join_waves  # noqa: E402
from pamctl.diagnose.evidence.weigh import list_pool, prepare_weigher  # noqa: E402
from pamctl.plant.drive import drive_coupled  # noqa: E402
from pamctl.plant.model import PlantSettings  # noqa: E402
from pamctl.plant.parameters import NEUTRAL, PAPER, parameters_of  # noqa: E402

RIGS = ("own", "hidden")
SIZES = (1.0, 10.0)
EXPLAINED = 2.0
"""A model that leaves less than this multiple of each sensor's noise (RMS) explains a rig."""
OFF = {
    "damping_n_s_per_m": 0.06,
    "stiffness_n_per_m": 0.05,
    "kinetic_friction_per_m": 0.08,
    "valve_gain_m2_per_v": 0.07,
    "tank_pressure_pa": 0.015,
    "braid_length_m": 0.003,
}
"""Largest deviation of a rig's numbers from the paper's."""


@dataclass(frozen=True)
class Task:
    """One rig with one effect in it."""

    rig: str
    effect: str
    seed: int
    program: str

    @property
    def key(self) -> str:
        """Its key in the results."""
        return f"{self.rig}/{self.effect}#{self.seed}@{self.program}"

    @property
    def random(self) -> np.random.Generator:
        """Its own random generator, the same each time."""
        return np.random.default_rng(zlib.crc32(self.key.encode()))


Runs = tuple[list[Record], list[Record]]


def run_hidden_rig(task: Task) -> tuple[Runs, dict[str, float]]:
    """Return a hidden rig's records, and those of its numbers that mean the same in both forms."""
    size = _size(task.random)
    case = Case(
        task.key,
        "coverage",
        {task.effect: size},
        program=task.program,
        encoder_homed=task.effect != "external_load",
        repeat=task.seed,
    )
    rig, (train, held) = case.rig, case.records()
    true = {name: getattr(rig.truth, TRUTH_NAMES[name]) for name in OFF}
    for name, number in TRUE.get(task.effect, {}).items():
        if not math.isclose(number(rig), HIDDEN_NEUTRAL.get(name, 0.0), abs_tol=1e-15):
            true[f"{task.effect}.{name}"] = number(rig)
    return ([_to_record(r) for r in train], [_to_record(r) for r in held]), true


def _to_record(record: Any) -> Record:
    return Record(name=record.name, **record.columns())


def run_own_rig(task: Task) -> tuple[Runs, dict[str, float]]:
    """Return records of the project's own plant, and its numbers."""
    random = task.random
    muscle = {n: PAPER[n] * (1.0 + by * random.uniform(-1.0, 1.0)) for n, by in OFF.items()}
    hidden = _draw_parameters(task.effect, random)
    truth = parameters_of({**muscle, **hidden})
    noise_pa = float(random.choice([150.0, 300.0, 600.0]))
    phase = random.uniform()

    def run(name: str, command_v: np.ndarray) -> Record:
        driven = drive_coupled(truth, command_v, 1e-3, steps=16)
        pressure_pa = driven.pressure_pa + random.normal(0.0, noise_pa, len(command_v))
        return Record(
            name,
            np.arange(len(command_v)) * 1e-3,
            valve_v=command_v,
            pressure_pa=np.round(pressure_pa / ADC_STEP_PA) * ADC_STEP_PA,
            position_m=np.floor(driven.position_m / ENCODER_STEP_M + phase) * ENCODER_STEP_M,
        )

    train, held = PROGRAMS[task.program](int(random.integers(1_000_000)))
    commands = [[(e.name, e.volts) for e in part if e.volts is not None] for part in (train, held)]
    runs = ([run(*c) for c in commands[0]], [run(*c) for c in commands[1]])
    return runs, {**muscle, **hidden}


def _size(random: np.random.Generator) -> float:
    return float(np.exp(random.uniform(*np.log(SIZES))))


def _draw_parameters(effect: str, random: np.random.Generator) -> dict[str, float]:
    """Draw an effect in one of its forms: its sizes, and its shapes about where a fit starts."""
    forms = [
        v for h in list_effects("muscle", PAPER_SCALES) if h.family == effect for v in h.variants
    ]
    form = forms[int(random.integers(len(forms)))]
    size = _size(random)
    values = dict(form.held)
    for u in form.sizes:
        neutral, step = u.neutral or 0.0, size * random.uniform(0.85, 1.15) * u.smallest
        values[u.name] = neutral + step if neutral + step < u.high else neutral - step
    for u in form.shapes:
        values[u.name] = float(np.clip(u.value * random.uniform(0.7, 1.4), u.low, u.high))
    return join_waves(values)[0]


def fit_structure(runs: Runs, effect: str) -> tuple[Weigher, WeighedModel]:
    """Fit the true structure, as the diagnosis does after it has found it."""
    plant = PlantSettings()
    weigher, start = prepare_weigher(*runs, plant)
    base = weigher.leave_out(weigher.settle(start))
    pool = {h.name: h for h in list_pool(weigher.train, weigher.base, plant) if h.family == effect}
    search = NameSearch(weigher, pool)
    fits = search.refit(base, search.score(base, [*pool]), len(pool))
    return weigher, weigher.settle(fits[0]) if fits else base


def examine_task(task: Task) -> dict[str, Any]:
    """Return the intervals of one rig with the true values."""
    runs, true = {"own": run_own_rig, "hidden": run_hidden_rig}[task.rig](task)
    began = time.process_time()
    weigher, m = fit_structure(runs, task.effect)
    left2 = weigher.like.mean_squares(m.d) / weigher.find_noise2(m)
    ratios = dict(zip(weigher.train.channels, map(float, np.sqrt(left2)), strict=True))
    return {
        "key": task.key,
        "rig": task.rig,
        "effect": task.effect,
        "at_floor": max(ratios.values()) < EXPLAINED,
        "ratios": ratios,
        "seconds": time.process_time() - began,
        "numbers": [
            {"name": name, "true": true[name], "value": m.values[name], "ci90": [*ends]}
            for name, ends in find_intervals(weigher, m).items()
            if name in true
        ],
    }


@dataclass(frozen=True)
class Coverage:
    """How often intervals held the truth."""

    what: str
    rigs: int
    numbers: int
    covered: float
    standard_error: float
    half_width: float
    """Median, as a share of the number's distance from neutral (of its value)."""


def compute_coverage(
    what: str, results: Iterable[dict[str, Any]], *, of_effect: bool = True
) -> Coverage:
    """Count over rigs: the numbers of the effect, or the recalibrated ones."""
    shares, widths, count = [], [], 0
    for result in results:
        numbers = [n for n in result["numbers"] if ("." in n["name"]) == of_effect]
        if numbers:
            shares.append(
                float(np.mean([n["ci90"][0] <= n["true"] <= n["ci90"][1] for n in numbers]))
            )
            widths += [_half_width(n) for n in numbers]
            count += len(numbers)
    covered = float(np.mean(shares)) if shares else math.nan
    # One rig more on either side: a few rigs that all hold must not look certain.
    smooth = (covered * len(shares) + 1.0) / (len(shares) + 2.0)
    error = math.sqrt(smooth * (1.0 - smooth) / max(len(shares), 1))
    return Coverage(what, len(shares), count, covered, error, float(np.median(widths or [np.nan])))


def _half_width(number: dict[str, Any]) -> float:
    low, high = number["ci90"]
    return float(0.5 * (high - low) / abs(number["true"] - NEUTRAL.get(number["name"], 0.0)))


def summarise(results: Sequence[dict[str, Any]]) -> list[Coverage]:
    """Return the whole table: by rig, then by effect."""
    at_floor = [r for r in results if r["at_floor"]]
    lines = []
    for rig in RIGS:
        of_rig = [r for r in at_floor if r["rig"] == rig]
        if of_rig:
            lines.append(compute_coverage(f"{rig} rigs: numbers of the effect", of_rig))
            lines.append(
                compute_coverage(f"{rig} rigs: recalibrated numbers", of_rig, of_effect=False)
            )
    above = [r for r in results if not r["at_floor"]]
    if above:
        lines.append(compute_coverage("fits that leave more than the noise", above))
    by_effect = [
        compute_coverage(f"`{name}`", [r for r in at_floor if r["effect"] == name])
        for name in sorted({r["effect"] for r in results})
    ]
    return [line for line in (*lines, *by_effect) if line.rigs]


def format_markdown(lines: Sequence[Coverage]) -> str:
    """Return the table."""
    rows = [
        [
            line.what,
            str(line.rigs),
            str(line.numbers),
            f"{line.covered:.0%} ± {line.standard_error:.0%}",
            f"{line.half_width:.2%}",
        ]
        for line in lines
    ]
    return format_table(
        ["", "rigs", "numbers", "90 % intervals that hold the truth", "half width"], rows
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rigs", default=",".join(RIGS))
    parser.add_argument("--effects", default=",".join(SINGLES))
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--program", choices=PROGRAMS, default="brief")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--results", type=Path, default=Path("logs/coverage.jsonl"))
    parser.add_argument("--json", action="store_true")
    parser.add_argument(
        "--write", "--readme", action="store_true", help="write the table into README or manual"
    )
    options = parser.parse_args()
    tasks = [
        Task(rig, effect, seed, options.program)
        for seed in range(options.seeds)
        for effect in options.effects.split(",")
        for rig in options.rigs.split(",")
    ]
    keyed = {task.key: task for task in tasks}
    found = run_resumable(keyed, examine_task, options.results, options.workers)
    lines = summarise([found[key] for key in keyed])
    if options.json:
        print(json.dumps([asdict(line) for line in lines], indent=2))
        return
    print(format_markdown(lines))
    if options.write:
        write_measured("interval_coverage", format_markdown(lines))


if __name__ == "__main__":
    main()
