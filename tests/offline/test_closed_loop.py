"""The compiled closed loop and the real one: the same numbers, tick by tick.

The real one is `pamctl.realtime.loop.control` as a run has it, with a virtual clock, the
simulated rig and a journal in memory; the batch is what tuning and diagnosis run on.
"""

from __future__ import annotations

import struct
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.runs import MemoryJournal, ScriptedSupervisor, steered

from hal.sim import sensor_chain
from pamctl.control.experiment import plan_experiment
from pamctl.exit_codes import Ending, ExitCode
from pamctl.offline.closed_loop import (
    BatchRow,
    BatchRun,
    draw_sensor_noise,
    simulate,
    tabulate_references,
)
from pamctl.offline.many_ticks import draw_deviates
from pamctl.plant.model import plant_parameters
from pamctl.processes.backends import build_clock, build_rig
from pamctl.realtime.loop import ControlLoop
from pamctl.settings.build import build_tick_setup
from pamctl.settings.resolve import RunSettings, resolve
from pamctl.signals import Phase, Reference, TickRecord

TRACKING = """
    kind: tracking
    transition_s: 1.0
    rest_s: 0.3
    cycles: 1
    approach_s: 0.8
    settle_s: 0.2
"""
SQUARE = """
    kind: square
    frequency_hz: 2
    cycles: 2
"""
# The batch begins with the experiment; the sensor's zero from homing is the true one here.
BEGIN_AT_ONCE = ("rig.homing.enabled=false", "rig.calibration.sensor_zero_v=0.215")


class Run(NamedTuple):
    settings: RunSettings
    ending: Ending
    ticks: list[TickRecord]
    """The ticks of the experiment; the batch has no smooth stop after it."""

    def column(self, name: str) -> NDArray[np.float64]:
        stages = [stage for stage in TickRecord._fields if hasattr(self.ticks[0], stage)]
        stage = next(s for s in stages if name in getattr(self.ticks[0], s)._fields)
        return np.array([getattr(getattr(tick, stage), name) for tick in self.ticks], float)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("settings")
    (folder / "tracking.yaml").write_text(TRACKING)
    (folder / "square.yaml").write_text(SQUARE)
    return folder


def settled(
    folder: Path, law: str, *overrides: str, experiment: str = "tracking", plant: str = "paper"
) -> RunSettings:
    return resolve(
        controller=law,
        experiment=str(folder / f"{experiment}.yaml"),
        plant=plant,
        overrides=[*BEGIN_AT_ONCE, *overrides],
        seed=7,
        fast=True,
    )


def real_loop(settings: RunSettings) -> Run:
    clock = build_clock(settings, may_spin=False)
    parts = build_rig(settings, clock)
    journal = MemoryJournal()
    ending = ControlLoop(
        rig=parts.rig,
        clock=clock,
        **steered(settings, journal),
        supervisor=ScriptedSupervisor(),
        truth=parts.truth,
    ).run()
    ticks = [tick for tick in journal.ticks if tick.reference.phase != Phase.STOPPING]
    return Run(settings, ending, ticks)


def batch(
    settings: RunSettings, asked: NDArray[np.float64], noise: NDArray[np.float64]
) -> BatchRun:
    rig: Any = settings.rig
    return simulate(
        build_tick_setup(settings),
        plant_parameters(settings.plant),
        sensor_chain(rig.sim, rig.calibration),
        asked,
        noise,
        period_s=1.0 / rig.loop.rate_hz,
        output_delay_ticks=rig.sim.output_delay_ticks,
    )


def assert_same_to_the_bit(settings: RunSettings) -> tuple[Run, BatchRun]:
    real = real_loop(settings)
    asked = tabulate_references(
        plan_experiment(settings.experiment).segments, 1.0 / settings.rig.loop.rate_hz
    )
    compiled = batch(settings, asked, draw_sensor_noise(len(asked), settings.seed))
    for name in Reference._fields:
        np.testing.assert_array_equal(compiled[name], real.column(name), err_msg=name)
    for name in BatchRow._fields:
        np.testing.assert_array_equal(compiled[name], real.column(name), err_msg=name)
    return real, compiled


