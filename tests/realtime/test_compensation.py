"""Known effects undone around the law: the inverse, its limits, the log, the replay."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.runs import run, run_settings
from typer.testing import CliRunner

from hal.calibration import Zero
from pamctl.base.errors import ConfigError
from pamctl.cli.app import app
from pamctl.control.around_the_law import Compensation, compensate_command, find_command_v
from pamctl.control.course import make_valve_reference
from pamctl.log.reader import read
from pamctl.plant.catalogue import Effects, pass_command, pass_opening
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.parameters import vented_state
from pamctl.realtime.tick import first_state, freeze_state, keyframe_fields
from pamctl.settings import known_effects
from pamctl.settings.build import build_tick_setup
from pamctl.settings.known_effects import STEEPEST, build_compensation, list_undoable
from pamctl.settings.resolve import RunSettings, resolve
from pamctl.signals import COMPENSATION_FIELDS, TICK_FIELDS, Command, Phase, Reference

VALVES: dict[str, dict[str, dict[str, float]]] = {
    "dead band": {"valve_deadband": {"fill_width_v": 0.25, "exhaust_width_v": 0.15}},
    "asymmetry": {"valve_asymmetry": {"exhaust_gain": 0.8}},
    "quadratic": {"valve_curve": {"curvature_per_v": 0.05}},
    "bent down": {"valve_curve": {"curvature_per_v": -0.05}},
    "power": {"valve_curve": {"exponent": 1.2}},
    "several": {
        "valve_deadband": {"fill_width_v": 0.1, "exhaust_width_v": 0.2},
        "valve_curve": {"curvature_per_v": 0.03},
        "valve_asymmetry": {"exhaust_gain": 1.2},
    },
}


def compensation_of(effects: dict[str, Any], **rig: Any) -> Compensation:
    base = resolve(plant="paper")
    made = build_compensation(
        PlantSettings.model_validate({"effects": effects}),
        base.rig.model_copy(update={"compensate": tuple(effects), **rig}),
        base.controller,
    )
    assert made is not None
    return made


def opening_v(effects: Effects, memory: Any, command_v: float) -> float:
    """Pass a command through the plant's own valve."""
    passed: float = pass_opening(
        effects.valve, memory, pass_command(effects.valve, memory, command_v, 0.0), 0.0
    )
    return passed


@pytest.mark.parametrize("valve", VALVES)
def test_a_compensated_valve_opens_as_an_ideal_one(valve):
    parameters = plant_parameters(PlantSettings.model_validate({"effects": VALVES[valve]}))
    memory = vented_state(parameters).valve.memory
    table = compensation_of(VALVES[valve])
    # Beyond the stretch at null that the slope limits, and before the command's own limit.
    for wanted_v in np.concatenate([np.linspace(-3.5, -0.3, 40), np.linspace(0.3, 3.5, 40)]):
        command_v = find_command_v(table, float(wanted_v))
        opened = opening_v(parameters.effects, memory, command_v)
        assert opened == pytest.approx(wanted_v, abs=6e-3), wanted_v


def test_the_inverse_of_a_dead_band_is_its_width_added_and_steep_only_at_null():
    table = compensation_of(VALVES["dead band"])
    assert find_command_v(table, 1.0) == pytest.approx(1.25, abs=1e-9)
    assert find_command_v(table, -1.0) == pytest.approx(-1.15, abs=1e-9)
    # On the line of the steepest slope from null, until it meets the inverse.
    assert find_command_v(table, 0.05) == pytest.approx(0.15, abs=5e-3)
    assert find_command_v(table, 0.0) == 0.0


TABLES = {name: compensation_of(effects) for name, effects in VALVES.items()}


@given(st.sampled_from(sorted(VALVES)), st.floats(-12.0, 12.0), st.floats(-12.0, 12.0))
def test_the_command_is_bounded_continuous_and_never_falls(valve, one_v, other_v):
    table = TABLES[valve]
    low_v, high_v = sorted((one_v, other_v))
    low, high = find_command_v(table, low_v), find_command_v(table, high_v)
    assert -5.0 <= low <= high <= 5.0
    assert high - low <= STEEPEST * (high_v - low_v) + 1e-9


def test_what_is_not_a_number_and_what_is_open_loop_pass_unchanged():
    table = compensation_of(VALVES["dead band"])
    tracking = Reference(int(Phase.TRACK), 0.0, 0.0, 0.0, 0.0, np.nan)
    lost = Command(np.nan, 0.0, 0.0, 0.0, False)
    assert compensate_command(table, tracking, lost) is lost
    wanted = Command(0.5, 0.0, 0.0, 0.0, False)
    assert compensate_command(table, make_valve_reference(Phase.OPEN_LOOP, 0.5), wanted) is wanted
    assert compensate_command(None, tracking, wanted) is wanted


def test_sensors_are_corrected_by_a_line():
    effects = {
        "encoder_scale": {"scale": 1.02},
        "pressure_sensor_gain": {"gain": 0.95},
        "pressure_sensor_offset": {"offset_pa": 4e3},
    }
    homing = resolve().rig.homing
    made = compensation_of(effects, homing=homing.model_copy(update={"enabled": False}))
    assert made.position_scale == pytest.approx(1.0 / 1.02)
    assert made.position_offset_m == pytest.approx(0.0, abs=1e-15)
    shown_pa = 101.3e3 + 0.95 * 2e5 + 4e3
    assert made.pressure_scale * shown_pa + made.pressure_offset_pa == pytest.approx(301.3e3)
    # Homing takes the zero at the vented muscle: no offset is left to be undone.
    homed = compensation_of(effects)
    assert homed.pressure_scale * 101.3e3 + homed.pressure_offset_pa == pytest.approx(101.3e3)


