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
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "scripts")]

from hidden.effects import SINGLES  # noqa: E402
from hidden.examination.cases import Case  # noqa: E402
from hidden.examination.examine import records_of, rig_of  # noqa: E402
from hidden.examination.truth_values import NEUTRAL as HIDDEN_NEUTRAL  # noqa: E402
from hidden.examination.truth_values import TRUE  # noqa: E402
from hidden.excitations import PROGRAMS  # noqa: E402
from hidden.rig import HiddenRig  # noqa: E402
from hidden.sensors import ADC_STEP_PA, ENCODER_STEP_M  # noqa: E402
from measured_table import format_table, write_measured  # noqa: E402
from resumable_study import run_resumable  # noqa: E402

from pamctl.diagnose import Record  # noqa: E402
from pamctl.diagnose.fitting.candidates import Candidate, list_candidates, select_reaching  # noqa: E402
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE  # noqa: E402
from pamctl.diagnose.fitting.evidence import Evidence, prepare_evidence, with_modelled_pressure  # noqa: E402
from pamctl.diagnose.fitting.fitted_model import Model  # noqa: E402
from pamctl.diagnose.fitting.intervals import estimate_intervals  # noqa: E402
from pamctl.diagnose.fitting.model_fit import fit_model, recalibrate  # noqa: E402
from pamctl.diagnose.naming.score import score_candidates  # noqa: E402
from pamctl.diagnose.naming.search import (  # noqa: E402
    confirm_complete,
    fit_to_end_if_near,
    rank,
)
from pamctl.diagnose.naming.shortlist import list_other_starts  # noqa: E402
from pamctl.plant.drive import drive_coupled  # noqa: E402
from pamctl.plant.flat import NEUTRAL, PAPER, parameters_of  # noqa: E402
from pamctl.plant.model import PlantSettings  # noqa: E402

RIGS = ("own", "hidden")
SIZES = (1.0, 10.0)
OFF = {
    "damping_n_s_per_m": 0.06,
    "stiffness_n_per_m": 0.05,
    "kinetic_friction_per_m": 0.08,
    "valve_gain_m2_per_v": 0.07,
    "tank_pressure_pa": 0.015,
    "braid_length_m": 0.003,
}
"""Largest deviation of a rig's numbers from the paper's."""
HIDDEN_NUMBERS: dict[str, Callable[[HiddenRig], float]] = {
    "damping_n_s_per_m": lambda rig: rig.truth.damping,
    "stiffness_n_per_m": lambda rig: rig.truth.stiffness,
    "kinetic_friction_per_m": lambda rig: rig.truth.mu_k,
    "valve_gain_m2_per_v": lambda rig: rig.truth.valve_m2_per_v,
    "tank_pressure_pa": lambda rig: rig.truth.supply_pa,
    "braid_length_m": lambda rig: rig.truth.braid_m,
}


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
    rig = rig_of(case)
    train, held = records_of(case)
    true = {name: number(rig) for name, number in HIDDEN_NUMBERS.items()}
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
    forms = [c for c in _list_candidates() if c.name == effect]
    form = forms[int(random.integers(len(forms)))]
    size = _size(random)
    values = dict(form.held)
    for number in form.switches:
        neutral, step = NEUTRAL[number.name], size * random.uniform(0.85, 1.15) * number.scale
        fits = neutral + step < number.high
        values[number.name] = neutral + step if fits else neutral - step
    for number in form.shapes:
        usual = values.get(number.name) or NEUTRAL[number.name]
        values[number.name] = float(
            np.clip(usual * random.uniform(0.7, 1.4), number.low, number.high)
        )
    return values


def _list_candidates() -> tuple[Candidate, ...]:
    return list_candidates(Evidence(PlantSettings(), {PRESSURE: (), MECHANICS: ()}, {}, {}))


def fit_structure(runs: Runs, effect: str) -> Model:
    """Fit the true structure, as the diagnosis does after it has found it."""
    train, held = runs
    evidence = prepare_evidence(train, held, PlantSettings())
    forms = [c for c in list_candidates(evidence) if c.name == effect]
    air = _best(evidence.select_blocks({PRESSURE}), select_reaching(forms, {PRESSURE}))
    evidence = with_modelled_pressure(
        evidence, train, held, air.fit_of(PRESSURE).settings, trusted=air.is_complete
    )
    return _best(evidence.weigh_by_floors(recalibrate(evidence).floors), forms)


def _best(evidence: Evidence, forms: Sequence[Candidate]) -> Model:
    """Fit the most promising form first; try more forms only if that fit is not good enough."""
    base = confirm_complete(recalibrate(evidence))
    ranked = [
        score
        for block in evidence.blocks
        for score in score_candidates(base.fit_of(block), select_reaching(forms, {block}), block)
        if score.start
    ]
    best = base
    for score in sorted(ranked, key=lambda s: -s.explained):
        for starts in ([score.start], [*list_other_starts(base, score)]):
            model = confirm_complete(
                fit_to_end_if_near(fit_model(base, (score.candidate,), starts))
            )
            best = model if best is base else min(best, model, key=rank)
            if best.is_complete:
                return best
    return best


def examine_task(task: Task) -> dict[str, Any]:
    """Return the intervals of one rig with the true values."""
    runs, true = {"own": run_own_rig, "hidden": run_hidden_rig}[task.rig](task)
    began = time.process_time()
    model = fit_structure(runs, task.effect)
    found = estimate_intervals(model)
    return {
        "key": task.key,
        "rig": task.rig,
        "effect": task.effect,
        "at_floor": model.is_complete,
        "ratios": {block: model.ratio(block) for block in model.evidence.blocks},
        "seconds": time.process_time() - began,
        "numbers": [
            {"name": n.name, "true": true[n.name], "value": n.value, "ci90": [n.low, n.high]}
            for n in found
            if n.name in true
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
        lines.append(compute_coverage("fits that end above the floor", above))
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
