"""Gains for a law on a plant, or on an ensemble of plants, by search in simulation.

    plant_ensemble   which plants
    gains_trial      how well one set of gains does on one plant, against Table IV
    search_space     which gains a law has, and their bounds
    gains_search     the search itself: repeatable, resumable, parallel
    gains_file       the result, with how it was made

Read `gains_search.py` first.

Everything runs on the compiled closed loop: the tick of the loop process.
"""

from pamctl.tune.gains_search import BestGains, GainsSearch, Jury, SearchError
from pamctl.tune.gains_trial import GainsTrial, GainsVerdict
from pamctl.tune.plant_ensemble import Member, draw_ensemble, make_fixed_members

__all__ = [
    "BestGains",
    "GainsSearch",
    "GainsTrial",
    "GainsVerdict",
    "Jury",
    "Member",
    "SearchError",
    "draw_ensemble",
    "make_fixed_members",
]
