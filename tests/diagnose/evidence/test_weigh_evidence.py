"""From the records of a hidden rig to what is said of it, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from hidden.excitations import PROGRAMS
from hidden.rig import Record, hidden_rig

from pamctl.diagnose.evidence import intervals, weigh_evidence
from pamctl.diagnose.evidence.intervals import find_intervals
from pamctl.diagnose.evidence.ladder import judge_names
from pamctl.diagnose.evidence.name_search import NameSearch, list_at_range
from pamctl.diagnose.evidence.pool import PAPER_SCALES, list_effects
from pamctl.diagnose.evidence.weigh import list_pool, prepare_weigher
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.model import PlantSettings

PAPER = PlantSettings()


def records_of(effects: dict[str, float], seed: int) -> tuple[list[Record], list[Record]]:
    rig = hidden_rig(effects, seed=seed)
    train, held_out = PROGRAMS["brief"](seed)
    return [rig.run(e).record for e in train], [rig.run(e).record for e in held_out]


def test_every_effect_of_a_muscle_that_data_can_show_is_in_the_pool():
    families = {h.family for h in list_effects("muscle", PAPER_SCALES)}
    assert families == {
        name
        for name, effect in CATALOGUE.items()
        if "muscle" in effect.actuators and not effect.unidentifiable
    }


def test_records_without_an_input_are_refused():
    train, _ = records_of({}, 40713)
    with pytest.raises(ValueError, match="needs valve_v"):
        weigh_evidence([replace(r, valve_v=None, pressure_pa=None) for r in train])


def test_no_law_counts_where_the_name_that_explains_as_much_is_too_small():
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


def test_what_explains_nothing_promises_nothing_and_hardly_a_loss_beside_a_large_gap():
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


def test_a_turned_column_is_seen_beside_two_gaps_that_hide_it_from_the_first_look():
    effects = {"presliding": 2, "creep": 2}
    turned = [
        replace(r, position_m=-np.asarray(r.position_m)) for r in records_of(effects, 40717)[0]
    ]
    weigher, start = prepare_weigher(turned, [], PAPER)
    pool = {h.name: h for h in list_pool(weigher.train, weigher.base, PAPER)}
    base = weigher.settle(start)
    found = NameSearch(weigher, pool).turn_columns(base)
    assert found.names == ("position_turned",)
    left = weigher.like.mean_squares(found.d) / weigher.like.mean_squares(base.d)
    assert left[0] < 0.01


def test_a_rival_that_is_ahead_takes_the_place_of_what_was_found():
    weigher, start = prepare_weigher(records_of({"coulomb_friction": 5}, 40720)[0], [], PAPER)
    asked = "coulomb_friction", "spring_hysteresis", "creep"
    listed = list_pool(weigher.train, weigher.base, PAPER)
    search = NameSearch(weigher, {h.name: h for h in listed if h.name in asked})
    base = weigher.settle(start)
    weigher.set_floor(base)
    weigher.leave_out(base)
    search.best_scores = dict.fromkeys(asked, 1.0)
    (wrong,) = search.refit(base, search.score(base, ["spring_hysteresis"]), 1)
    m, findings, _ = judge_names(search, base, weigher.settle(wrong))
    assert m.names == ("coulomb_friction",)
    assert [(f.name, f.level) for f in findings] == [("coulomb_friction", "name")]


def test_a_size_that_the_plant_file_states_stays_within_the_limits_of_plant_files():
    plant = PlantSettings.model_validate(
        {"effects": {"return_friction": {"share": 0.9}, "coulomb_friction": {"force_n": 4.0}}}
    )
    _, start = prepare_weigher(records_of({}, 40721)[0], [], plant)
    ranges = {n.name: (n.low, n.high) for n in start.numbers}
    assert ranges["return_friction.share"] == (0.0, 2.0)
    assert ranges["coulomb_friction.force_n"] == (0.0, 200.0)


def test_intervals_are_wider_where_much_is_left_and_not_where_noise_is_left(monkeypatch):
    for effects, is_wider in ({"coulomb_friction": 5}, True), ({}, False):
        weigher, start = prepare_weigher(records_of(effects, 40715)[0], [], PAPER)
        base = weigher.settle(start)
        found = find_intervals(weigher, base)
        with monkeypatch.context() as independent:  # each stretch counts as one
            independent.setattr(intervals, "find_law_share", lambda *_: 0.0)
            narrow = find_intervals(weigher, base)
        low, high = found["stiffness_n_per_m"]
        ratio = (high - low) / (narrow["stiffness_n_per_m"][1] - narrow["stiffness_n_per_m"][0])
        assert ratio > 1.5 if is_wider else 1.0 <= ratio < 1.4  # a part of the noise is slow


def test_what_stands_at_its_range_is_asked_what_it_becomes_from_where_the_model_stands():
    """A hysteresis without a way is dry friction. Without either, spring and damping go astray."""
    weigher, start = prepare_weigher(records_of({"coulomb_friction": 20}, 40720)[0], [], PAPER)
    asked = "coulomb_friction", "spring_hysteresis"
    pool = {h.name: h for h in list_pool(weigher.train, weigher.base, PAPER) if h.name in asked}
    search, base = NameSearch(weigher, pool), weigher.settle(start)
    weigher.set_floor(base)
    weigher.leave_out(base)
    held = weigher.settle(search.refit(base, search.score(base, ["spring_hysteresis"]), 1)[0])
    assert list_at_range(held, "spring_hysteresis") == ("spring_hysteresis.way_m",)
    (friction,) = search.fit_in_place(held, "spring_hysteresis", ["coulomb_friction"])
    weigher.meet(held, friction)
    assert friction.names == ("coulomb_friction",)
    assert friction.total < held.total
    sizes = held.values["spring_hysteresis.force_n"], friction.values["coulomb_friction.force_n"]
    assert sizes[1] == pytest.approx(sizes[0], rel=0.1)


def test_the_knots_of_a_curve_are_those_beside_the_number_that_does_as_well() -> None:
    """A friction twice as large is mu_k, or a level of the curve: together they are known."""
    rig = {"position_dependent_friction": 10}
    weigher, start = prepare_weigher(records_of(rig, 40723)[0], [], PAPER)
    base = weigher.settle(start)
    (law,) = ("braid_friction~curve(position)",)
    search = NameSearch(weigher, {h.name: h for h in list_pool(weigher.train, weigher.base, PAPER)})
    bent = weigher.settle(search.refit(base, search.score(base, [law]), 1)[0])
    found = find_intervals(weigher, bent)
    wide = {
        name: (high - low) * bent.picked[law].held["braid_friction_term.size"]
        for name, (low, high) in found.items()
        if ".knot_" in name
    }
    low, high = found["kinetic_friction_per_m"]
    assert (high - low) / bent.values["kinetic_friction_per_m"] > 0.5, "alone it is not known"
    assert sorted(wide.values())[2] < 0.2, "beside it the curve is"


@pytest.mark.parametrize(("effects", "again"), [({"coulomb_friction": 10}, ["stribeck"]), ({}, [])])
def test_what_gained_when_it_was_fitted_is_fitted_again_only_where_much_is_left(
    effects: dict[str, int], again: list[str]
) -> None:
    weigher, start = prepare_weigher(records_of(effects, 40715)[0], [], PAPER)
    base = weigher.settle(start)
    search = NameSearch(weigher, {h.name: h for h in list_pool(weigher.train, weigher.base, PAPER)})
    search.best_fits = {"stribeck": 500.0, "creep": 20.0}
    scored = search.score(base, ["stribeck", "return_friction"])
    hopeful = [s for s in scored if s.name == "return_friction"]
    assert [s.name for s in search._list_again(base, scored, hopeful)] == again


def test_what_halves_what_is_much_counts_and_is_begun_anew_from_the_plant_files_numbers() -> None:
    weigher, start = prepare_weigher(*records_of({"chamber_leak": 20}, 40724), PAPER)
    pool = {h.name: h for h in list_pool(weigher.train, weigher.base, PAPER)}
    search, base = NameSearch(weigher, pool), weigher.settle(start)
    weigher.set_floor(base)
    weigher.leave_out(base)
    assert weigher.is_much_left(base)
    ((gain, begun),) = search._begin_all(base, lambda h: h.name == "chamber_leak")
    assert gain > 0.0
    leak = weigher.settle(begun)
    weigher.meet(base, leak)
    assert weigher.is_by_far_better(base, leak)
    assert not weigher.is_by_far_better(leak, base)
    assert not weigher.is_by_far_better(leak, leak)
    weigher.set_floor(leak)
    assert not search._begin_all(leak, lambda h: h.is_effect), "only noise is left"
