"""What no catalogue has: said by place and kind, on rigs whose equations are not the pool's."""

from dataclasses import replace

import numpy as np
import pytest
from hidden.excitations import multisine, null_staircase, square
from hidden.hostile.file_of_lab import record_of
from hidden.hostile.lab import Lab
from hidden.hostile.programs import compose_open
from hidden.rig import hidden_rig
from hidden.sensors import ENCODER_STEP_M
from hidden.uncatalogued import UNCATALOGUED
from support.made_records import ask_only, measured, names_of, numbers_of, to_records

from pamctl.diagnose import Diagnosis, Record, diagnose, report_diagnosis
from pamctl.diagnose.record import Array
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.diagnose.report.diagnosis_page import build_diagnosis_page, format_plant_file
from pamctl.plant.model import PlantSettings, values_of
from pamctl.report.html_page import write_html
from pamctl.report.report import format_terminal
from pamctl.settings.yaml12 import parse_yaml_value


def measure(effect: str, size: float = 3.0, seed: int = 11) -> tuple[list[Record], list[Record]]:
    """Measure a hidden rig; 3 s of squares and 4 s of sines fit, 4 s of sines judge."""
    rig = hidden_rig({effect: size} if effect else {}, seed=seed)
    train = [square(1.0, 2.0, seed=seed), multisine(2.5, 0.3, 30.0, 4.0, seed)]
    held = [multisine(2.0, 0.4, 25.0, 4.0, seed + 7), null_staircase(3.0, seed)]
    return to_records([[rig.run(e).record for e in part] for part in (train, held)])


SUPPLY = ("supply", "drift", "opening~", "flow~", "filling~", "pressure_sensor")
FRICTION = ("friction", "stribeck", "presliding", "hysteresis", "creep", "lag(position)")
LOAD = ("force~", "stiffness~", "pull~", "encoder~", "external_load", "creep", "drift")
SENSOR = ("pressure_sensor", "braid_stretch", "pull~", "flow~", "valve_curve")
LEAK = ("leak", "flow~onset", "exhausting~", "filling~onset", "dead_volume")


def of_uncatalogued(name: str, *asked: str, seed: int = 7, program: str = "short") -> Diagnosis:
    """Diagnose a rig with a law of no catalogue."""
    (case,) = (one for one in UNCATALOGUED if one.name == name)
    parts = to_records(case.record(program, seed))
    return diagnose(*parts, PlantSettings(), without=ask_only(*asked))


def test_a_spring_that_begins_on_the_way_is_described_by_place_and_kind():
    found = of_uncatalogued("second_spring", *LOAD, "cubic_stiffness", program="brief")
    document = build_diagnosis_document(found)
    assert document["verdict"] == "described"
    assert document["effects"] == []
    (term,) = document["terms"]
    assert (term["location"], term["driver"]) == ("force", "position")
    assert term["text"] in document["sentence"]
    assert found.gap["position_m"].extended < 0.1 * found.gap["position_m"].recalibrated
    plant = PlantSettings.model_validate(parse_yaml_value(format_plant_file(found, ["x.mcap"])))
    assert plant == found.plant
    assert plant.terms.force is not None
    html = write_html(build_diagnosis_page(found, [*found.train, *found.holdout]))
    assert term["text"] in html
    assert f"{term['text']}: kind is sure" in format_terminal(report_diagnosis(found))


def test_a_bowed_pressure_sensor_is_described_with_its_curve():
    found = of_uncatalogued("bent_sensor", *SENSOR, program="brief")
    (term,) = build_diagnosis_document(found)["terms"]
    assert (term["location"], term["operator"], term["driver"]) == (
        "pressure_sensor", "curve", "pressure",
    )  # fmt: skip
    at = [point["at"] for point in term["curve"]]
    assert at == sorted(at)
    assert len(at) == 5


BEYOND = {"operator": "beyond", "driver": "position", "inner": 0.008, "size": -60.0}
CURVE = {"operator": "curve", "driver": "position", "low": 0.0, "high": 0.02, "size": 10.0,
         "knot_1": 0.0, "knot_2": 1.0, "knot_3": -1.0, "knot_4": 0.5, "knot_5": 2.0}  # fmt: skip


