"""From the records of a hidden rig to what is said of it, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden.excitations import PROGRAMS
from hidden.rig import Record, hidden_rig

from pamctl.diagnose.evidence import fit, weigh_evidence
from pamctl.diagnose.evidence.name_search import NameSearch
from pamctl.diagnose.evidence.pool import PAPER_SCALES, list_effects
from pamctl.diagnose.evidence.weigh import list_pool, prepare_weigher
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.model import PlantSettings

PAPER = PlantSettings()


def records_of(effects: dict[str, float], seed: int) -> tuple[list[Record], list[Record]]:
    rig = hidden_rig(effects, seed=seed)
    train, held_out = PROGRAMS["brief"](seed)
    return [rig.run(e).record for e in train], [rig.run(e).record for e in held_out]


def test_every_effect_of_a_muscle_that_data_can_show_is_in_the_pool() -> None:
    families = {h.family for h in list_effects("muscle", PAPER_SCALES)}
    assert families == {
        name
        for name, effect in CATALOGUE.items()
        if "muscle" in effect.actuators and not effect.unidentifiable
    }


def test_records_without_an_input_are_refused() -> None:
    train, _ = records_of({}, 40713)
    with pytest.raises(ValueError, match="needs valve_v"):
        weigh_evidence([replace(r, valve_v=None, pressure_pa=None) for r in train])


def test_no_law_counts_where_the_name_that_explains_as_much_is_too_small() -> None:
    train, held_out = records_of({"coulomb_friction": 5}, 40714)
    weigher, start = prepare_weigher(train, held_out, PAPER)
    pool = {h.name: h for h in list_pool(weigher.train, weigher.base, PAPER)}
    search, base = NameSearch(weigher, pool), weigher.settle(start)
    weigher.set_floor(base)
    weigher.leave_out(base)
    asked = ["coulomb_friction", "force~hysteresis(position)"]
    fits = {f.names[-1]: f for f in search.refit(base, search.score(base, asked), 2)}
    name, law = (fits[n] for n in asked)
    assert search.take(base, [name, law]) is name
    assert search.take(base, [law]) is law
    at = [n.name for n in name.numbers].index("coulomb_friction.force_n")
    name.x[at] = 0.1 * name.numbers[at].smallest
    assert search.take(base, [name, law]) is None


def test_what_explains_nothing_promises_nothing_and_hardly_a_loss_beside_a_large_gap() -> None:
    weigher, start = prepare_weigher(records_of({"valve_deadband": 10}, 40716)[0], [], PAPER)
    pool = {h.name: h for h in list_pool(weigher.train, weigher.base, PAPER)}
    search, base = NameSearch(weigher, pool), weigher.settle(start)
    weigher.set_floor(base)
    weigher.leave_out(base)
    asked = ["valve_deadband", "supply_droop", "chamber_leak", "valve_saturation"]
    best, *others = search.score(base, asked)
    assert (best.name, best.shows) == ("valve_deadband", True)
    for score in others:
        assert -0.05 * best.gain < score.gain < 0.01 * best.gain
        assert not score.shows


def test_intervals_are_wider_where_much_is_left_and_not_where_noise_is_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for effects, is_wider in ({"coulomb_friction": 5}, True), ({}, False):
        weigher, start = prepare_weigher(records_of(effects, 40715)[0], [], PAPER)
        base = weigher.settle(start)
        found = weigher.find_intervals(base)
        with monkeypatch.context() as independent:  # each stretch counts as one
            independent.setattr(fit, "LEFT_TIMES", np.inf)
            narrow = weigher.find_intervals(base)
        low, high = found["stiffness_n_per_m"]
        ratio = (high - low) / (narrow["stiffness_n_per_m"][1] - narrow["stiffness_n_per_m"][0])
        assert ratio > 1.5 if is_wider else ratio == pytest.approx(1.0)
