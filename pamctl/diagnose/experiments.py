"""Which experiment tells two effects apart, and which shows one best.

An advice names a file of config/experiment, which `pamctl run --experiment NAME` runs.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import permutations

from pamctl.plant.catalogue import CATALOGUE


def write_command(experiment: str) -> str:
    """Write the command that runs an experiment; "none" where there is none."""
    return f"pamctl run --experiment {experiment}" if experiment else "none"


def find_separating_experiment(names: Iterable[str]) -> dict[str, object]:
    """Return the experiment that tells these effects apart, and why."""
    wanted = sorted(names)
    for one, other in permutations(wanted, 2):
        if told := CATALOGUE[one].told_from.get(other):
            return {"name": told.experiment, "separates": sorted((one, other)), "why": told.why}
    first = next((e for n in wanted if (e := CATALOGUE[n]).best_experiment), CATALOGUE[wanted[0]])
    return {
        "name": first.best_experiment,
        "separates": wanted,
        "why": f"it shows {first.name} best: {first.signature}",
    }


def find_showing_experiment(name: str) -> dict[str, object]:
    """Return the experiment that shows an effect best."""
    effect = CATALOGUE[name]
    why = f"these records cannot show {name}: {effect.signature}"
    return {"name": effect.best_experiment, "separates": [name], "why": why}
