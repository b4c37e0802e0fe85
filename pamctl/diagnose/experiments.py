"""Find the experiment that separates two effects, or that shows one best.

The advice names a file of config/experiment, which `pamctl run --experiment NAME` runs.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from itertools import permutations

from pamctl.plant.catalogue import CATALOGUE


def write_command(experiment: str) -> str:
    """Write the command that runs an experiment; "none" where there is none."""
    return f"pamctl run --experiment {experiment}" if experiment else "none"


def find_separating_experiment(
    names: Iterable[str], without: Collection[str] = ()
) -> dict[str, object]:
    """Return the experiment that tells these effects apart, and why.

    Experiments in `without` were run already; the name is empty where no other one serves.
    """
    wanted = sorted(names)
    for one, other in permutations(wanted, 2):
        told = CATALOGUE[one].told_from.get(other)
        if told and told.experiment not in without:
            return {"name": told.experiment, "separates": sorted((one, other)), "why": told.why}
    for effect in map(CATALOGUE.__getitem__, wanted):
        if effect.best_experiment and effect.best_experiment not in without:
            why = f"it shows {effect.name} best: {effect.signature}"
            return {"name": effect.best_experiment, "separates": wanted, "why": why}
    return {"name": "", "separates": wanted, "why": "no shipped experiment separates them"}


def find_showing_experiment(name: str) -> dict[str, object]:
    """Return the experiment that shows an effect best."""
    effect = CATALOGUE[name]
    why = f"these records cannot show {name}: {effect.signature}"
    return {"name": effect.best_experiment, "separates": [name], "why": why}