@pytest.mark.parametrize(("law", "delay_ticks"), [("qsmc", 1), ("smc", 0), ("pid", 0)])
def test_the_batch_equals_the_loop_to_the_bit(folder: Path, law: str, delay_ticks: int) -> None:
    real, compiled = assert_same_to_the_bit(
        settled(folder, law, f"rig.sim.output_delay_ticks={delay_ticks}")
    )
    assert real.ending.code is ExitCode.OK
    assert compiled.tripped_tick == -1
    assert len(compiled["position_m"]) == 3600
    # The law worked: the muscle reached both set points, despite the noise.
    assert compiled["true_position_m"].max() == pytest.approx(17.2e-3, abs=0.3e-3)
    assert np.ptp(compiled["command_v"]) > 1.0
    noise_pa = compiled["pressure_pa"] - compiled["true_pressure_pa"]
    assert 200.0 < noise_pa.std() < 400.0


def test_the_batch_equals_an_open_loop_run_with_a_lagging_valve(folder: Path) -> None:
    real, compiled = assert_same_to_the_bit(
        settled(folder, "qsmc", experiment="square", plant="paper-valve109")
    )
    assert real.ending.code is ExitCode.OK
    assert compiled["true_position_m"].max() > 20e-3
    assert np.isnan(compiled["error_m"]).all()


def test_the_batch_equals_a_run_whose_period_is_not_a_whole_number_of_microseconds(
    folder: Path,
) -> None:
    assert_same_to_the_bit(settled(folder, "qsmc", "rig.loop.rate_hz=3000", experiment="square"))


def test_the_batch_equals_a_run_that_starts_at_a_voltage_that_the_converter_must_round(
    folder: Path,
) -> None:
    assert_same_to_the_bit(
        settled(
            folder,
            "pid",
            "rig.safe_volts=5.7001",
            "rig.sim.output_delay_ticks=1",
            "experiment.approach_s=0.3",
        )
    )


def test_a_trip_ends_batch_and_loop_in_the_same_tick(folder: Path) -> None:
    real, compiled = assert_same_to_the_bit(
        settled(folder, "qsmc", "rig.limits.tracking_error_mm=0.02")
    )
    assert real.ending.code is ExitCode.SAFETY_TRIP
    assert compiled.tripped_tick == real.ticks[-1].timing.tick > 20
    assert compiled["valve_v"][-1] == -5.0


def test_the_noise_depends_on_the_seed_and_on_nothing_else() -> None:
    np.testing.assert_array_equal(draw_sensor_noise(100, 3), draw_sensor_noise(200, 3)[:100])
    assert not np.array_equal(draw_sensor_noise(100, 3), draw_sensor_noise(100, 4))


@given(seed=st.integers(0, 2**32), counts=st.lists(st.integers(0, 9), max_size=6))
def test_deviates_are_those_of_the_simulated_rig_one_by_one(seed: int, counts: list[int]) -> None:
    many, single = Random(seed), Random(seed)
    for n in counts:
        ours, theirs = draw_deviates(many, n), [single.gauss(0.0, 1.0) for _ in range(n)]
        assert ours.tobytes() == struct.pack(f"{n}d", *theirs)
        assert many.getstate() == single.getstate()


def test_finer_steps_of_the_plant_move_the_result_by_less_than_a_micrometre(folder: Path) -> None:
    """Without sensor feedback in the way: the loop's quantised encoder would amplify any bit."""
    settings = settled(folder, "qsmc", "rig.sim.sensor_noise_v=0", experiment="square")
    asked = tabulate_references(plan_experiment(settings.experiment).segments, 1e-3)
    still = np.zeros(len(asked))
    rig: Any = settings.rig
    common = (
        build_tick_setup(settings),
        plant_parameters(settings.plant),
        sensor_chain(rig.sim, rig.calibration),
        asked,
        still,
    )
    usual, finer = simulate(*common), simulate(*common, longest_step_s=1e-3 / 64)
    difference_m = np.abs(usual["true_position_m"] - finer["true_position_m"]).max()
    assert 0.0 < difference_m < 1e-6
