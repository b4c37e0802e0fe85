"""Gains for a law on a plant, or on an ensemble of plants, by search in simulation.

    ensemble   which plants
    trial      how well one set of gains does on one plant, against Table IV
    space      which gains a law has, and between which bounds they are sought
    search     the search itself: repeatable, resumable, parallel
    gains_file the result, with how it was made

Everything runs on the compiled closed loop: the very tick of the loop process.
"""

from pamctl.tune.gains_search import Found, Jury, Search, SearchError
from pamctl.tune.gains_trial import Trial, Verdict
from pamctl.tune.plant_ensemble import Member, ensemble, fixed_members

__all__ = [
    "Found",
    "Jury",
    "Member",
    "Search",
    "SearchError",
    "Trial",
    "Verdict",
    "ensemble",
    "fixed_members",
]
