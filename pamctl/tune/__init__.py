"""Gains for a law on a plant, or on an ensemble of plants, by search in simulation.

    gains_trial   which plants, and how well gains do on each, against Table IV
    gains_search  which gains a law has, and the search: repeatable, parallel
    tune_gains    the task, search or score in worker processes, and the gains file

Everything runs on the compiled closed loop, with the same tick as the loop process.
Read `tune_gains.py` first.
"""

from pamctl.tune.gains_search import BestGains, GainsSearch, Jury
from pamctl.tune.gains_trial import (
    GainsTrial,
    GainsVerdict,
    Member,
    draw_ensemble,
)

__all__ = [
    "BestGains",
    "GainsSearch",
    "GainsTrial",
    "GainsVerdict",
    "Jury",
    "Member",
    "draw_ensemble",
]
