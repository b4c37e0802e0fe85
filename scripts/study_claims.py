"""The paper's claims as a study: tracking, sensors, cost, parameters, sensitivity, and q.

    python scripts/study_claims.py              # shows the tables
    python scripts/study_claims.py --write      # and writes them into README or manual
    python scripts/study_claims.py --json
    python scripts/study_claims.py --quick      # few plants and rounds: does it run?

Everything but the cost is simulated by the compiled closed loop with the shipped gains.
"""

from __future__ import annotations

import argparse
import bisect
import json
import math
import multiprocessing
import os
import statistics
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from measured_table import format_table, write_measured
from simulation_speed import LAWS, ClosedLoop, time_steps

from pamctl.control.smc import linearise_model
from pamctl.plant.model import plant_parameters
from pamctl.settings.resolve import RunSettings, resolve
from pamctl.simulate.closed_loop import simulate_run
from pamctl.simulate.merit import TABLE_IV, Merit
from pamctl.tune import Member, draw_ensemble, make_fixed_members
from pamctl.tune.gains_trial import GainsTrial

EXPERIMENTS = ("tracking-1", "tracking-2")
SENSORS = {
    "noise and 3.175 µm a count": [],
    "no noise, 3.175 µm a count": ["rig.sim.sensor_noise_v=0"],
    "no noise, 1 nm a count": [
        "rig.sim.sensor_noise_v=0",
        "rig.calibration.encoder_m_per_count=1e-9",
    ],
}
FOR_SENSORS = 8
"""Number of plants that are also simulated without noise and with finer counts."""
DEAD_BANDS_V = (0.1, 0.2, 0.3)
"""Upper ends of the classes of dead band, each side."""
SEED = 2_000_003
"""Seed of plants that no search has used."""
SWEPT_Q = (1.0, 1.5, 1.75, 2.0, 2.5)
BOUND = {
    experiment: Merit(
        *(np.nanmin(column) for column in zip(*rows, strict=True))
        if experiment == "tracking-1"
        else (min(r.max_m for r in rows), min(r.rms_m for r in rows), math.nan)
    )
    for experiment in EXPERIMENTS
    if (rows := [row.merit for row in TABLE_IV if row.experiment == experiment])
}
"""The strictest column of Table IV."""


class Spread(NamedTuple):
    """How a law tracked on an ensemble; errors in µm, median over the plants."""

    plants: int
    inside: int
    median_rms_1_um: float
    median_steady_um: float
    median_rms_2_um: float


# --- tracking ------------------------------------------------------------------------


def run_of(law: str, experiment: str, sensors: Sequence[str], member: Member | None) -> RunSettings:
    """Return the settings of one run; no member means the paper's plant."""
    noise = [] if member is None else [f"rig.sim.sensor_noise_v={member.noise_v}"]
    settings = resolve(controller=law, experiment=experiment, overrides=[*noise, *sensors])
    if member is None:
        return settings
    return settings.model_copy(update={"plant": member.plant, "seed": member.seed})


def both(law: str, sensors: Sequence[str], member: Member | None) -> list[Merit | None]:
    runs = (run_of(law, experiment, sensors, member) for experiment in EXPERIMENTS)
    return [simulate_run(settings).merit() for settings in runs]


def is_inside(found: Sequence[Merit | None]) -> bool:
    """Tell whether every error of both experiments is within the strictest column of Table IV."""
    return all(
        one is not None
        and all(
            math.isnan(bound) or error <= bound
            for error, bound in zip(one, BOUND[experiment], strict=True)
        )
        for experiment, one in zip(EXPERIMENTS, found, strict=True)
    )


def spread(found: Sequence[Sequence[Merit | None]]) -> Spread:
    def median_um(values: Iterable[float]) -> float:
        return statistics.median(values) * 1e6

    def error(of: Merit | None, name: str) -> float:
        return math.inf if of is None else float(getattr(of, name))

    return Spread(
        len(found),
        sum(map(is_inside, found)),
        median_um(error(first, "rms_m") for first, _ in found),
        median_um(error(first, "steady_m") for first, _ in found),
        median_um(error(second, "rms_m") for _, second in found),
    )


def tracking(members: Sequence[Member], executor: Executor) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {}
    for law in LAWS:
        found[law] = {}
        for sensors, overrides in SENSORS.items():
            print(f"tracking: {law}, {sensors}", file=sys.stderr)
            asked = members[:FOR_SENSORS] if overrides else members
            each = list(executor.map(partial(both, law, overrides), asked, chunksize=4))
            found[law][sensors] = {"paper": both(law, overrides, None), "ensemble": spread(each)}
            if not overrides:
                found[law]["by dead band"] = by_dead_band(members, map(is_inside, each))
    return found


