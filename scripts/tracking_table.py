"""The README's table of tracking errors: every shipped gains file on four plants.

    python scripts/tracking_table.py [--json]

Runs the compiled closed loop: the loop's own tick on the plant of the simulated rig.
"""

from __future__ import annotations

import argparse
import json
import math
from typing import Any

from pamctl.cli.batch import tracked
from pamctl.merit import TABLE_IV, Merit
from pamctl.settings import names, resolve

PLANTS = {
    "paper": ("paper", 0),
    "+1 tick": ("paper", 1),
    "109 Hz": ("paper-valve109", 0),
    "109 Hz +1 tick": ("paper-valve109", 1),
}
"""Plant file and output delay in ticks."""


def figures(controller: str, experiment: str, plant: str, delay_ticks: int) -> Merit | None:
    """Simulate one cell of the table; None where safety ended it."""
    delay = f"rig.sim.output_delay_ticks={delay_ticks}"
    return tracked(
        resolve(controller=controller, experiment=experiment, plant=plant, overrides=[delay])
    )


def cell(found: Merit | None) -> str:
    """Max / RMS / steady in um."""
    if found is None:
        return "trips"
    return " / ".join(f"{m * 1e6:.1f}" for m in found if not math.isnan(m))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--json", action="store_true")
    as_json = parser.parse_args().json
    document: dict[str, Any] = {}
    for number, experiment in ((1, "tracking-1"), (2, "tracking-2")):
        print_header = [f"experiment {number}: max / RMS / steady", *PLANTS]
        rows = []
        for controller in names("controller"):
            found = {p: figures(controller, experiment, *PLANTS[p]) for p in PLANTS}
            document.setdefault(experiment, {})[controller] = {
                p: m and m._asdict() for p, m in found.items()
            }
            rows.append([f"`{controller}`", *(cell(m) for m in found.values())])
        rows += [
            [f"paper's {row.law.upper()} on its rig, Table IV", cell(row.merit), "", "", ""]
            for row in TABLE_IV
            if row.experiment == experiment
        ]
        if not as_json:
            for line in (print_header, ["---"] * 5, *rows):
                print("| " + " | ".join(line) + " |")
            print()
    if as_json:
        print(json.dumps(document, indent=1))


if __name__ == "__main__":
    main()
