"""The excitation for diagnosis: within the valve's range, repeatable, and rich enough."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError
from support.runs import run_settings

from pamctl.control.experiment import ProgramSettings, plan_experiment
from pamctl.offline.closed_loop import tabulate_references
from pamctl.settings.config_files import config_dir
from pamctl.signals import Phase, Reference


def shipped_command(*overrides: str) -> np.ndarray:
    settings = run_settings(*overrides, experiment="diagnosis").experiment
    table = tabulate_references(plan_experiment(settings).segments, 1e-3)
    assert set(table[:, Reference._fields.index("phase")]) == {Phase.OPEN_LOOP}
    return table[:, Reference._fields.index("reference_valve_v")]


def test_the_shipped_program_starts_vented_and_stays_within_the_valves_range() -> None:
    command = shipped_command()
    assert (command[:1000] == -5.0).all()
    assert np.abs(command).max() == 5.0
    assert 55_000 < len(command) < 65_000


def test_another_seed_changes_the_multisines_and_nothing_else() -> None:
    one, other = shipped_command(), shipped_command("experiment.seed=2")
    same = one == other
    assert len(one) == len(other)
    assert 18_000 * 0.99 < np.count_nonzero(~same) <= 18_000
    assert (shipped_command() == one).all()


def test_it_has_small_commands_about_null_and_power_up_to_100_hz() -> None:
    command = shipped_command()
    assert {0.1, -0.1, 0.3, -0.3} <= set(np.round(command, 9))
    power = np.abs(np.fft.rfft(command)) ** 2
    hertz = np.fft.rfftfreq(len(command), 1e-3)
    assert power[(hertz > 50) & (hertz < 100)].mean() > 10 * power[hertz > 300].mean()


def test_the_shipped_file_says_how_long_it_takes() -> None:
    lasts_s = sum(
        one.duration_s
        for one in plan_experiment(run_settings(experiment="diagnosis").experiment).segments
    )
    said = (config_dir() / "experiment" / "diagnosis.yaml").read_text()
    assert f"`pamctl diagnose`: {lasts_s:.0f} s," in said


def test_a_multisine_peaks_at_its_amplitude_about_its_bias() -> None:
    part = {"wave": "multisine", "low_hz": 1, "high_hz": 20, "amplitude_v": 2, "duration_s": 5}
    program = ProgramSettings(kind="program", parts=[{**part, "bias_v": 0.5}])
    wave = np.array([held.valve_v for held in plan_experiment(program).segments])
    assert np.abs(wave - 0.5).max() == pytest.approx(2.0)
    assert len(wave) == 5000


def test_a_chirp_ends_at_its_high_frequency() -> None:
    part = {"wave": "chirp", "low_hz": 2, "high_hz": 50, "amplitude_v": 3, "duration_s": 10}
    wave = np.array(
        [h.valve_v for h in plan_experiment(ProgramSettings(kind="program", parts=[part])).segments]
    )
    turns = np.count_nonzero(np.diff(np.sign(wave[-1000:])) != 0)
    assert 2 * 40 < turns < 2 * 50  # from 36 Hz to 50 Hz within the last second


def test_a_falling_chirp_is_refused() -> None:
    part = {"wave": "chirp", "low_hz": 50, "high_hz": 2, "amplitude_v": 3, "duration_s": 1}
    with pytest.raises(ValidationError, match="must lie below"):
        ProgramSettings(kind="program", parts=[part])
