"""What no catalogue has: described on rigs whose equations are not the grammar's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden.excitations import multisine, null_staircase, square
from hidden.rig import hidden_rig
from hidden.sensors import ENCODER_STEP_M
from hidden.uncatalogued import UNCATALOGUED
from support.free_mass import FRICTION_N, LOAD_N, axis, pushed_mass

from pamctl.diagnose import Record, diagnose
from pamctl.diagnose.fitting.evidence import prepare_evidence
from pamctl.diagnose.fitting.model_fit import recalibrate
from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.name import Naming
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.diagnose.report.extended_plant_file import format_plant_file
from pamctl.diagnose.report.page.diagnosis_page import build_diagnosis_page
from pamctl.diagnose.report.terminal_summary import summary
from pamctl.diagnose.terms.by_name import name_instead
from pamctl.diagnose.terms.grammar import list_questions
from pamctl.diagnose.terms.term_score import rank_terms
from pamctl.diagnose.terms.trials import (
    choose_simplest,
    find_shown_knots,
    find_terms,
    spread_to_unshown,
)
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.model import PlantSettings
from pamctl.settings.yaml12 import parse_yaml_value

pytestmark = pytest.mark.long


def measure(effect: str, size: float = 3.0, seed: int = 11) -> tuple[list[Record], list[Record]]:
    """Measure a hidden rig; 3 s of squares and 4 s of sines fit, 4 s of sines judge."""
    rig = hidden_rig({effect: size} if effect else {}, seed=seed)
    train = [square(1.0, 2.0, seed=seed), multisine(2.5, 0.3, 30.0, 4.0, seed)]
    held = [multisine(2.0, 0.4, 25.0, 4.0, seed + 7), null_staircase(3.0, seed)]
    parts = ([rig.run(e).record for e in part] for part in (train, held))
    fit, judge = ([Record(name=r.name, **r.columns()) for r in part] for part in parts)
    return fit, judge


@pytest.fixture(scope="module")
def described():
    train, held = measure("hysteretic_spring", 5.0)
    few = {"cubic_stiffness", "chamber_leak"}
    return diagnose(train, held, PlantSettings(), without={*CATALOGUE} - few)


def test_a_hysteretic_spring_is_described_by_its_place_and_memory(described) -> None:
    document = build_diagnosis_document(described)
    assert document["verdict"] == "described"
    assert document["effects"] == []
    (term,) = document["terms"]
    assert (term["location"], term["operator"], term["driver"]) == (
        "force",
        "hysteresis",
        "position",
    )
    numbers = term["parameters"]
    assert abs(numbers["size"]["value"]) == pytest.approx(0.5 * 5.0, rel=0.2)
    assert numbers["inner"]["value"] == pytest.approx(1.5e-3, rel=0.1)
    assert "remembers the last reversal of the position over 1." in document["sentence"]
    assert "presliding" in document["sentence"]
    assert term["closed"] > 0.9
    assert (
        document["gap"]["position_m"]["extended"]
        < 0.3 * document["gap"]["position_m"]["recalibrated"]
    )


def test_its_plant_file_predicts_and_serves_the_next_diagnosis(described) -> None:
    plant = PlantSettings.model_validate(parse_yaml_value(format_plant_file(described, ["x.mcap"])))
    assert plant == described.plant
    assert plant.terms.force is not None
    train, held = measure("hysteretic_spring", 5.0)
    evidence = prepare_evidence(train, held, plant).select_blocks({"mechanics"})
    again = recalibrate(evidence)
    without = plant.model_copy(update={"terms": PlantSettings().terms})
    plain = recalibrate(prepare_evidence(train, held, without).select_blocks({"mechanics"}))
    assert again.rms["mechanics"] < 0.4 * plain.rms["mechanics"]
    assert "force_term.size" in again.values


def test_page_and_terminal_say_the_term_and_its_leads(described) -> None:
    page = build_diagnosis_page(described, [*described.train, *described.holdout]).html()
    assert "What no catalogue has" in page
    assert "force, hysteresis, position" in page
    assert "terms were asked" in summary(described)


def test_friction_that_grows_with_position_is_found_at_the_braid() -> None:
    train, held = measure("position_dependent_friction")
    base = recalibrate(prepare_evidence(train, held, PlantSettings()).select_blocks({"mechanics"}))
    _, trials = find_terms(base, "mechanics")
    chosen = choose_simplest(trials)
    assert (chosen.question.location.name, chosen.question.driver) == ("braid_friction", "position")
    if chosen.question.operator == "gain":
        assert chosen.model.effect_values["braid_friction_term.size"] == pytest.approx(
            0.15, rel=0.2
        )
    nothing = Naming(Verdict.NONE_KNOWN, base, base, (), (), ())
    named = name_instead(nothing, base, chosen, trials, "mechanics")
    assert named is not None
    assert (named.verdict, named.model.names) == (Verdict.NAMED, ("position_friction",))
    assert named.model.effect_values["position_friction.share_per_m"] == pytest.approx(
        5.0 * 3.0, rel=0.16
    )
    assert named.standings[0].confidence > 0.9
    assert name_instead(nothing, base, chosen, trials, "mechanics", {"position_friction"}) is None


def test_the_place_of_a_jump_is_asked_again_at_the_instant_that_was_found() -> None:
    """The grid's instants are far from it: there, a jump of the pressure looks more like it."""
    (case,) = (one for one in UNCATALOGUED if one.name == "load_is_hung_on")
    parts = case.record("short", 4)
    train, held = ([Record(name=r.name, **r.columns()) for r in part] for part in parts)
    evidence = prepare_evidence(train, held, PlantSettings()).select_blocks({"mechanics"})
    _, (found, *_) = find_terms(recalibrate(evidence), "mechanics")
    assert found.question.key == ("force", "onset", "time")
    assert found.own_values["size"] == pytest.approx(-1.7, rel=0.03)
    assert found.own_values["inner"] == pytest.approx(1.31, abs=0.03)


