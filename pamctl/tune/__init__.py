"""Gains for a law on a plant, or on an ensemble of plants, by search in simulation.

    ensemble   which plants
    trial      how well one set of gains does on one plant, against Table IV
    space      which gains a law has, and between which bounds they are sought
    search     the search itself: repeatable, resumable, parallel
    gains_file the result, with how it was made

Everything runs on the compiled closed loop: the very tick of the loop process.
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