def by_dead_band(members: Sequence[Member], inside: Iterable[bool]) -> list[tuple[int, int]]:
    """Return the number of plants and of those inside, by the valve's dead band."""
    counts = [(0, 0)] * len(DEAD_BANDS_V)
    for member, is_in in zip(members, inside, strict=True):
        width_v = member.plant.effects.valve_deadband.fill_width_v
        at = bisect.bisect_left(DEAD_BANDS_V, width_v)
        counts[at] = (counts[at][0] + 1, counts[at][1] + is_in)
    return counts


# --- cost and parameters ---------------------------------------------------------------


def costs(rounds: int) -> dict[str, float]:
    """Cost of one step of each law over PID's, median of interleaved rounds; plain Python."""
    loops = {law: ClosedLoop(law) for law in LAWS}
    found = [time_steps(loops) for _ in range(rounds)]
    return {law: statistics.median(one[law] / one["pid"] for one in found) for law in LAWS}


def gains_of(law: str) -> list[str]:
    """Names of the gains that a law's file must give; lambda and q count as two."""
    fields = type(resolve(controller=law).controller).model_fields
    others = ("law", "length_unit", "reaching_law", "command_limit_v", "compensate", "model")
    return [name for name in fields if name not in others]


def model_numbers() -> int:
    """Numbers of the plant that change f-hat or g-hat, found by changing each."""
    parameters = type(resolve().plant.parameters).model_fields
    return sum(_linearised(**{name: 1.01}) != _linearised() for name in parameters)


def _linearised(**factors: float) -> Any:
    plant = resolve().plant
    changed = {name: getattr(plant.parameters, name) * f for name, f in factors.items()}
    parameters = plant.parameters.model_copy(update=changed)
    p = plant_parameters(plant.model_copy(update={"parameters": parameters})).paper
    # Moving both ways, filled above and below the critical pressure.
    states = [(x, v, 0.1, pa) for x in (8e-3, 15e-3) for v in (-5e-3, 5e-3) for pa in (2e5, 4e5)]
    return [linearise_model(p, *state) for state in states]


# --- sensitivity and q ------------------------------------------------------------------


def hard_plant() -> Member:
    """The paper's plant with the 109 Hz valve and a tick of delay."""
    (member,) = make_fixed_members([("109 Hz, 1 tick", resolve(plant="paper-valve109").plant)])
    return Member(member.name, member.plant, output_delay_ticks=1)


def sensitivity(law: str) -> dict[str, list[float]]:
    """Largest error over its bound with each gain halved, unchanged and doubled."""
    controller, member = resolve(controller=law).controller, hard_plant()
    return {
        name: [
            GainsTrial("whole").verdict(_changed(controller, name, factor), member).worst
            for factor in (0.5, 1.0, 2.0)
        ]
        for name in gains_of(law)
    }


def _changed(controller: Any, name: str, factor: float) -> Any:
    # 450 Hz is where a cut-off ends at this rate.
    highest = 450.0 if name.endswith("_hz") else math.inf
    return controller.model_copy(update={name: min(getattr(controller, name) * factor, highest)})


class AtQ(NamedTuple):
    """The shipped qSMC with another q."""

    q: float
    constant_lambda: float
    """Largest error over its bound with lambda as shipped."""
    constant_pole: float
    """The same with lambda^q as shipped."""
    apart_um: float
    """Largest difference of the motion from the shipped one, with lambda^q as shipped."""


def sweep_q(values: Sequence[float]) -> list[AtQ]:
    controller, member = resolve(controller="qsmc").controller, hard_plant()
    pole = controller.lambda_per_s**controller.q
    base = simulate_run(resolve(controller="qsmc"))["true_position_m"]
    rows = []
    for q in values:
        same_lambda = controller.model_copy(update={"q": q})
        lambda_per_s = pole ** (1.0 / q)
        same_pole = controller.model_copy(update={"q": q, "lambda_per_s": lambda_per_s})
        moved = simulate_run(
            resolve(controller="qsmc").model_copy(update={"controller": same_pole})
        )
        rows.append(
            AtQ(
                q,
                GainsTrial("whole").verdict(same_lambda, member).worst,
                GainsTrial("whole").verdict(same_pole, member).worst,
                float(np.abs(moved["true_position_m"] - base).max() * 1e6),
            )
        )
    return rows


