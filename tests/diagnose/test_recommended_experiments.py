"""The experiments that audit and diagnose recommend exist, run, and show the effects."""

import math
from functools import cache

import numpy as np
import pytest

from pamctl.diagnose import Record
from pamctl.diagnose.audit import (
    Audit,
    BlindSpot,
    Inseparable,
    audit_run,
    find_separating_experiment,
)
from pamctl.diagnose.report.next_experiment import holds_full_program, write_command
from pamctl.offline.closed_loop import SimulatedRun, simulate_run
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.model import PlantSettings
from pamctl.settings.resolve import resolve

WHOLE_PROGRAM = "diagnosis"
"""Recommended where a discrepancy has no name."""
RECOMMENDED = sorted(
    {WHOLE_PROGRAM}
    | {e.best_experiment for e in CATALOGUE.values() if e.best_experiment}
    | {told.experiment for e in CATALOGUE.values() for told in e.told_from.values()}
)
VISIBLE_LARGE = {"dead_volume": 8.0}
"""Effects that no experiment shows at the smallest size of interest, and from how many sizes on."""


@cache
def run(name: str) -> SimulatedRun:
    return simulate_run(resolve(experiment=name))


@cache
def audit(name: str) -> Audit:
    done = run(name)
    signals = {key: done[key] for key in ("valve_v", "pressure_pa", "position_m")}
    return audit_run(Record(name, done.t_s, **signals), PlantSettings())


@pytest.mark.parametrize("name", RECOMMENDED)
def test_each_recommended_experiment_exists_and_runs_open_loop_without_a_trip(name):
    done = run(name)
    assert done.tripped_s is None
    assert all(math.isnan(x) for x in done["reference_m"])
    assert 4.0 <= done.t_s[-1] <= 61.0


@pytest.mark.parametrize("name", RECOMMENDED)
def test_only_the_whole_program_holds_motions_of_every_kind(name):
    done = run(name)
    record = Record(name, done.t_s, position_m=done["position_m"])
    assert holds_full_program(record) == (name == WHOLE_PROGRAM)


@pytest.mark.parametrize(
    ("effect", "experiment"),
    [
        (e.name, e.best_experiment)
        for e in CATALOGUE.values()
        if not e.unidentifiable and "muscle" in e.actuators
    ],
)
def test_each_recommended_experiment_shows_its_effects(effect, experiment):
    found = audit(experiment)
    if effect in VISIBLE_LARGE:
        (spot,) = (s for s in found.blind_spots if s.name == effect)
        assert 1.0 < spot.sizes < VISIBLE_LARGE[effect]
    else:
        assert effect in found.sees


def test_advice_is_found_for_either_order_of_two_effects():
    told = {
        frozenset((name, other)): distinction
        for name, effect in CATALOGUE.items()
        for other, distinction in effect.told_from.items()
    }
    assert len(told) == sum(len(e.told_from) for e in CATALOGUE.values())
    for pair, distinction in told.items():
        for names in (sorted(pair), sorted(pair, reverse=True)):
            advice = find_separating_experiment(names)
            assert advice["name"] == distinction.experiment
            assert advice["separates"] == sorted(pair)
    advice = find_separating_experiment(["moving_mass", "creep"])
    assert advice["name"] == CATALOGUE["creep"].best_experiment
    wanted = ["encoder_scale", "pressure_damping"]
    assert find_separating_experiment(wanted)["name"] == "square-1"
    assert find_separating_experiment(wanted, ("square-1",))["name"] == ""
    assert write_command("chirp") == "pamctl run --experiment chirp"


def test_advice_does_not_repeat_the_experiment_that_was_audited():
    spot = BlindSpot("coulomb_friction", "small", "slow-ramps", None)
    pair = Inseparable(("encoder_scale", "pressure_damping"), "square-1", "it shows one best")
    found = Audit((), (spot,), (pair,))
    assert found.advise_beyond("square-1").inseparable[0].experiment == ""
    assert found.advise_beyond("square-1").blind_spots == (spot,)
    assert found.advise_beyond("slow-ramps").blind_spots[0].experiment == ""


def test_a_record_that_the_plant_does_not_explain_is_to_be_diagnosed_before_more_is_recorded(
    tmp_path,
):
    (tmp_path / "rubs.yaml").write_text("effects: {coulomb_friction: {force_n: 60.0}}\n")
    done = simulate_run(resolve(experiment="square-1", plant=str(tmp_path / "rubs.yaml")))
    signals = {key: done[key] for key in ("valve_v", "pressure_pa", "position_m")}
    found = audit_run(Record("log", done.t_s, **signals), PlantSettings())
    assert found.is_covered
    assert not any(spot.experiment for spot in found.blind_spots)
    whys = [spot.why for spot in found.blind_spots]
    assert any("is lost in what the plant leaves unexplained" in why for why in whys)
    assert not any("sensors' noise" in why for why in whys)


def test_a_measured_record_of_held_full_steps_is_not_told_to_record_them():
    done, random = run("square-1"), np.random.default_rng(1)
    signals = {key: done[key] for key in ("valve_v", "pressure_pa", "position_m")}
    signals["pressure_pa"] = done["pressure_pa"] + random.normal(0.0, 3000.0, len(done.t_s))
    named = [
        {spot.experiment for spot in audit_run(record, PlantSettings()).blind_spots}
        for record in (
            Record("log", done.t_s, **signals),
            Record("log", done.t_s, **signals, is_imported=True),
        )
    ]
    assert "square-1" in named[0]
    assert not {"square-1", "squares-apart"} & named[1]