@pytest.mark.parametrize(
    ("names", "plant", "said"),
    [
        (("valve_deadbnd",), {}, "did you mean valve_deadband?"),
        (("stribeck",), {}, "stribeck cannot be undone within a tick"),
        (("valve_hysteresis",), {}, "valve_hysteresis cannot be undone within a tick"),
        (("valve_deadband",), {}, "the plant file does not have valve_deadband"),
        (("valve_curve",), {"valve_curve": {"curvature_per_v": -0.15, "exponent": 0.5}}, ""),
    ],
)
def test_what_cannot_be_undone_is_refused_with_the_reason(names, plant, said):
    base = resolve()
    rig = base.rig.model_copy(update={"compensate": names})
    given = PlantSettings.model_validate({"effects": plant})
    if not said:  # the largest area is held: nothing to refuse
        assert build_compensation(given, rig, base.controller) is not None
        return
    with pytest.raises(ValueError, match=said.replace("?", r"\?")):
        build_compensation(given, rig, base.controller)
    with pytest.raises(ConfigError):
        resolve(overrides=[f"rig.compensate={list(names)}"])


def test_a_valve_that_closes_again_at_a_larger_command_has_no_inverse(monkeypatch):
    def turn_back(_: Any, names: Any, wanted_v: float) -> float:
        """An effect of a user's own: 0.1 V less for each volt beyond 2."""
        return math.copysign(min(abs(wanted_v), 2.2 - 0.1 * abs(wanted_v)), wanted_v)

    monkeypatch.setattr(known_effects, "undo_valve_v", turn_back)
    with pytest.raises(ValueError, match="so the valve's map has no inverse"):
        compensation_of(VALVES["dead band"])


def test_all_static_effects_of_valve_and_sensors_can_be_undone():
    assert set(list_undoable()) >= {
        "valve_deadband", "valve_asymmetry", "valve_curve", "valve_saturation",
        "encoder_scale", "pressure_sensor_gain", "pressure_sensor_offset",
    }  # fmt: skip


# --- runs ---------------------------------------------------------------------------------------

SHORT = (
    "experiment.transition_s=0.8",
    "experiment.approach_s=0.8",
    "experiment.cycles=1",
    "rig.homing.steady_s=0.05",
    "rig.homing.fills=1",
)


def settings_with(folder: Path, *overrides: str, **choices: Any) -> RunSettings:
    plant = folder / "plant.yaml"
    plant.write_text(
        "effects:\n"
        "  valve_deadband: {fill_width_v: 0.25, exhaust_width_v: 0.2}\n"
        "  encoder_scale: {scale: 1.02}\n"
    )
    return run_settings(*SHORT, *overrides, controller="qsmc", plant=str(plant), **choices)


COMPENSATE = "rig.compensate=[valve_deadband, encoder_scale]"


def true_rms_um(settings: RunSettings) -> float:
    tracked = run(settings).journal.phase(Phase.TRACK)
    # What this plant tells of itself is turned by the scale of its encoder.
    errors = [r.truth.true_position_m / 1.02 - r.reference.reference_m for r in tracked]
    return float(np.sqrt(np.mean(np.square(errors)))) * 1e6


@pytest.mark.long
def test_a_compensated_run_tracks_the_truth_better(tmp_path):
    without = true_rms_um(settings_with(tmp_path))
    with_both = true_rms_um(settings_with(tmp_path, COMPENSATE))
    assert with_both < 0.2 * without  # 2 % of 12 mm are gone


def test_a_run_without_compensation_has_the_columns_and_keyframes_of_before(tmp_path):
    done = run(settings_with(tmp_path))
    assert all(record.compensation is None for record in done.journal.ticks)
    setup = build_tick_setup(settings_with(tmp_path))
    state = first_state(setup, Zero(0.2, 0.0))
    assert state.compensated is None
    assert not [name for name in keyframe_fields(state) if "compensated" in name]
    assert len(freeze_state(state)) == len(keyframe_fields(state))


@pytest.mark.long
def test_a_compensated_run_is_logged_checked_and_replayed_to_the_bit(tmp_path):
    settings_with(tmp_path)
    log = tmp_path / "run.mcap"
    settings = ["--set", COMPENSATE, *(part for o in SHORT for part in ("--set", o))]
    arguments = ["run", "--fast", "--quiet", "--plant", str(tmp_path / "plant.yaml"), *settings]
    assert CliRunner().invoke(app, [*arguments, "--log", str(log)]).exit_code == 0
    columns = read(log).columns
    assert list(columns) == [field.name for field in (*TICK_FIELDS, *COMPENSATION_FIELDS)]
    closed = np.isnan(columns["reference_valve_v"])
    shift_v = np.abs(columns["compensated_v"] - columns["command_v"])
    assert shift_v[closed].max() == pytest.approx(0.25, abs=1e-6)
    assert not shift_v[~closed].any()
    np.testing.assert_allclose(columns["corrected_position_m"] * 1.02, columns["position_m"])
    for verb in (["log", "check", str(log)], ["replay", str(log)]):
        done = CliRunner().invoke(app, verb)
        assert done.exit_code == 0, done.output
