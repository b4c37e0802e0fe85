"""What a diagnosis says speaks of the rig at hand: a mechanism has no air, and no `pamctl run`."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.made_records import ask_only, list_asked, names_of

from pamctl.diagnose import Diagnosis, Record, Verdict, diagnose, report_diagnosis
from pamctl.diagnose.audit import audit_run
from pamctl.diagnose.evidence.pool import list_absent
from pamctl.diagnose.plant_numbers import FittedNumber
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.diagnose.report.diagnosis_page import build_diagnosis_page, format_plant_file
from pamctl.diagnose.report.finding_words import FreeTerm
from pamctl.diagnose.report.next_experiment import (
    MOTIONS,
    advise_experiment,
    runs_here,
    write_advice,
)
from pamctl.diagnose.report.verdict_words import advise_next_steps, sentence
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.drive import drive_coupled
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.terms import LOCATIONS
from pamctl.report.html_page import write_html
from pamctl.report.report import format_terminal
from pamctl.settings.yaml12 import parse_yaml

pytestmark = pytest.mark.long

PARAMETERS = {"mass_kg": 2.0, "damping_n_s_per_m": 40.0, "stiffness_n_per_m": 900.0}
AXIS = PlantSettings(actuator="direct", parameters=PARAMETERS)
AIR = ("valve", "muscle", "vented", "supply", "tubing", "contracting", "pamctl run")


def axis_record(seed: int, friction_n: float = 3.0) -> Record:
    """Return a mass on a spring with dry friction, moved by a force of several sines for 6 s."""
    random = np.random.default_rng(seed)
    t_s = np.arange(6000) * 1e-3
    force_n = sum(9.0 * np.sin(2 * np.pi * f * t_s + random.uniform(0, 6)) for f in (0.4, 1.1, 2.3))
    force_n = np.where(t_s < 0.5, 0.0, force_n)
    position_m = move_axis(force_n, friction_n)
    return Record(
        f"axis-{seed}",
        t_s,
        force_n=force_n + random.normal(0.0, 0.02, len(t_s)),
        position_m=position_m + random.normal(0.0, 2e-6, len(t_s)),
        is_imported=True,
    )


def move_axis(force_n: np.ndarray, friction_n: float) -> np.ndarray:
    """Integrate mass, spring, damper and dry friction at 10 kHz; the force holds for 1 ms."""
    mass, damping, stiffness = PARAMETERS.values()
    step_s, x_m, v = 1e-4, 0.0, 0.0
    positions = []
    for held_n in force_n:
        positions.append(x_m)
        for _ in range(10):
            free = v + step_s / mass * (held_n - stiffness * x_m - damping * v)
            # Friction brings the mass to rest within a step, or slows it by a fixed amount.
            slowed = abs(free) - step_s / mass * friction_n
            v = math.copysign(max(slowed, 0.0), free)
            x_m += step_s * v
    return np.array(positions)


@pytest.fixture(scope="module")
def records() -> list[Record]:
    return [axis_record(1), axis_record(2)]


@pytest.fixture(scope="module")
def found(records: list[Record]) -> Diagnosis:
    others = ask_only("coulomb_friction", "cubic_stiffness", "late", of=list_asked(records, AXIS))
    return diagnose(records[:1], records[1:], AXIS, without=others)


@pytest.mark.parametrize("verdict", [None, Verdict.NONE_KNOWN, Verdict.PARTIAL])
def test_no_word_of_a_mechanism_speaks_of_air(found, records, verdict):
    said = found if verdict is None else replace(found, verdict=verdict)
    assert names_of(found) == ["coulomb_friction"]
    html = write_html(build_diagnosis_page(said, records))
    page = re.sub(r"<style.*?</style>", "", html.split("plant.yaml</summary>")[0], flags=re.S)
    document = build_diagnosis_document(said)
    told = "\n".join(
        [
            page,
            format_terminal(report_diagnosis(said)),
            *advise_next_steps(said),
            json.dumps(document["next_experiment"]),
        ]
    ).lower()
    assert [word for word in AIR if word in told] == []
    assert not {"valve_leak", "moving_mass"} & {spot["name"] for spot in document["blind_spots"]}
    assert "next.mcap" not in told


def test_an_axis_without_a_pressure_is_told_nothing_of_a_pressure(found):
    spots = {spot["name"] for spot in build_diagnosis_document(found)["blind_spots"]}
    assert not {name for name in spots if "pressure" in name or name == "piston"}
    assert "encoder_scale" not in json.dumps(build_diagnosis_document(found)["next_experiment"])
    for experiment in MOTIONS:
        assert "pressure" not in advise_experiment(found, experiment)
    shown = [replace(r, pressure_pa=np.full(len(r), 2e5)) for r in found.train]
    with_pressure = replace(found, train=tuple(shown))
    assert "at several pressures" in advise_experiment(with_pressure, "diagnosis")


def test_who_diagnoses_another_rig_with_the_papers_muscle_is_told_to_describe_his(found):
    assert found.evidence is not None
    far = {c: 2000.0 * noise for c, noise in found.evidence.noise_rms.items()}
    evidence = replace(found.evidence, gap={**found.evidence.gap, "extended": far})
    lost = replace(found, nominal=PlantSettings(), evidence=evidence)
    first = next(advise_next_steps(lost))
    told = " ".join(format_terminal(report_diagnosis(lost)).split())
    for said in (first, told):
        assert "pamctl plant new --from FILE --out rig.yaml" in said
    assert "plant new" not in " ".join(advise_next_steps(replace(lost, nominal=AXIS)))
    assert "plant new" not in " ".join(advise_next_steps(found))


def test_a_refused_record_of_a_mechanism_is_not_to_be_vented(records):
    still = [replace(r, force_n=np.zeros(len(r))) for r in records]
    refused = diagnose(still, [], AXIS)
    assert refused.verdict is Verdict.BAD_DATA
    told = " ".join([sentence(refused), *advise_next_steps(refused)])
    assert "force_n varies by only 0 N" in told
    assert "vented" not in told
    assert "pamctl run" not in told


def test_only_a_muscle_whose_records_pamctl_made_is_told_to_run(found):
    mine = [replace(record, is_imported=False) for record in found.train]
    muscle = replace(found, nominal=PlantSettings(), train=tuple(mine), holdout=())
    assert runs_here(muscle)
    assert not runs_here(replace(muscle, holdout=found.holdout))
    assert not runs_here(found)
    for effect in CATALOGUE.values():
        advised = {effect.best_experiment, *(t.experiment for t in effect.told_from.values())}
        assert advised - {""} <= {*MOTIONS}
    of_muscle = write_advice("chirp", PlantSettings(), runs_here=True)
    assert of_muscle == "pamctl run --experiment chirp"
    assert "driving force" in write_advice("chirp", AXIS, runs_here=False)


def test_a_chamber_of_constant_volume_is_diagnosed_without_a_position():
    base = {"actuator": "chamber", "chamber_volume_m3": 1e-3}
    leak = {"chamber_leak": {"area_m2": 5e-8}}
    truth = PlantSettings.model_validate({**base, "effects": leak})
    records = [chamber_record(seed, truth) for seed in (1, 2)]
    plant = PlantSettings.model_validate(base)
    others = ask_only("chamber_leak", "valve_deadband", of=list_asked(records, plant))
    found = diagnose(records[:1], records[1:], plant, without=others)
    assert found.verdict is Verdict.NAMED
    assert names_of(found) == ["chamber_leak"]
    (area,) = (n for n in found.numbers if n.name == "chamber_leak.area_m2")
    assert area.value == pytest.approx(5e-8, rel=0.02)
    assert found.plant.chamber_volume_m3 == 1e-3
    written = parse_yaml(format_plant_file(found, ["a"]), Path("plant.yaml")).data
    assert not {"mass_kg", "braid_turns", "stiffness_n_per_m"} & written["parameters"].keys()
    assert PlantSettings.model_validate(written) == found.plant
    told = format_terminal(report_diagnosis(found)) + " ".join(advise_next_steps(found))
    assert "muscle" not in told
    assert "pamctl run" not in told
    document = build_diagnosis_document(found)
    assert not {"creep", "moving_mass"} & {spot["name"] for spot in document["blind_spots"]}
    spots = {spot["name"]: spot for spot in document["blind_spots"]}
    assert spots["dead_volume"]["experiment"] == ""
    assert "it does the same as another valve_gain_m2_per_v" in spots["dead_volume"]["why"]
    assert not {"encoder_scale", "encoder_backlash"} & {*spots}
    assert "dead_volume" not in json.dumps(document["next_experiment"])
    known = PlantSettings.model_validate({**base, "known": ["valve_gain_m2_per_v"]})
    told = audit_run(records[0], known).as_dict()
    assert "does the same" not in json.dumps(told)


def test_a_mechanism_without_a_spring_is_asked_no_creep_of_it_and_advised_no_held_force(records):
    free = AXIS.model_copy(
        update={"parameters": AXIS.parameters.model_copy(update={"stiffness_n_per_m": 0.0})}
    )
    asked = {}
    for plant in (AXIS, free):
        told = audit_run(records[0], plant).as_dict()
        asked[plant is free] = {name["name"] for name in told["unasked"]}
    assert "creep" in asked[True] - asked[False]
    assert "creep" in list_absent("cylinder", 0.0)
    assert list_absent("muscle", 0.0) == ()
    for experiment in MOTIONS:
        assert "each held" not in write_advice(experiment, free, runs_here=False)
    assert "each held for a minute" in write_advice("long-holds", AXIS, runs_here=False)


def chamber_record(seed: int, truth: PlantSettings) -> Record:
    """Return 9 s at 200 Hz: held commands of several sizes, closed valve included."""
    random = np.random.default_rng(seed)
    held = np.repeat(random.choice([-5, 5, 2, -2, 0.5, -0.5, 0, 0], 20), 80).astype(float)
    command = np.concatenate([np.full(200, -5.0), held])
    driven = drive_coupled(plant_parameters(truth), command, 5e-3, steps=8)
    noise_pa = random.normal(0.0, 200.0, len(command))
    t_s = 5e-3 * np.arange(len(command))
    return Record(
        f"tank-{seed}",
        t_s,
        valve_v=command,
        pressure_pa=driven.pressure_pa + noise_pa,
        is_imported=True,
    )


def test_an_interval_has_the_digits_that_its_ends_need_to_differ():
    shown = FittedNumber("f.width_v", 0.25, 0.249962, 0.250031, "V").spell()
    assert shown == ["0.25000", "0.24996 to 0.25003", "V"]
    assert FittedNumber("mass_kg", 1342.04, 1341.0, 1343.0, "kg").spell()[:2] == [
        "1342.0",
        "1341.0 to 1343.0",
    ]
    assert FittedNumber("f.n", 0.25, 0.25, 0.25, "").spell()[1] == "0.2500 to 0.2500"


@pytest.mark.parametrize(
    ("knots", "said"),
    [
        ((-1.01, -1.0, -0.999, -0.994, -1.0), "until nearly nothing of it is left"),
        ((0.1, 0.0, -0.4, -0.9, -1.0), "from 10 % to the loss of all of it"),
        ((0.0, 0.0, 0.0, -0.5, -1.5), "from 0 % to the loss of all of it, where its sign turns"),
        ((0.0, 0.1, 0.2, 0.1, 0.0), "from 0 % to 20 %"),
    ],
)
def test_a_law_that_takes_a_force_away_says_so(knots, said):
    numbers = tuple(FittedNumber(f"f.knot_{k}", v, v, v, "1") for k, v in enumerate(knots))
    term = FreeTerm(
        LOCATIONS["braid_friction"], "curve", "time", {"size": 1.0}, numbers, (0.0, 9.0)
    )
    assert term.text == f"a change of the braid's friction that follows time along a curve, {said}"


def test_a_curve_of_which_no_knot_is_sure_has_no_size_in_its_words():
    knots = [FittedNumber(f"f.knot_{k}", v, v - 9.0, v + 9.0, "1") for k, v in enumerate(range(5))]
    place, values, span = LOCATIONS["braid_friction"], {"size": 1.0}, (0.0, 9.0)
    unsure = FreeTerm(place, "curve", "time", values, (*knots,), span)
    assert unsure.text.endswith("along a curve, of a size that these data do not tell")
    sure = replace(unsure, numbers=(*knots[:4], replace(knots[4], low=1.0)))
    assert sure.text.endswith("along a curve, from 0 % to 400 %")
    wave = replace(unsure, operator="wave", numbers=(FittedNumber("f.size", 1.0, 0.5, 1.5, "1"),))
    assert wave.text.endswith("+-100 %")