@pytest.mark.parametrize("period_m", [3.7e-3, 6.3e-3])
def test_the_wave_of_an_off_centre_encoder_is_found_at_any_period(period_m: float) -> None:
    parts = measure("")
    train, held = ([replace(r, position_m=_add_wave(r["position_m"], period_m)) for r in part]
                   for part in parts)  # fmt: skip
    base = recalibrate(prepare_evidence(train, held, PlantSettings()).select_blocks({"mechanics"}))
    _, (found, *_) = find_terms(base, "mechanics")
    assert found.question.key == ("encoder", "wave", "position")
    assert found.own_values["inner"] == pytest.approx(period_m, rel=0.02)
    assert abs(found.own_values["size"]) == pytest.approx(100e-6, rel=0.1)


def _add_wave(position_m: Array, period_m: float) -> Array:
    shown = position_m + 100e-6 * np.sin(2.0 * np.pi * position_m / period_m + 0.7)
    return np.round(shown / ENCODER_STEP_M) * ENCODER_STEP_M


def test_a_mass_that_is_judged_in_windows_has_its_term_found() -> None:
    train, held = ([pushed_mass(seed, duration_s=8.0, damping_per_m=600.0)] for seed in (1, 2))
    friction = {"coulomb_friction": {"force_n": FRICTION_N}, "external_load": {"force_n": LOAD_N}}
    base = recalibrate(prepare_evidence(train, held, axis(**friction)))
    assert all(drive.windows for drive in base.evidence.train["mechanics"])
    _, trials = find_terms(base, "mechanics")
    chosen = choose_simplest(trials)
    assert chosen.question.key == ("damping", "gain", "position")
    assert chosen.model.effect_values["damping_term.size"] == pytest.approx(6.0, rel=0.1)


def test_a_wave_that_is_asked_comes_back_within_the_longest_record() -> None:
    """A supply that falls evenly is the beginning of a slow wave too, and no ripple."""
    drives = prepare_evidence(*measure(""), PlantSettings()).train["pressure"]
    asked = list_questions("pressure", drives, PlantSettings())
    periods_s = [q.held["inner"] for q in asked if q.operator == "wave" and q.driver == "time"]
    assert len(periods_s) > 40
    assert max(periods_s) <= max(d.grid.samples_s[-1] for d in drives) / 1.5


def test_a_knot_of_a_curve_that_nothing_shows_lies_between_its_neighbours() -> None:
    amounts = [0.0, 1e-9, 2.0, 0.0, 4.0]  # nothing moves at the first two speeds and at the fourth
    assert find_shown_knots(amounts).tolist() == [False, False, True, False, True]
    assert spread_to_unshown(amounts) == pytest.approx([2.0, 2.0, 2.0, 3.0, 4.0])


def test_nothing_is_found_in_noise() -> None:
    train, held = measure("")
    base = recalibrate(prepare_evidence(train, held, PlantSettings()).select_blocks({"mechanics"}))
    fitted = base.fit_of("mechanics")
    questions = list_questions("mechanics", fitted.drives, base.evidence.nominal)
    assert len(questions) > 100
    ranking = rank_terms(fitted, "mechanics", questions)
    assert ranking.group(3) == []
