"""Verdicts on made residuals: partial by gain, no cliff, rivals that are really worse."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
from support.made_records import find_candidate, pair

from pamctl.diagnose.confirm import find_spoilers
from pamctl.diagnose.fitting.block_fit import rms
from pamctl.diagnose.fitting.evidence import Evidence, prepare_evidence
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.floor import Floor
from pamctl.diagnose.naming import verdict as verdicts
from pamctl.diagnose.naming.rivals import is_refuted
from pamctl.diagnose.naming.search import EffectSearch, choose_beam
from pamctl.diagnose.naming.verdict import Judgement, Verdict, judge_search
from pamctl.plant.model import PlantSettings

LIMIT = 1.2
SAMPLES = 4000


@cache
def evidence() -> Evidence:
    return prepare_evidence(*pair(), PlantSettings())


def made(
    *names: str, base: Model | None = None, stretches: Sequence[float] = (), **left: float
) -> Model:
    """Make a model that leaves these RMS, by block; 1 is the floor.

    `stretches` are factors of the pressure's residual over equal parts of the record.
    """
    effects = tuple(find_candidate(name, evidence()) for name in names)
    model = Model(evidence(), effects, {}, root=base)
    noise = np.random.default_rng(len(names)).normal(size=SAMPLES)
    noise /= rms(noise)
    levels = {"pressure": 1.0, "mechanics": 1.0, **left}
    residuals = {block: level * noise for block, level in levels.items()}
    if stretches:
        residuals["pressure"] = noise * np.repeat(stretches, SAMPLES // len(stretches))
    floor = Floor(1.0, 0.05, LIMIT, np.zeros((12, 0)), np.ones(12))
    model.__dict__.update(
        residuals=residuals,
        rms={block: rms(residual) for block, residual in residuals.items()},
        floors=dict.fromkeys(levels, floor),
    )
    return model


@pytest.fixture(autouse=True)
def sizes_are_credible(monkeypatch: pytest.MonkeyPatch) -> None:
    """The made models have no fits: their sizes are large, and the same everywhere."""
    monkeypatch.setattr(Model, "is_substantial", lambda self, effect: True)
    monkeypatch.setattr(Model, "is_plausible", property(lambda self: True))
    monkeypatch.setattr(verdicts, "spread_of_effect", lambda model, effect: 0.0)


def judge(base: Model, *levels: Sequence[Model]) -> Judgement:
    return judge_search(EffectSearch(base, tuple(tuple(level) for level in levels)), base)


def test_a_name_that_closes_one_blocks_gap_is_not_lost_to_the_other_block() -> None:
    base = made(pressure=32.5, mechanics=2.07)
    model = made("valve_deadband", base=base, pressure=1.02, mechanics=2.07)
    found = judge(base, [model])
    assert (found.verdict, found.model.names) == (Verdict.PARTIAL, ("valve_deadband",))


@pytest.mark.parametrize(("left", "verdict"), [(14.0, Verdict.NONE_KNOWN), (9.0, Verdict.PARTIAL)])
def test_a_name_must_close_two_thirds_of_the_way_to_the_limit(
    left: float, verdict: Verdict
) -> None:
    base = made(pressure=30.0)
    assert judge(base, [made("valve_curve", base=base, pressure=left)]).verdict is verdict


@pytest.mark.parametrize(
    ("left", "spread", "is_name"),
    [
        (1.0, 0.22, True),
        (1.0, 0.3, False),
        (9.0, 0.05, True),
        (9.0, 0.15, False),
    ],
)
def test_the_less_an_effect_closes_the_better_must_the_pieces_agree_about_it(
    monkeypatch: pytest.MonkeyPatch, left: float, spread: float, is_name: bool
) -> None:
    monkeypatch.setattr(verdicts, "spread_of_effect", lambda model, effect: spread)
    base = made(pressure=30.0, mechanics=3.0)
    model = made("valve_curve", base=base, pressure=left, mechanics=3.0)
    assert (judge(base, [model]).verdict is Verdict.PARTIAL) is is_name


def test_the_way_ends_at_the_limit_and_not_at_the_mean_floor() -> None:
    base = made(pressure=2.0)
    model = made("valve_curve", base=base, pressure=1.45)  # 0.55 of 0.8 to the limit, of 1.0 below
    assert judge(base, [model]).verdict is Verdict.PARTIAL


@pytest.mark.parametrize(
    ("left", "verdict"),
    [(2.0, Verdict.NONE_KNOWN), (1.19, Verdict.NONE_KNOWN), (1.1, Verdict.NAMED)],
)
def test_effects_must_explain_wholly_why_blocks_disagree_that_are_at_their_limits_alone(
    left: float, verdict: Verdict
) -> None:
    """The name closes most of the gap of the shared numbers; apart, the blocks have no gap."""
    alone, base = made(), made(mechanics=6.0)
    model = made("encoder_scale", base=base, mechanics=left)
    assert judge_search(EffectSearch(base, ((model,),), alone), base).verdict is verdict
    assert judge(base, [model]).verdict is (Verdict.NAMED if left < LIMIT else Verdict.PARTIAL)


def test_a_gain_that_one_stretch_makes_alone_is_no_gain() -> None:
    base = made(pressure=0.0, stretches=[2.0] * 19 + [80.0])
    model = made("valve_curve", base=base, pressure=0.0, stretches=[2.2] * 19 + [4.0])
    assert model.rms["pressure"] < 0.3 * base.rms["pressure"]
    assert judge(base, [model]).verdict is Verdict.NONE_KNOWN


def test_a_model_that_spoils_the_other_block_is_no_explanation() -> None:
    base = made(pressure=10.0)
    left = {"pressure": 1.0, "mechanics": 8.0}
    reaching_both, reaching_one = "pressure_sensor_gain", "valve_deadband"
    spoiling = made(reaching_both, base=base, **left)
    assert judge(base, [spoiling]).verdict is Verdict.NONE_KNOWN
    one_geometry = made(reaching_one, base=base, **left)  # the other block disagrees about it
    assert judge(base, [one_geometry]).verdict is Verdict.PARTIAL


def test_a_second_name_must_close_most_of_what_the_first_leaves() -> None:
    base = made(pressure=30.0)
    first = made("valve_deadband", base=base, pressure=6.0)
    for left, names in ((5.0, 1), (2.0, 2)):
        second = made("valve_deadband", "valve_spool", base=base, pressure=left)
        assert len(judge(base, [first], [second]).model.names) == names


def test_a_rival_just_above_its_limit_is_not_refuted() -> None:
    base = made(pressure=30.0)
    chosen = made("valve_spool", base=base, pressure=1.15)
    assert not is_refuted(made("command_delay", base=base, pressure=1.001 * LIMIT), chosen)
    assert is_refuted(made("command_delay", base=base, pressure=1.3 * LIMIT), chosen)


def test_a_worse_coupled_signal_accuses_no_effect_while_another_block_lacks_something() -> None:
    base = made(pressure=32.5, mechanics=5.0)
    open_still = made("valve_deadband", base=base, pressure=1.0, mechanics=5.0)
    assert find_spoilers(open_still, frozenset({"mechanics"})) == frozenset()
    in_part = made("cubic_stiffness", base=base, mechanics=3.0)
    assert find_spoilers(in_part, frozenset({"pressure"})) == frozenset()
    assert find_spoilers(in_part, frozenset({"mechanics"})) == {"cubic_stiffness"}
    closed = made("valve_deadband", base=base, pressure=1.0)
    assert find_spoilers(closed, frozenset({"mechanics"})) == {"valve_deadband"}
    both = made("valve_deadband", "cubic_stiffness", base=base)
    assert find_spoilers(both, frozenset({"mechanics"})) == {"cubic_stiffness"}
    assert find_spoilers(both, frozenset()) == frozenset()


def test_sets_grow_only_from_effects_that_gain_something() -> None:
    base = made(pressure=10.0, mechanics=10.0)
    useless = made("valve_leak", base=base, pressure=9.9, mechanics=10.0)
    assert choose_beam(base, [[useless]]) == []
    strong = made("valve_deadband", base=base, pressure=2.0, mechanics=10.0)
    middling = made("valve_spool", base=base, pressure=5.0, mechanics=10.0)
    weak = made("valve_curve", base=base, pressure=8.0, mechanics=10.0)
    elsewhere = made("creep", base=base, pressure=10.0, mechanics=8.0)
    beam = choose_beam(base, [[strong, middling, weak, useless]])
    assert [m.names for m in beam] == [("valve_deadband",), ("valve_spool",)]
    enough = made("valve_deadband", base=base, pressure=1.0, mechanics=10.0)
    beam = choose_beam(base, [[enough, middling, elsewhere, weak, useless]])
    assert [m.names for m in beam] == [("valve_deadband",), ("creep",)]


def test_a_third_effect_is_tried_only_beside_two_that_close_half_of_a_gap() -> None:
    base = made(pressure=10.0)
    first = made("valve_curve", base=base, pressure=7.0)
    for left, grows in ((6.5, 0), (4.0, 1)):
        second = made("valve_curve", "valve_leak", base=base, pressure=left)
        assert len(choose_beam(base, [[first], [second]])) == grows
