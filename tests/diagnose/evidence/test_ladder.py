"""How far up the ladder a finding may be said beside another."""

import numpy as np
import pytest
from support.made_records import ask_only, pair

from pamctl.diagnose import diagnose
from pamctl.diagnose.evidence.fit import WeighedModel
from pamctl.diagnose.evidence.ladder import (
    Finding,
    climb_ladder,
    has_unasked_rival,
    stands_alone,
)
from pamctl.diagnose.evidence.name_search import NameSearch
from pamctl.diagnose.evidence.pool import PAPER_SCALES, Hypothesis, list_effects, list_terms
from pamctl.plant.model import PlantSettings

REACH = {"time": (0.0, 10.0), "position": (0.0, 0.02), "pressure": (0.0, 3e5)}
COMMAND = {"command": (-5.0, 5.0), "velocity": (-0.1, 0.1)}
EFFECTS = {h.name: h for h in list_effects("muscle", PAPER_SCALES)}
TERMS = {h.name: h for h in list_terms("muscle", REACH, PAPER_SCALES)}


def found(
    hypothesis: Hypothesis, gain: float, channel: int = 0, at_range: tuple[str, ...] = ()
) -> Finding:
    interval = 0.9 * gain, 1.1 * gain
    return Finding(
        hypothesis, True, True, "", gain, interval, 0.5, (), at_range, channel, False, ()
    )  # fmt: skip


PLAY = found(EFFECTS["encoder_backlash"], 400.0)


@pytest.mark.parametrize(
    ("larger", "is_alone"),
    [
        (found(EFFECTS["spring_hysteresis"], 700.0), True),
        (found(EFFECTS["spring_hysteresis"], 700.0, at_range=("way_m",)), False),
        (found(TERMS["force~hysteresis(position)"], 700.0), False),
        (found(TERMS["force~hysteresis(position)"], 700.0, channel=1), True),
        (found(TERMS["force~hysteresis(position)"], 300.0), True),
    ],
    ids=["understood", "at its range", "without a name", "of another channel", "smaller"],
)
def test_nothing_is_named_beside_a_larger_law_of_its_channel_that_is_open(larger, is_alone):
    assert stands_alone(PLAY, [larger, PLAY]) is is_alone


@pytest.mark.parametrize(
    ("first", "second", "is_unasked"),
    [
        ("braid_friction~curve(velocity)", "encoder~curve(position)", True),
        ("braid_friction~curve(velocity)", "encoder~wave(position)", True),
        ("braid_friction~curve(velocity)", "filling~curve(command)", False),
        ("flow~curve(pressure)", "pressure_sensor~curve(pressure)", True),
        ("flow~curve(pressure)", "encoder~wave(position)", False),
        ("stribeck", "encoder~curve(position)", False),
    ],
)
def test_a_second_law_may_stand_for_one_that_cannot_stand_beside_the_first(
    first, second, is_unasked
):
    pool = EFFECTS | {h.name: h for h in list_terms("muscle", REACH | COMMAND, PAPER_SCALES)}
    m = WeighedModel((first, second), (), {}, np.zeros(0))
    assert has_unasked_rival(pool, m, pool[second]) is is_unasked
    assert not has_unasked_rival(pool, m, pool[first])


def test_a_rival_of_two_models_is_judged_once_and_says_if_its_further_numbers_gain_nothing(
    monkeypatch,
):
    asked = ask_only("valve_deadband", "chamber_leak")
    widths = {"valve_deadband__fill_width_v": 0.25, "valve_deadband__exhaust_width_v": 0.2}
    evidence = diagnose(*pair(**widths), PlantSettings(), without=asked).evidence
    assert evidence is not None
    search, m = NameSearch(evidence.weigher, evidence.pool), evidence.model
    scores = search.score(m, ["chamber_leak"])
    (both,) = search.refit(m, scores, 1)
    further = len(both.x) - len(m.x)
    assert (both.names, further) == (("valve_deadband", "chamber_leak"), 1)
    monkeypatch.setattr(search, "score", lambda *_: scores)
    monkeypatch.setattr(search, "refit", lambda *_: [both, both])
    ((finding,), _) = climb_ladder(search, evidence.base, m)
    (rival,) = finding.judged
    assert abs(rival.behind_nats) < 1.0
    assert (rival.is_beaten, rival.idle_numbers, finding.level) == (True, further, "name")
