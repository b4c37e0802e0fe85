"""Rivals of a named effect: a better one replaces it, an equal one makes it ambiguous."""

from __future__ import annotations

import numpy as np
import pytest
from support.made_records import find_candidate, pair

from pamctl.diagnose.fitting.drives import PRESSURE
from pamctl.diagnose.fitting.evidence import prepare_evidence
from pamctl.diagnose.fitting.model_fit import recalibrate
from pamctl.diagnose.naming import rivals
from pamctl.diagnose.naming.search import search_effects
from pamctl.plant.model import PlantSettings

PAPER = PlantSettings()


def test_a_rival_with_a_smaller_remainder_replaces_the_named_effect() -> None:
    train, held = pair(valve_spool__time_constant_s=5e-4)
    evidence = prepare_evidence(train, held, PAPER).select_blocks({PRESSURE})
    late, slow = find_candidate("command_delay", evidence), find_candidate("valve_spool", evidence)
    search = search_effects(recalibrate(evidence), [late])
    assert search.best.names == ("command_delay",)
    (standing,) = rivals.find_rivals(search.best, search, [late, slow])
    assert search.add_models(standing.rival_models).best.names == ("valve_spool",)


def test_a_rival_above_the_limit_does_not_equal_an_effect_below_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(rivals, "MUCH", np.inf)  # the bootstrap calls every rival equal
    train, held = pair(valve_spool__time_constant_s=5e-4)
    evidence = prepare_evidence(train, held, PAPER).select_blocks({PRESSURE})
    late, slow = find_candidate("command_delay", evidence), find_candidate("valve_spool", evidence)
    search = search_effects(recalibrate(evidence), [slow])
    (standing,) = rivals.find_rivals(search.best, search, [late, slow])
    (rival,) = standing.rivals
    assert rival.residual_over_floor > search.best.floors[PRESSURE].limit
    assert standing.equal_rivals == ()


def test_a_rival_of_which_the_data_take_nothing_does_not_equal_the_truth(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(rivals, "MUCH", np.inf)  # the bootstrap calls every rival equal,
    monkeypatch.setattr(rivals, "OFTEN", -1.0)  # and no limit refutes one
    train, held = pair(valve_spool__time_constant_s=5e-4)
    evidence = prepare_evidence(train, held, PAPER).select_blocks({PRESSURE})
    late, slow = find_candidate("command_delay", evidence), find_candidate("valve_spool", evidence)
    search = search_effects(recalibrate(evidence), [slow])
    (standing,) = rivals.find_rivals(search.best, search, [late, slow])
    assert standing.equal_rivals == ()
    monkeypatch.setattr(rivals, "is_first_alone", lambda mixtures: False)
    (standing,) = rivals.find_rivals(search.best, search, [late, slow])
    assert standing.equal_rivals == ("command_delay",)
