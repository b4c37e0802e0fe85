"""Does a law track better on a rig with a hidden effect if it is tuned on the diagnosed plant?

    python scripts/retune_after_diagnosis.py [--effect NAME:SIZE ...] [--law qsmc]
        [--generations 10] [--searches 2] [--json]

The rigs are those of tests/hidden: they share no code with the plant, and run here under the loop's
own tick. Each is diagnosed from two runs of `diagnosis`. Then gains are searched near the shipped
ones, with equal effort on the nominal model and on the extended one, and tracked on the rig in
experiment 2. Markdown on stdout, or one JSON document; progress on stderr.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from hidden.own_run import own_run  # noqa: E402
from hidden.plant import HiddenPlant  # noqa: E402
from hidden.rig import HiddenRig, Record, hidden_rig  # noqa: E402
from support.runs import run  # noqa: E402

from pamctl.control.law_registry import installed_laws  # noqa: E402
from pamctl.diagnose import Diagnosis, diagnose, sentence  # noqa: E402
from pamctl.diagnose import Record as Measured  # noqa: E402
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document  # noqa: E402
from pamctl.exit_codes import ExitCode  # noqa: E402
from pamctl.plant.model import PlantSettings  # noqa: E402
from pamctl.settings.resolve import resolve  # noqa: E402
from pamctl.simulate.merit import compute_merit  # noqa: E402
from pamctl.tune import GainsSearch, Jury, make_fixed_members  # noqa: E402
from pamctl.tune.search_space import find_space  # noqa: E402

HIDDEN = ("valve_deadband:5", "valve_hysteresis:5", "command_delay:10", "valve_spool:5")
"""Effects that a loop can feel, at sizes from just relevant to the worst."""
SEED = 20
MODEL, DIAGNOSED = "the model as it stood", "the diagnosed plant"


@dataclass(frozen=True)
class Tracked:
    """How gains tracked on the hidden rig, and what the search promised on its own plant."""

    plant: str
    """The plant of the search; empty for shipped gains."""
    cost: float | None
    """Largest error over its bound of Table IV on that plant."""
    max_um: float | None
    """None if the run did not end well; `outcome` says how it ended."""
    rms_um: float | None
    outcome: str


@dataclass(frozen=True)
class Retuned:
    """One rig."""

    hidden: str
    verdict: str
    named: list[str]
    tracked: list[Tracked]


def retune(hidden: str, law: str, generations: int, searches: int) -> Retuned:
    """Diagnose one rig, tune on both plants, and track on the rig."""
    name, size = hidden.split(":")
    rig = hidden_rig({name: float(size)}, seed=SEED)
    found = diagnose_rig(rig)
    tell(f"{hidden}: {sentence(found)}")
    rows = [track_on(rig, "", resolve(controller=law).controller, None)]
    for label, plant in ((MODEL, PlantSettings()), (DIAGNOSED, found.plant)):
        for seed in range(searches):
            gains, cost = tune_law(law, plant, generations, seed)
            rows.append(track_on(rig, label, gains, cost))
    named = [effect["name"] for effect in build_diagnosis_document(found)["effects"]]
    return Retuned(hidden, found.verdict.value, named, rows)


def diagnose_rig(rig: HiddenRig) -> Diagnosis:
    """Diagnose a rig from two runs of the shipped experiment."""
    train, held_out = (to_record(own_run(rig, "diagnosis", seed)) for seed in (1, 2))
    return diagnose([train], [held_out], PlantSettings(), progress=tell)


def to_record(record: Record) -> Measured:
    return Measured(name=record.name, **record.columns())


def tune_law(law: str, plant: PlantSettings, generations: int, seed: int) -> tuple[Any, float]:
    """Search gains on a plant; return them and their cost there."""
    start = resolve(controller=law).controller.model_dump()
    jury = Jury((), 1.0, tuple(make_fixed_members([("plant", plant)])))
    search = GainsSearch(law, jury, seed, start=start)
    for _ in range(generations):
        best = search.advance()
    tell(f"  {generations} generations, seed {seed}: {best.cost:.3f} of Table IV")
    return find_space(law).controller(find_space(law).point(best.gains)), best.cost


def track_on(rig: HiddenRig, plant: str, controller: Any, cost: float | None) -> Tracked:
    """Run experiment 2 on the hidden rig; errors are of the measured displacement."""
    base = resolve(experiment="tracking-2", fast=True, seed=SEED)
    done = run(base.model_copy(update={"controller": controller}), plant=HiddenPlant(rig))
    ticks = done.journal.ticks
    t_s = np.array([r.timing.t_s for r in ticks])
    phase = np.array([r.reference.phase for r in ticks])
    error_m = np.array([r.measurement.position_m - r.reference.reference_m for r in ticks])
    whole = done.ending.code == ExitCode.OK
    found = compute_merit(t_s, phase, error_m) if whole else None
    worst_um, rms_um = (found.max_m * 1e6, found.rms_m * 1e6) if found else (None, None)
    outcome = "complete" if whole else done.ending.reason
    tracked = Tracked(plant, cost, worst_um, rms_um, outcome)
    tell(f"  gains of {plant or 'the package'}: {_format_tracked(tracked)} um")
    return tracked


def markdown(results: list[Retuned]) -> Iterator[str]:
    """One row a rig; every search of a plant in one cell."""
    yield "| hidden, size | diagnosis | as shipped | tuned on the model | tuned after diagnosis |"
    yield "| --- | --- | --- | --- | --- |"
    for result in results:
        named = f"{result.verdict}: {', '.join(f'`{n}`' for n in result.named) or '-'}"
        cells = [
            "; ".join(_format_tracked(row) for row in result.tracked if row.plant == plant)
            for plant in ("", MODEL, DIAGNOSED)
        ]
        yield f"| `{result.hidden.replace(':', '`, ')} | {named} | {' | '.join(cells)} |"


def _format_tracked(row: Tracked) -> str:
    if row.max_um is None:
        return row.outcome
    return f"{row.max_um:.0f} / {row.rms_um:.1f}"


def tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--effect", action="append", metavar="NAME:SIZE")
    parser.add_argument("--law", default="qsmc", choices=sorted(installed_laws()))
    parser.add_argument("--generations", type=int, default=10)
    parser.add_argument("--searches", type=int, default=2, help="with different seeds")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    results = [
        retune(hidden, options.law, options.generations, options.searches)
        for hidden in options.effect or HIDDEN
    ]
    if options.json:
        print(json.dumps([asdict(result) for result in results], indent=2))
    else:
        print("\n".join(markdown(results)))


if __name__ == "__main__":
    main()
