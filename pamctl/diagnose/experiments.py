"""Find the experiment that separates two effects, or that shows one best.

The advice names a file of config/experiment, which `pamctl run --experiment NAME` runs.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import permutations

from pamctl.plant.catalogue import CATALOGUE


def write_command(experiment: str) -> str:
    """Write the command that runs an experiment; "none" where there is none."""
    return f"pamctl run --experiment {experiment}" if experiment else "none"


def find_separating_experiment(names: Iterable[str]) -> dict[str, object]:
    """Return the experiment that separates these effects, and why."""
    effects = sorted(names)
    for one, other in permutations(effects, 2):
        if how := CATALOGUE[one].told_from.get(other):
            return {"name": how.experiment, "separates": sorted((one, other)), "why": how.why}
    first = next((e for n in effects if (e := CATALOGUE[n]).best_experiment), CATALOGUE[effects[0]])
    return {
        "name": first.best_experiment,
        "separates": effects,
        "why": f"it shows {first.name} best: {first.signature}",
    }


def find_showing_experiment(name: str) -> dict[str, object]:
    """Return the experiment that shows an effect best."""
    effect = CATALOGUE[name]
    why = f"these records cannot show {name}: {effect.signature}"
    return {"name": effect.best_experiment, "separates": [name], "why": why}
