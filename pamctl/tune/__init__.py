"""Gains for a law on a plant, or on an ensemble of plants, by search in simulation.

    tuning_task     the law, the plants to tune for, the plants that score
    plant_ensemble  which plants
    gains_trial     how well one set of gains does on one plant, against Table IV
    search_space    which gains a law has, and their bounds in the search
    gains_search    the search itself: repeatable, parallel
    tune_gains      search or score in worker processes
    gains_file      the result, with how it was made; tune_text: the same for people

Everything runs on the compiled closed loop, with the same tick as the loop process.
Read `tune_gains.py` first.
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
