"""Sizes that the pieces of the records disagree about, and intervals that hold other forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.made_records import find_candidate, pair

from pamctl.diagnose.fitting.block_fit import Fit
from pamctl.diagnose.fitting.candidates import Candidate
from pamctl.diagnose.fitting.drives import MECHANICS
from pamctl.diagnose.fitting.evidence import prepare_evidence
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.intervals import FittedNumber, widen_by_forms
from pamctl.diagnose.fitting.model_fit import fit_model, recalibrate
from pamctl.diagnose.fitting.numbers import numbers_of_effect, with_values
from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.naming.doubt import PIECES, is_strained, spread_of_effect, spread_of_size
from pamctl.diagnose.naming.verdict import Judgement, Verdict, revise_verdict
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.model import PlantSettings

PAPER = PlantSettings()
EVIDENCE = prepare_evidence(*pair(), PAPER).select_blocks({MECHANICS})


def fit_of_a_level(wanted: Array) -> Fit:
    """A fit of one number whose residual asks for another level in each piece of the record."""
    (drive,) = EVIDENCE.train[MECHANICS]
    (number,) = find_candidate("cubic_stiffness", EVIDENCE).switches
    count = drive.samples
    piece = np.arange(count) * PIECES // count
    fitted = Fit(PAPER, (number,), (drive,), -wanted[piece])
    fitted.__dict__["jacobian"] = np.ones((count, 1))
    return fitted


def test_the_spread_of_a_mean_over_pieces_is_its_standard_error() -> None:
    wanted = np.random.default_rng(2).normal(0.0, 3.0, PIECES)
    fitted = fit_of_a_level(wanted)
    (number,) = fitted.free
    expected = 1.645 * wanted.std(ddof=1) / np.sqrt(PIECES) * number.scale
    assert spread_of_size(fitted, number.name) == pytest.approx(expected, rel=0.02)
    assert spread_of_size(fit_of_a_level(np.full(PIECES, 3.0)), number.name) < 1e-3 * number.scale


def test_the_pieces_agree_about_a_true_effect_and_not_about_a_wrong_neighbour() -> None:
    evidence = prepare_evidence(*pair(cubic_stiffness__n_per_m3=2e6), PAPER)
    base = recalibrate(evidence.select_blocks({MECHANICS}))
    spreads = {}
    for name, start in (
        ("cubic_stiffness", {"cubic_stiffness.n_per_m3": 1e6}),
        ("return_friction", {"return_friction.share": 0.05}),
    ):
        effect = find_candidate(name, base.evidence)
        spreads[name] = spread_of_effect(fit_model(base, (effect,), [start]), effect)
    assert spreads["cubic_stiffness"] < 0.05
    assert spreads["return_friction"] > 0.2


def test_an_interval_holds_what_equal_forms_say(monkeypatch: pytest.MonkeyPatch) -> None:
    slow = FittedNumber("creep.time_constant_s", 12.6, 5.0, 20.1, "s")
    stiff = FittedNumber("stiffness_n_per_m", 9000.0, 8990.0, 9010.0, "N/m")
    monkeypatch.setattr(Model, "values", property(lambda self: {slow.name: 1.6}))
    widened = widen_by_forms([slow, stiff], [Model(EVIDENCE, (), {})])
    assert [(n.value, n.low, n.high) for n in widened] == [
        (12.6, 1.6, 20.1),
        (9000.0, 8990.0, 9010.0),
    ]
    assert widen_by_forms([slow], []) == (slow,)


def test_a_number_says_what_its_interval_takes_for_granted() -> None:
    number = FittedNumber("creep.time_constant_s", 12.6, 5.0, 20.1, "s")
    assert "conditional_on" not in number.as_dict()
    bound = replace(number, conditional_on=("creep",))
    assert bound.as_dict() == {**number.as_dict(), "conditional_on": ["creep"]}


@pytest.mark.parametrize(
    ("name", "number", "value", "strained"),
    [
        ("spring_hysteresis", "way_m", 1e-5, True),  # no way at all: dry friction
        ("spring_hysteresis", "way_m", 5e-5, False),
        ("stribeck", "speed_m_per_s", 0.1, True),
        ("creep", "time_constant_s", 30.0, False),  # longer than the records, perhaps
    ],
)
def test_a_shape_at_its_end_says_that_the_effect_imitates(
    name: str, number: str, value: float, strained: bool
) -> None:
    numbers = [p.name for p in CATALOGUE[name].parameters]
    every = numbers_of_effect(name, numbers, PAPER, None)
    effect = Candidate(name, name, every, (), frozenset({MECHANICS}))
    free = tuple(f for f in every if f.name == f"{name}.{number}")
    sizes = {s.name: s.low + s.scale for s in effect.switches}
    settings = with_values(PAPER, {**sizes, f"{name}.{number}": value})
    fitted = Fit(settings, free, EVIDENCE.train[MECHANICS], np.zeros(1))
    model = Model(EVIDENCE, (effect,), {frozenset({MECHANICS}): fitted})
    assert is_strained(model) is strained
    named = revise_verdict(Judgement(Verdict.NAMED, model), ())
    assert named is (Verdict.AMBIGUOUS if strained else Verdict.NAMED)
