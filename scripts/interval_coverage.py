"""How often the 90 % intervals of a diagnosis hold the truth, by simulation.

    python scripts/interval_coverage.py [--effects NAME,...] [--seeds 4] [--program brief]
        [--workers 2] [--results FILE] [--json | --write]

An effect of random size (1 to 10 smallest sizes of interest), with random parameters, noise and
homing, is hidden in the rigs of tests/hidden, which share no code with the project and have other
equations. Only the true structure is fitted, without a search, so that a rig takes seconds. Rigs
stored in the JSONL file are not run again. The table goes to stdout (markdown or JSON), with
--write into README or manual; progress goes to stderr. The standard error counts rigs, not numbers,
because the numbers of one rig are not independent.
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
from hidden.hostile.lab import FITTED, TRUTH_NAMES  # noqa: E402
from measured_table import format_table, write_measured  # noqa: E402
from resumable_study import run_resumable  # noqa: E402

from pamctl.diagnose import Record  # noqa: E402
from pamctl.diagnose.evidence.fit import WeighedModel, Weigher  # noqa: E402
from pamctl.diagnose.evidence.intervals import find_intervals  # noqa: E402
from pamctl.diagnose.evidence.name_search import NameSearch  # noqa: E402
from pamctl.diagnose.evidence.weigh import list_pool, prepare_weigher  # noqa: E402
from pamctl.plant.model import PlantSettings  # noqa: E402
from pamctl.plant.parameters import NEUTRAL  # noqa: E402

SIZES = (1.0, 10.0)
EXPLAINED = 2.0
"""A model that leaves less than this multiple of each sensor's noise (RMS) explains a rig."""


@dataclass(frozen=True)
class Task:
    """One rig with one effect in it."""

    effect: str
    seed: int
    program: str

    @property
    def key(self) -> str:
        """Its key in the results."""
        return f"hidden/{self.effect}#{self.seed}@{self.program}"

    @property
    def random(self) -> np.random.Generator:
        """Its own random generator, the same each time."""
        return np.random.default_rng(zlib.crc32(self.key.encode()))


Runs = tuple[list[Record], list[Record]]


def run_hidden_rig(task: Task) -> tuple[Runs, dict[str, float]]:
    """Return a hidden rig's records, and those of its numbers that mean the same in both forms."""
    size = float(np.exp(task.random.uniform(*np.log(SIZES))))
    case = Case(
        task.key,
        "coverage",
        {task.effect: size},
        program=task.program,
        encoder_homed=task.effect != "external_load",
        repeat=task.seed,
    )
    rig, (train, held) = case.rig, case.records()
    true = {name: getattr(rig.truth, TRUTH_NAMES[name]) for name in FITTED}
    for name, number in TRUE.get(task.effect, {}).items():
        if not math.isclose(number(rig), HIDDEN_NEUTRAL.get(name, 0.0), abs_tol=1e-15):
            true[f"{task.effect}.{name}"] = number(rig)
    return ([_to_record(r) for r in train], [_to_record(r) for r in held]), true


def _to_record(record: Any) -> Record:
    return Record(name=record.name, **record.columns())


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
    runs, true = run_hidden_rig(task)
    began = time.process_time()
    weigher, m = fit_structure(runs, task.effect)
    left2 = weigher.like.mean_squares(m.d) / weigher.find_noise2(m)
    ratios = dict(zip(weigher.train.channels, map(float, np.sqrt(left2)), strict=True))
    return {
        "key": task.key,
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
    lines.append(compute_coverage("numbers of the effect", at_floor))
    lines.append(compute_coverage("recalibrated numbers", at_floor, of_effect=False))
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
        Task(effect, seed, options.program)
        for seed in range(options.seeds)
        for effect in options.effects.split(",")
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
