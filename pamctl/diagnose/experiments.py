"""Find the experiment that separates two effects, or that shows one best.

The advice names a file of config/experiment, which `pamctl run --experiment NAME` runs. For a rig
that pamctl does not run, it says in words what to record.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from itertools import permutations

from pamctl.plant.catalogue import CATALOGUE

_SQUARES = (
    "steps of the full command up and down, each held until the pressure rests",
    "steps of the driving force to and fro, each held until the axis rests",
)
MOTIONS: Mapping[str, tuple[str, str]] = {
    "chirp": (
        "a sine of the command whose frequency rises until the pressure hardly follows",
        "a sine of the driving force whose frequency rises until the position hardly follows",
    ),
    "diagnosis": (
        "one long record with steps of several sizes, slow ramps, holds and a sine of rising "
        "frequency of the command",
        "one long record with motions at several speeds both ways, reversals, holds and a sine of "
        "rising frequency, at several pressures where there is a pressure",
    ),
    "fill-and-hold": (
        "fill to several pressures, close the valve, and wait some 10 s each time",
        "hold the axis still at several loads or pressures, some 10 s each time",
    ),
    "long-holds": (
        "steps of the pressure, each held for a minute",
        "steps of the driving force, each held for a minute",
    ),
    "multisine-small": (
        "sines of several frequencies at once, with a small command around the valve's null",
        "sines of several frequencies at once, with a small driving force",
    ),
    "null-staircase": (
        "a staircase of small commands on both sides of the valve's null",
        "a staircase of small driving forces both ways, from rest",
    ),
    "slow-ramps": (
        "slow ramps of the pressure up and down, with reversals on the way",
        "slow motions to and fro at several speeds, with reversals on the way",
    ),
    "square-1": _SQUARES,
    "squares-apart": _SQUARES,
}
"""What to record instead of an experiment: behind a valve, and on a mechanism without one."""


def describe_motion(experiment: str, actuator: str) -> str:
    """Say what to record where pamctl does not run the rig; empty for no experiment."""
    if not experiment:
        return ""
    named = f"a run like the experiment {experiment}"
    behind_valve, on_axis = MOTIONS.get(experiment, (named, named))
    return on_axis if actuator == "direct" else behind_valve


def write_advice(experiment: str, actuator: str, *, runs_here: bool) -> str:
    """Write the command that runs an experiment, or what to record where pamctl does not run it."""
    if runs_here or not experiment:
        return write_command(experiment)
    return f"record: {describe_motion(experiment, actuator)}"


def write_command(experiment: str, *, by_daemon: bool = False) -> str:
    """Write the command that runs an experiment; "none" where there is none."""
    verb = "start" if by_daemon else "run --experiment"
    return f"pamctl {verb} {experiment}" if experiment else "none"


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
