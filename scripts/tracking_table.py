"""The measured tables of tracking errors: every shipped gains file on four plants.

    python scripts/tracking_table.py            # shows them
    python scripts/tracking_table.py --write    # and writes them into README or manual
    python scripts/tracking_table.py --json

Runs the compiled closed loop: the loop's own tick on the plant of the simulated rig.
"""

from __future__ import annotations

import argparse
import json
import math

from measured_table import format_table, write_measured

from pamctl.offline.closed_loop import simulate_run
from pamctl.offline.merit import TABLE_IV, Merit
from pamctl.settings.config_files import list_shipped
from pamctl.settings.resolve import resolve

PLANTS = {
    "paper": ("paper", 0),
    "+1 tick": ("paper", 1),
    "109 Hz": ("paper-valve109", 0),
    "109 Hz +1 tick": ("paper-valve109", 1),
}
"""Plant file and output delay in ticks."""
EXPERIMENTS = {"experiment 1": "tracking-1", "experiment 2": "tracking-2"}

Found = dict[str, dict[str, dict[str, Merit | None]]]


def simulate_cell(controller: str, experiment: str, plant: str, delay_ticks: int) -> Merit | None:
    """Simulate one cell of a table; None if safety ended the run."""
    delay = f"rig.sim.output_delay_ticks={delay_ticks}"
    settings = resolve(controller=controller, experiment=experiment, plant=plant, overrides=[delay])
    return simulate_run(settings).merit()


def simulate_all() -> Found:
    """Simulate every cell: by experiment, gains file and plant."""
    return {
        experiment: {
            controller: {p: simulate_cell(controller, experiment, *PLANTS[p]) for p in PLANTS}
            for controller in list_shipped("controller")
        }
        for experiment in EXPERIMENTS.values()
    }


def format_cell(found: Merit | None) -> str:
    """Max / RMS / steady in um."""
    if found is None:
        return "trips"
    return " / ".join(f"{m * 1e6:.1f}" for m in found if not math.isnan(m))


def format_tables(found: Found) -> str:
    """Both tables as Markdown."""
    return "\n\n".join(
        format_table(
            [f"{title}: max / RMS{' / steady' if title.endswith('1') else ''}", *PLANTS],
            [
                *(
                    [f"`{c}`", *map(format_cell, row.values())]
                    for c, row in found[experiment].items()
                ),
                *(
                    [
                        f"paper's {row.law.upper()} on its rig, Table IV",
                        format_cell(row.merit),
                        "",
                        "",
                        "",
                    ]
                    for row in TABLE_IV
                    if row.experiment == experiment
                ),
            ],
        )
        for title, experiment in EXPERIMENTS.items()
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--json", action="store_true")
    parser.add_argument(
        "--write", "--readme", action="store_true", help="write the table into README or manual"
    )
    options = parser.parse_args()
    found = simulate_all()
    if options.json:
        plain = {
            e: {c: {p: m and m._asdict() for p, m in row.items()} for c, row in rows.items()}
            for e, rows in found.items()
        }
        print(json.dumps(plain, indent=1))
    else:
        print(format_tables(found))
    if options.write:
        write_measured("tracking_table", format_tables(found))


if __name__ == "__main__":
    main()
