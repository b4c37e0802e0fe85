"""The set-up is asked before the physics: what is wrong about it is said as what it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from hidden.excitations import brief
from hidden.rig import HiddenRig, hidden_rig
from support.free_mass import imposed_motion
from support.made_records import PERIOD_S, measured, pair

from pamctl.diagnose import Record, diagnose
from pamctl.diagnose.fitting.candidates import list_candidates
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE
from pamctl.diagnose.fitting.evidence import prepare_evidence
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.model_fit import recalibrate, weigh_blocks
from pamctl.diagnose.naming.first_level import FirstLevel
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.setup.altered_drive import PlantChange, add_change
from pamctl.diagnose.setup.refused_columns import explain_refusal
from pamctl.diagnose.setup.suspect_setup import CheckedSetup, suspect_setup
from pamctl.diagnose.setup.suspects import (
    find_decimation,
    list_suspects,
    restore_command,
    shift_command,
)
from pamctl.plant.drive import drive_mechanics
from pamctl.plant.flat import parameters_of
from pamctl.plant.model import PlantSettings

PAPER = PlantSettings()
Runs = tuple[list[Record], list[Record]]


def _record(
    rig: HiddenRig,
    spoil: Callable[[Record], Record] = lambda r: r,
    truths: Sequence[float] = (),
    null_v: float = 0.0,
) -> Runs:
    """Run the short program; `truths` are factors of the stiffness, one a record."""
    parts: list[list[Record]] = []
    place = 0
    for part in brief(3):
        parts.append([])
        for excitation in part:
            own = rig
            if truths:
                k = rig.truth.stiffness * truths[place]
                own = replace(rig, truth=rig.truth._replace(stiffness=k))
            assert excitation.volts is not None
            asked = replace(
                excitation, volts=excitation.volts + null_v, rest_v=excitation.rest_v + null_v
            )
            run = own.run(asked).record
            columns = run.columns()
            columns["valve_v"] = columns["valve_v"] - null_v
            parts[-1].append(spoil(Record(f"{run.name}-{place}", **columns)))
            place += 1
    return parts[0], parts[1]


def _base(runs: Runs) -> Model:
    return weigh_blocks(recalibrate(prepare_evidence(*runs, PAPER)))


def _ask(runs: Runs) -> CheckedSetup:
    base = _base(runs)
    return suspect_setup(base, *runs, FirstLevel(list_candidates(base.evidence)))


@pytest.mark.parametrize("null_v", [0.1, -0.02])
def test_a_valve_that_is_closed_off_zero_is_found_and_corrected(null_v: float) -> None:
    setup = _ask(_record(hidden_rig(seed=4), null_v=null_v))
    (finding,) = setup.findings
    assert finding.kind == "null_offset"
    assert finding.value == pytest.approx(-null_v, abs=5e-4)
    assert not setup.base.unexplained
    assert finding.cannot_be_told_from == ()


@pytest.mark.parametrize("late_ticks", [2, -3])
def test_a_late_pressure_column_is_told_from_the_physics(late_ticks: int) -> None:
    def delay(record: Record) -> Record:
        rows = np.clip(np.arange(len(record)) - late_ticks, 0, len(record) - 1)
        return replace(record, pressure_pa=record["pressure_pa"][rows])

    (finding,) = _ask(_record(hidden_rig(seed=5), delay)).findings
    assert (finding.kind, finding.number) == ("skew", "pressure_pa")
    assert finding.value == pytest.approx(1e-3 * late_ticks, abs=1e-4)


def test_a_command_of_the_wrong_sign_is_said() -> None:
    def invert(record: Record) -> Record:
        return replace(record, valve_v=-record["valve_v"])

    findings = _ask(_record(hidden_rig(seed=6), invert)).findings
    assert [(f.kind, f.number) for f in findings] == [("sign", "valve_v")]


def test_a_stiffness_that_falls_from_record_to_record_is_said_with_its_values() -> None:
    shares = [1.0, 0.992, 0.984, 0.976, 0.968, 0.96]
    setup = _ask(_record(hidden_rig(seed=7), truths=shares))
    (finding,) = setup.findings
    assert (finding.kind, finding.number) == ("drift", "stiffness_n_per_m")
    assert finding.value == pytest.approx(0.04, rel=0.1)
    values = [*finding.by_record.values()]
    assert values == sorted(values, reverse=True)
    assert not setup.base.unexplained


def test_commands_logged_more_rarely_than_given_are_refused_with_the_reason() -> None:
    def decimate(record: Record) -> Record:
        return replace(record, valve_v=record["valve_v"][np.arange(len(record)) // 5 * 5])

    setup = _ask(_record(hidden_rig(seed=8), decimate))
    (finding,) = setup.findings
    assert (finding.kind, finding.value) == ("decimated_command", 5.0)
    assert "log the command at every sample" in setup.refusal


@pytest.mark.parametrize("effects", [{}, {"valve_deadband": 3}, {"stribeck": 8}])
def test_a_right_set_up_is_not_blamed(effects: dict[str, float]) -> None:
    assert _ask(_record(hidden_rig(effects, seed=9))).findings == ()


def test_the_atmosphere_of_the_place_is_never_told_from_the_sensors_gain() -> None:
    rig = hidden_rig(seed=10)
    rig = replace(rig, truth=rig.truth._replace(atmosphere_pa=94e3))

    def add_wrong_atmosphere(record: Record) -> Record:
        return replace(record, pressure_pa=record["pressure_pa"] - 94e3 + 101.3e3)

    found = diagnose(*_record(rig, add_wrong_atmosphere), PAPER)
    assert found.verdict is Verdict.AMBIGUOUS
    (finding,) = [f for f in found.setup if f.number == "atmospheric_pressure_pa"]
    assert finding.value == pytest.approx(94e3, rel=0.01)
    assert "pressure_sensor_gain" in finding.cannot_be_told_from


def test_refused_records_say_which_column_is_read_wrongly() -> None:
    train, holdout = pair()
    records = [*train, *holdout]
    inverted = [replace(r, position_m=-r["position_m"]) for r in records]
    gauge = [replace(r, pressure_pa=r["pressure_pa"] - 101.3e3) for r in records]
    assert [(f.kind, f.number) for f in explain_refusal(inverted, PAPER)] == [
        ("sign", "position_m")
    ]
    assert [(f.kind, f.number) for f in explain_refusal(gauge, PAPER)] == [("gauge", "pressure_pa")]
    spoiled = [replace(r, pressure_pa=np.full(len(r), np.nan)) for r in records]
    assert explain_refusal(spoiled, PAPER) == ()


def test_a_number_that_changes_at_an_instant_is_simulated_as_two_plants_in_a_row() -> None:
    """Against the compiled simulation: before the instant one plant, long after it the other."""
    record = measured("fit", 1)
    evidence = prepare_evidence([record], [record], PAPER)
    (drive,) = evidence.train[MECHANICS]
    instant_s = 0.5 * record.duration_s
    changed = add_change(drive, PlantChange("stiffness_n_per_m", -0.05, after_s=instant_s))
    simulated = changed.simulate(PAPER)
    soft = parameters_of({"stiffness_n_per_m": 0.95 * 9680.0})
    after = drive_mechanics(soft, drive.driven, drive.grid).position_m
    half = int(np.searchsorted(record.t_s, instant_s))
    assert np.array_equal(simulated[:half], drive.simulate(PAPER)[:half])
    settled = half + round(1.0 / PERIOD_S)
    assert np.max(np.abs(simulated[settled:] - after[settled:])) < 5e-6


def test_a_command_shifted_by_whole_ticks_is_the_same_command_earlier() -> None:
    t_s = np.arange(100) * 1e-3
    command = np.random.default_rng(1).normal(size=100)
    shifted = shift_command(command, t_s, t_s + 3e-3)
    assert shifted[:97] == pytest.approx(command[3:])
    half = shift_command(command, t_s, t_s + 0.5e-3)
    assert half[:99] == pytest.approx(0.5 * (command[:99] + command[1:]))


def test_a_smooth_command_is_restored_between_the_logged_rows() -> None:
    t_s = np.arange(4000) * 1e-3
    given = 2.0 * np.sin(2.0 * np.pi * 3.0 * t_s) + np.sin(2.0 * np.pi * 7.3 * t_s)
    logged = given[np.arange(4000) // 10 * 10]
    assert find_decimation(logged) == 10
    assert find_decimation(given) == 1
    restored = restore_command(logged, 10)
    assert np.max(np.abs(restored - given)[20:-20]) < 0.02 * np.max(np.abs(logged - given))
    square = np.where(t_s % 1.0 < 0.5, 5.0, -5.0)
    assert find_decimation(square) == 1


def test_a_plant_without_air_is_asked_of_nothing_pneumatic() -> None:
    evidence = _base(pair()).evidence
    direct = replace(evidence, nominal=PlantSettings(actuator="direct")).select_blocks({MECHANICS})
    asked = {s.number for s in list_suspects(direct)}
    assert "rest_length_m" not in asked
    assert "atmospheric_pressure_pa" not in asked
    assert "mass_kg" in asked
    assert PRESSURE not in {b for s in list_suspects(direct) for b in s.blocks}


@pytest.mark.parametrize("wrong", ["area", "force", "nothing"])
def test_a_piston_that_is_known_with_the_wrong_sign_is_told_from_an_inverted_load_cell(
    wrong: str,
) -> None:
    def press(record: Record, bar: float) -> Record:
        pressed_pa = 1e5 * bar + np.random.default_rng(3).normal(0.0, 200.0, len(record))
        true_n = record["force_n"] + 5e-4 * pressed_pa
        force_n = -true_n if wrong == "force" else true_n
        return replace(record, force_n=force_n, pressure_pa=101.3e3 + pressed_pa)

    plant = PlantSettings.model_validate(
        {
            "actuator": "direct",
            "parameters": {
                "mass_kg": 0.3,
                "damping_n_s_per_m": 200.0,
                "stiffness_n_per_m": 0.0,
            },
            "effects": {
                "piston": {"area_m2": 5e-4 if wrong == "area" else -5e-4},
                "coulomb_friction": {"force_n": 5.0},
            },
            "known": ["piston.area_m2"],
        }
    )
    train, holdout = (
        [press(imposed_motion(seed), bar) for seed, bar in part]
        for part in (((1, 1.0), (2, 4.0)), ((3, 2.0),))
    )
    found = diagnose(train, holdout, plant)
    said = {"area": ["piston.area_m2"], "force": ["force_n"], "nothing": []}[wrong]
    assert [f.number for f in found.setup] == said
    assert found.plant.effects.model_dump()["piston"]["area_m2"] == -5e-4
    assert found.verdict is Verdict.MISCALIBRATED