@pytest.mark.parametrize(
    ("term", "wrong"),
    [(BEYOND, {"size": -25.0}), (CURVE, {"knot_2": 0.0, "knot_3": 1.0, "knot_5": 1.0})],
    ids=["size", "knots"],
)
def test_a_stated_term_of_a_wrong_size_comes_back_with_the_right_one(term, wrong):
    true, stated = (
        PlantSettings.model_validate({"terms": {"force": numbers}})
        for numbers in (term, {**term, **wrong})
    )
    found = diagnose([measured("fit", 1, **values_of(true))], [], stated, without=ask_only())
    fitted = {n.name: n for n in found.recalibrated}
    for name in wrong:
        number = fitted[f"force_term.{name}"]
        assert number.value == pytest.approx(term[name], rel=0.01)
        assert number.low < term[name] < number.high
    assert found.plant.terms.force is not None
    held = "inner" if term is BEYOND else "size"
    assert found.plant.terms.force[held] == term[held]


def test_a_hysteretic_spring_is_named():
    found = diagnose(
        *measure("hysteretic_spring", 5.0), PlantSettings(), without=ask_only(*FRICTION)
    )
    assert names_of(found) == ["spring_hysteresis"]


def test_a_supply_that_falls_is_no_ripple_of_which_half_a_wave_is_seen():
    found = of_uncatalogued("supply_falls", *SUPPLY, seed=98, program="brief")
    (term,) = build_diagnosis_document(found)["terms"]
    assert (term["location"], term["driver"]) == ("supply", "time")
    assert names_of(found) == []


def test_a_slowly_rippling_supply_is_named_with_its_frequency():
    found = of_uncatalogued("supply_ripple", *SUPPLY)
    assert names_of(found) == ["supply_ripple"]
    assert numbers_of(found)["supply_ripple.frequency_hz"] == pytest.approx(0.7, rel=1e-3)


def test_friction_that_grows_with_position_is_named():
    found = diagnose(
        *measure("position_dependent_friction"), PlantSettings(), without=ask_only(*FRICTION)
    )
    assert names_of(found)[0] == "position_friction"
    assert numbers_of(found)["position_friction.share_per_m"] == pytest.approx(15.0, rel=0.16)


def test_a_load_that_is_hung_on_is_a_force_that_begins_then():
    found = of_uncatalogued("load_is_hung_on", *LOAD, seed=4, program="brief")
    (term,) = build_diagnosis_document(found)["terms"]
    assert (term["location"], term["operator"], term["driver"]) == ("force", "onset", "time")
    assert term["parameters"]["size"]["value"] == pytest.approx(-1.7, rel=0.02)


def test_a_spring_that_softens_at_an_instant_is_said_with_the_instant():
    rig, lab = hidden_rig({}, seed=11), Lab(at_half_factors={"stiffness": 0.95})
    sines = [multisine(2.5 - 0.3 * k, 0.3, 30.0, 4.0, seed=k) for k in range(4)]
    records = [record_of(rig, lab, excitation, 0.0) for excitation in sines]
    parts = to_records((records[:2], records[2:]))
    found = diagnose(*parts, PlantSettings(), without=ask_only(*LOAD))
    (term,) = build_diagnosis_document(found)["terms"]
    assert (term["location"], term["operator"]) == ("stiffness", "onset")
    lasts_s = records[0].t_s[-1]
    assert term["parameters"]["inner"]["value"] == pytest.approx(0.5 * lasts_s, rel=0.05)
    assert "begins" in term["text"]


def test_a_leak_that_opens_at_an_instant_is_a_leak_or_what_cannot_be_told_from_it():
    rig, lab = hidden_rig({}, seed=11), Lab(at_half={"chamber_leak_m2": 4e-8})
    runs = [record_of(rig, lab, compose_open(seed, 1.2, 2.0, 1.6), 0.0) for seed in (1, 102, 203)]
    parts = to_records((runs[:2], runs[2:]))
    first, *_ = diagnose(*parts, PlantSettings(), without=ask_only(*LEAK)).findings
    assert first.hypothesis.name == "leak~onset(time)"
    assert {rival.kind for rival in first.rivals} <= {"onset"}


def test_an_off_centre_encoder_is_placed_at_the_encoder():
    def add_wave(position_m: Array) -> Array:
        shown = position_m + 100e-6 * np.sin(2.0 * np.pi * position_m / 3.7e-3 + 0.7)
        return np.round(shown / ENCODER_STEP_M) * ENCODER_STEP_M

    train, held = (
        [replace(r, position_m=add_wave(r["position_m"])) for r in part] for part in measure("")
    )
    found = diagnose(train, held, PlantSettings(), without=ask_only("encoder", *LOAD))
    assert {f.hypothesis.place for f in found.findings if f.level != "set"} == {"encoder"}
