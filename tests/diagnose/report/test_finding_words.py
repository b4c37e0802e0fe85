"""What is said of the rivals of a finding."""

import pytest

from pamctl.diagnose.evidence.ladder import Finding, JudgedRival
from pamctl.diagnose.evidence.measuring_chain import list_of_chain
from pamctl.diagnose.evidence.pool import PAPER_SCALES, Hypothesis, list_effects, list_terms
from pamctl.diagnose.plant_numbers import FittedNumber
from pamctl.diagnose.report.finding_words import (
    KINDS,
    PLACES,
    describe_standing,
    spell_best,
    spell_finding,
    spell_names,
)
from pamctl.diagnose.report.next_experiment import name_apart, spell_next
from pamctl.plant.effects.description import ACTUATORS
from pamctl.plant.model import PlantSettings, values_of
from pamctl.plant.terms import DRIVERS

LATE = next(list_of_chain(["position_m"], {}, 1e-3, "direct", {}))


@pytest.mark.parametrize(
    ("behind_nats", "is_beaten", "words"),
    [
        (62.0, True, "62 nats behind"),
        (14.0, False, "14 nats behind, which does not rule it out"),
        (-621.0, False, "621 nats ahead"),
    ],
)
def test_a_rival_is_behind_or_ahead_and_never_a_negative_number_behind(
    behind_nats, is_beaten, words
):
    ends = (behind_nats - 5.0, behind_nats + 5.0)
    rival = JudgedRival(
        LATE, behind_nats, ends, 0.9, is_beaten, is_freer=False, is_better=False, model=None
    )
    assert describe_standing(rival) == words


@pytest.mark.parametrize(
    ("name", "value_s", "words"),
    [
        ("position_late", 4.45e-3, "position_m late by 4.45 ms"),
        ("position_late", -2e-3, "position_m early by 2 ms"),
        ("position_smoothed", 12e-3, "position_m smoothed over 12 ms"),
    ],
)
def test_a_late_or_smoothed_column_is_said_with_its_milliseconds(name, value_s, words):
    chain = {h.name: h for h in list_of_chain(["position_m"], {}, 1e-3, "direct", {})}
    number = FittedNumber("~", value_s, value_s, value_s, "s")
    ends = 90.0, 110.0
    finding = Finding(
        chain[name], True, True, "open", 100.0, ends, 0.5, (number,), (), 0, False, ()
    )  # fmt: skip
    assert spell_best(finding) == words


def test_an_effect_that_is_a_kind_of_its_own_is_said_once():
    effects = {h.name: h for h in list_effects("muscle", PAPER_SCALES)}
    finding = Finding(
        effects["discharge_ratio"], True, True, "open", 100.0, (90.0, 110.0), 0.5, (), (), 0,
        False, (),
    )  # fmt: skip
    assert finding.level == "kind"
    said = spell_finding(None, finding)
    assert said == "a law like discharge ratio in the air behind the valve"


def test_a_rival_of_the_measuring_chain_is_said_in_words():
    assert spell_names("skew of position_m") == "a late or early position_m"
    assert spell_names("filter of position_m") == "a smoothed position_m"
    assert spell_names("curve of position_m over time") == "curve of position_m over time"


def test_explanations_are_told_apart_by_what_they_do_not_share():
    shared = "all_clock and chamber_leak"
    curve = "curve of position_m over position"
    one, other = f"{shared} and {curve}", f"{shared} and encoder_scale"
    assert name_apart([one, other]) == f"{curve} from encoder scale"
    assert name_apart([shared, one], "; ") == f"nothing more; {curve}"


def test_explanations_of_many_parts_are_a_list_that_names_three_parts_of_each():
    shared = "valve_hysteresis and command_delay"
    chain = f"{shared} and discharge_ratio and encoder_backlash and volume~curve(pressure)"
    three = [f"{chain} and spring_hysteresis", f"{chain} and coulomb_friction", shared]
    entry = {"do": "record: a sine", "separates": three, "why": "", "promises": True}
    assert spell_next(entry) == (
        "next record: a sine. Why: it tells apart "
        "(1) spring hysteresis, discharge ratio, encoder backlash and 1 more; "
        "(2) coulomb friction, discharge ratio, encoder backlash and 1 more; (3) nothing more"
    )


def test_a_next_step_is_a_command_with_a_remark_or_plain_words():
    asked = {"separates": ["null_offset", "valve_curve"], "why": "a long reason"}
    command = spell_next({**asked, "do": "pamctl run --experiment chirp"})
    assert command == "next: pamctl run --experiment chirp  # it tells null offset from valve curve"
    recorded = spell_next({"do": "record: a sine", "separates": ["tank"], "why": "it is blind"})
    assert recorded == "next record: a sine. Why: it is blind"
    unsure = spell_next({**asked, "do": "play it", "promises": False})
    assert unsure == "next step: play it. Why: a long reason"


@pytest.mark.parametrize("actuator", ACTUATORS)
def test_every_place_that_may_be_said_is_a_noun_of_its_own(actuator):
    reach = dict.fromkeys(DRIVERS, (0.0, 1.0))
    channels = ["force_n"] if actuator == "direct" else ["pressure_pa", "position_m"]
    plant = {**values_of(PlantSettings()), "stroke_m": 1.0}
    pool: list[Hypothesis] = [
        *list_effects(actuator, PAPER_SCALES),
        *list_terms(actuator, reach, PAPER_SCALES),
        *list_of_chain(channels, plant, 1e-3, actuator, reach),
    ]
    assert {h.place for h in pool} <= {*PLACES}
    assert {h.kind for h in pool if h.kind in ("clock", "crosstalk", "turned")} <= {*KINDS}