# --- words -----------------------------------------------------------------------------


def study(plants: int, rounds: int, values: Sequence[float], jobs: int) -> dict[str, Any]:
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as executor:
        tracked_errors = tracking(draw_ensemble(plants, SEED), executor)
    return {
        "tracking": tracked_errors,
        "cost": costs(rounds),
        "gains": {law: len(gains_of(law)) for law in LAWS},
        "model_numbers": model_numbers(),
        "sensitivity": {law: sensitivity(law) for law in LAWS},
        "q": sweep_q(values),
    }


def format_cell(found: Sequence[Merit | None]) -> str:
    if None in found:
        return "trips"
    first, second = (one for one in found if one is not None)
    return f"{first.rms_m * 1e6:.1f} / {first.steady_m * 1e6:.1f} / {second.rms_m * 1e6:.1f}"


def format_tables(found: dict[str, Any]) -> str:
    """All tables as Markdown."""
    shares, rows = [], []
    for law, of_law in found["tracking"].items():
        counts = of_law["by dead band"]
        plants, inside = map(sum, zip(*counts, strict=True))
        cells = [f"{inside} of {plants} ({100 * inside / plants:.1f} %)"]
        cells += [f"{inside} of {plants}" for plants, inside in counts]
        shares.append([f"`{law}`", *cells])
        for sensors in SENSORS:
            e = of_law[sensors]["ensemble"]
            median = f"{e.median_rms_1_um:.1f} / {e.median_steady_um:.1f} / {e.median_rms_2_um:.1f}"
            share = f"{e.inside} of {e.plants}"
            rows.append([f"`{law}`", sensors, format_cell(of_law[sensors]["paper"]), median, share])
    edges = [0.0, *DEAD_BANDS_V]
    inside_table = format_table(
        [
            "fresh plants inside Table IV",
            "all",
            *(f"dead band a side {low:g} to {high:g} V" for low, high in pairwise(edges)),
        ],
        shares,
    )
    tracked_table = format_table(
        [
            "RMS 1 / steady / RMS 2, µm",
            "sensors",
            "paper's plant",
            "ensemble's median",
            "inside Table IV",
        ],
        rows,
    )
    counts = {
        law: f"{count} and {found['model_numbers']} of the muscle" if law == "smc" else str(count)
        for law, count in found["gains"].items()
    }
    cost_table = format_table(
        ["", *(f"`{law}`" for law in LAWS)],
        [
            ["one step of the law, times PID's", *(f"{found['cost'][law]:.2f}" for law in LAWS)],
            ["numbers to choose", *(counts[law] for law in LAWS)],
        ],
    )
    sensitive = format_table(
        ["gain", "law", "x 0.5", "as shipped", "x 2"],
        [
            [f"`{name}`", f"`{law}`", *(f"{ratio:.2f}" for ratio in ratios)]
            for law, by_name in found["sensitivity"].items()
            for name, ratios in by_name.items()
        ],
    )
    swept = format_table(
        ["q", "lambda as shipped", "lambda^q as shipped", "motion apart, µm"],
        [
            [
                f"{one.q:g}",
                f"{one.constant_lambda:.2f}",
                f"{one.constant_pole:.2f}",
                f"{one.apart_um:.2g}",
            ]
            for one in found["q"]
        ],
    )
    note = (
        "Largest error over its bound in Table IV (1 is on it; tens are an oscillation or a "
        "safety trip), 109 Hz valve and a tick of delay:"
    )
    return "\n\n".join([inside_table, tracked_table, cost_table, note, sensitive, swept])


def plain(value: Any) -> Any:
    """Return named tuples as dictionaries, for JSON."""
    if hasattr(value, "_asdict"):
        return plain(value._asdict())
    if isinstance(value, dict):
        return {key: plain(one) for key, one in value.items()}
    return [plain(one) for one in value] if isinstance(value, list) else value


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--json", action="store_true")
    parser.add_argument(
        "--write", "--readme", action="store_true", help="write the table into README or manual"
    )
    parser.add_argument("--quick", action="store_true", help="2 plants, 2 rounds: does it run?")
    parser.add_argument("--plants", type=int, default=200, help="of the ensemble")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes")
    options = parser.parse_args()
    how = (2, 2, SWEPT_Q[:2]) if options.quick else (options.plants, 15, SWEPT_Q)
    found = study(*how, options.jobs)
    print(json.dumps(plain(found), indent=1) if options.json else format_tables(found))
    if options.write:
        write_measured("study_claims", format_tables(found))


if __name__ == "__main__":
    main()
