"""What is said of the rivals of a finding."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from pamctl.control.experiment import ProgramSettings
from pamctl.diagnose.deciding_program import DecidingProgram, Separation
from pamctl.diagnose.evidence.ladder import Finding, JudgedRival
from pamctl.diagnose.evidence.measuring_chain import list_of_chain
from pamctl.diagnose.evidence.pool import (
    PAPER_SCALES,
    Hypothesis,
    Unknown,
    list_effects,
    list_terms,
)
from pamctl.diagnose.plant_numbers import FittedNumber
from pamctl.diagnose.report.finding_words import (
    KINDS,
    PLACES,
    describe_standing,
    spell_best,
    spell_finding,
    spell_names,
)
from pamctl.diagnose.report.next_experiment import (
    explain_choice,
    name_apart,
    spell_next,
    tell_apart_surely,
)
from pamctl.diagnose.report.verdict_phrases import describe_rest, list_shifts, relative_shift
from pamctl.plant.effects.description import ACTUATORS
from pamctl.plant.model import PlantSettings, values_of
from pamctl.plant.terms import DRIVERS

LATE = next(list_of_chain(["position_m"], {}, 1e-3, "direct", {}))
CHAIN_OF_POSITION = [*list_of_chain(["position_m"], {}, 1e-3, "direct", {})]


@pytest.mark.parametrize(
    ("behind_nats", "is_beaten", "idle", "words"),
    [
        (62.0, True, 0, "62 nats behind"),
        (1.0, True, 2, "1 nats behind, and beaten: 2 more numbers for no gain"),
        (14.0, False, 0, "14 nats behind, which does not rule it out"),
        (-621.0, False, 0, "621 nats ahead"),
    ],
)
def test_a_rival_is_behind_or_ahead_and_never_a_negative_number_behind(
    behind_nats, is_beaten, idle, words
):
    ends = (behind_nats - 5.0, behind_nats + 5.0)
    rival = JudgedRival(
        LATE, behind_nats, ends, 0.9, is_beaten, False, False, None, idle_numbers=idle
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


def test_a_program_is_said_to_tell_explanations_apart_only_where_it_promises_to():
    two = {"separates": ["null_offset", "valve_curve"]}
    assert tell_apart_surely({**two, "promises": True}) == "tells null offset from valve curve"
    assert not tell_apart_surely({**two, "promises": False})
    assert not tell_apart_surely({"separates": ["null_offset"]})
    runs = Separation("supply_droop", "filling~curve(command)", "mechanics", 1.99, 0.4)
    chosen = DecidingProgram(
        ProgramSettings(kind="program", parts=[{"wave": "hold", "valve_v": 0, "duration_s": 1}]),
        ("supply_droop", "filling~curve(command)"), (runs,), 3e5, 0.0, 0.02, 9.0, 124, 14, "they",
    )  # fmt: skip
    assert explain_choice(chosen) == (
        "no program is sure to decide, and this one comes nearest (the best of 124 programs, of "
        "which 14 stay within the limits): if supply droop is true, curve of filling over command "
        "should leave 1.99 times the floor of the mechanics block"
    )


def test_what_only_mends_the_model_is_said_by_name_with_why_no_more_is_said_of_it():
    late, smoothed = (
        h for h in CHAIN_OF_POSITION if h.name in ("position_late", "position_smoothed")
    )
    number = FittedNumber("~", 2e-3, 1e-3, 3e-3, "s")
    ends = 90.0, 110.0
    small = Finding(
        late, False, False, "little", 100.0, ends, 0.05, (number,), (), 0, True, ()
    )  # fmt: skip
    rival = JudgedRival(
        late, 9.0, ends, 0.9, is_beaten=False, is_freer=False, is_better=False, model=None
    )
    large = replace(small, hypothesis=smoothed, gain_nats=7000.0, share=0.3, judged=(rival,))
    assert describe_rest(SimpleNamespace(findings=[replace(small, is_rest=False)])) == ""
    said = describe_rest(SimpleNamespace(findings=[small, large]))
    assert said == (
        "Beside that, position_m late by 2 ms mends the model: what gains less than a tenth of the "
        "whole is not asked for its name. Beside that, position_m smoothed over 2 ms mends the "
        "model: a name is not sure, as little of what is left goes with it, or a law that was not "
        "asked may stand there."
    )


def test_a_number_near_0_that_moved_is_said_by_its_values_and_not_by_a_share_of_nothing():
    load, spring = "external_load.force_n", "cubic_stiffness.n_per_m3"
    moved = (
        FittedNumber(load, -0.014, -0.028, 0.0003, "N"),
        FittedNumber(spring, 1.03e6, 1.02e6, 1.04e6, "N/m3"),
    )
    ranges = [Unknown(load, -0.03, -1.6, 1.6, 0.003), Unknown(spring, 1e6, -5e7, 5e7, 1e5)]
    found = SimpleNamespace(
        recalibrated=moved,
        start_value={load: -0.0314, spring: 1e6}.get,
        evidence=SimpleNamespace(model=SimpleNamespace(numbers=ranges)),
    )
    assert list_shifts(found) == (
        "cubic_stiffness.n_per_m3 +3.0 %, external_load.force_n -0.0314 to -0.014 N"
    )
    assert relative_shift(found, moved[0]) is None


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
