"""The simulated loop is the real one: run by run, many ticks at once, and where the rig clamps."""

import struct
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.command_line import run_pamctl
from support.runs import (
    MemoryJournal,
    ScriptedSupervisor,
    pack_row,
    parts,
    run_settings,
    steered,
    unpack_row,
)

from hal.faulty import FaultSettings
from hal.sim import sensor_chain
from pamctl.base.errors import Ending, ExitCode
from pamctl.control.experiment import plan_experiment
from pamctl.kernel.calls import NativeCall, PlainCall
from pamctl.log import read
from pamctl.offline.closed_loop import (
    BatchRow,
    SimulatedRun,
    draw_sensor_noise,
    simulate,
    tabulate_references,
)
from pamctl.plant.model import plant_parameters
from pamctl.processes.backends import build_clock, build_rig
from pamctl.realtime.gain_ramp import fit_law
from pamctl.realtime.loop import ControlLoop
from pamctl.realtime.many_ticks import draw_deviates, find_many_ticks
from pamctl.realtime.program import CuedHelm
from pamctl.realtime.tick_runner import TickRunner
from pamctl.recording.rows import ROW_BYTES
from pamctl.settings.build import build_program, build_tick_setup, nominal_zero_of
from pamctl.settings.resolve import RunSettings, resolve
from pamctl.signals import Phase, Reference, TickRecord, Truth

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
) -> SimulatedRun:
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


def assert_same_to_the_bit(settings: RunSettings) -> tuple[Run, SimulatedRun]:
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
def test_the_batch_equals_the_loop_to_the_bit(folder, law, delay_ticks):
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


def test_the_batch_equals_an_open_loop_run_with_a_lagging_valve(folder):
    real, compiled = assert_same_to_the_bit(
        settled(folder, "qsmc", experiment="square", plant="paper-valve109")
    )
    assert real.ending.code is ExitCode.OK
    assert compiled["true_position_m"].max() > 20e-3
    assert np.isnan(compiled["error_m"]).all()


def test_the_batch_equals_a_run_whose_period_is_not_a_whole_number_of_microseconds(folder):
    assert_same_to_the_bit(settled(folder, "qsmc", "rig.loop.rate_hz=3000", experiment="square"))


def test_the_batch_equals_a_run_that_starts_at_a_voltage_that_the_converter_must_round(folder):
    assert_same_to_the_bit(
        settled(
            folder,
            "pid",
            "rig.safe_volts=5.7001",
            "rig.sim.output_delay_ticks=1",
            "experiment.approach_s=0.3",
        )
    )


def test_a_trip_ends_batch_and_loop_in_the_same_tick(folder):
    real, compiled = assert_same_to_the_bit(
        settled(folder, "qsmc", "rig.limits.tracking_error_mm=0.02")
    )
    assert real.ending.code is ExitCode.SAFETY_TRIP
    assert compiled.tripped_tick == real.ticks[-1].timing.tick > 20
    assert compiled.tripped_s == real.ticks[-1].timing.t_s
    assert compiled["valve_v"][-1] == -5.0


@given(seed=st.integers(0, 2**32), counts=st.lists(st.integers(0, 9), max_size=6))
def test_deviates_are_those_of_the_simulated_rig_one_by_one(seed, counts):
    many, single = Random(seed), Random(seed)
    for n in counts:
        ours, theirs = draw_deviates(many, n), [single.gauss(0.0, 1.0) for _ in range(n)]
        assert ours.tobytes() == struct.pack(f"{n}d", *theirs)
        assert many.getstate() == single.getstate()


# --- many ticks at once --------------------------------------------------------------------------

SHORT = (
    "experiment.approach_s=0.5",
    "experiment.settle_s=0.2",
    "experiment.transition_s=0.5",
    "experiment.cycles=1",
    "rig.loop.stop_ramp_s=0.1",
)


class RowsInMemory(MemoryJournal):
    leaps = 0

    def put_rows(self, rows: memoryview) -> None:
        self.leaps += 1
        for at in range(0, len(rows), ROW_BYTES):
            self.ticks.append(unpack_row(bytes(rows[at : at + ROW_BYTES])))


def run_both(settings: RunSettings, *faults: FaultSettings) -> Any:
    """Return how a run ends and what it leaves: tick by tick in Python, and many at once."""
    outcome: list[tuple[Ending, RowsInMemory]] = []
    for leaps in (False, True):
        made, journal, setup = parts(settings, faults), RowsInMemory(), build_tick_setup(settings)
        program = build_program(settings)
        rig = made.whole if faults else made.rig
        tick, many = TickRunner(setup, PlainCall), None
        if leaps:
            tick, many = TickRunner(setup, NativeCall), find_many_ticks(setup, rig, made.clock)
        plant = made.plant
        ending = ControlLoop(
            rig=rig,
            clock=made.clock,
            setup=setup,
            nominal_zero=nominal_zero_of(settings),
            program=program,
            journal=journal,
            supervisor=ScriptedSupervisor(),
            truth=lambda plant=plant: Truth(plant.state.position_m, plant.state.pressure_pa),
            helm=CuedHelm(setup, settings.controller.model_dump(mode="json"), program, journal),
            tick=tick,
            many=many,
        ).run()
        outcome.append((ending, journal))
    return outcome


def pack(journal: MemoryJournal) -> list[bytes]:
    return [bytes(pack_row(record)) for record in journal.ticks]


CASES = {
    "homing, tracking and stop": SHORT,
    "a late output": (*SHORT, "rig.homing.enabled=false", "rig.sim.output_delay_ticks=1"),
    "a plant with effects, of which one is compensated": (
        *SHORT,
        "rig.homing.enabled=false",
        "plant.effects.valve_spool.time_constant_s=0.002",
        "plant.effects.pressure_sensor_lag.time_constant_s=0.003",
        "plant.effects.stribeck.rise=0.3",
        "plant.effects.command_delay.delay_s=0.0025",
        "plant.effects.valve_deadband.fill_width_v=0.2",
        "plant.effects.valve_deadband.exhaust_width_v=0.1",
        "rig.compensate=[valve_deadband]",
    ),
    "a trip": (*SHORT, "rig.homing.enabled=false", "rig.limits.pressure_pa=200000"),
}


def assert_equal(outcome: Any) -> None:
    (ending, plain), (ending_too, fast) = outcome
    assert ending == ending_too
    assert fast.leaps > 0
    assert pack(plain) == pack(fast)
    assert repr(plain.keyframes) == repr(fast.keyframes)
    assert plain.events == fast.events


@pytest.mark.parametrize("case", CASES)
def test_a_run_with_leaps_leaves_what_a_run_without_leaves(case):
    assert_equal(run_both(run_settings(*CASES[case])))


def test_a_rig_with_faults_is_left_to_the_loop():
    settings = run_settings(*SHORT)
    made = parts(settings)
    assert find_many_ticks(build_tick_setup(settings), made.whole, made.clock) is None


CLAMP_V = 0.1
SET = [f"rig.limits.command_v={CLAMP_V}", "controller.command_limit_v=5"]


@pytest.mark.long
def test_the_integral_stops_at_the_clamp_of_the_rig(tmp_path):
    log = tmp_path / "run.mcap"
    words = ["--set", "rig.homing.enabled=false"]  # its fills need more than the clamp
    for change in SET:
        words += ["--set", change]
    done = run_pamctl("run", "--fast", "--controller", "pid", "--duration", 6, *words, "--log", log)
    assert done.returncode == 0, done.stderr
    run = read(log)
    by_law = np.isnan(run["reference_valve_v"])
    commands, saturated = run["command_v"][by_law], run["saturated"][by_law]
    assert np.abs(commands).max() == CLAMP_V
    assert saturated.any()
    assert np.abs(run["robust_v"][by_law]).max() < CLAMP_V  # the integral's share


@pytest.mark.parametrize("law", ["pid", "qsmc", "smc"])
def test_gains_that_are_changed_keep_to_the_clamp_of_the_rig(law):
    clamped = resolve(controller=law, overrides=SET)
    setup = build_tick_setup(clamped)
    as_low = resolve(controller=law, overrides=[SET[0], f"controller.command_limit_v={CLAMP_V}"])
    assert setup.gains == build_tick_setup(as_low).gains
    assert fit_law(setup, clamped.controller).gains == setup.gains


def test_a_law_with_a_limit_below_the_clamp_keeps_its_own():
    low = resolve(overrides=["rig.limits.command_v=2", "controller.command_limit_v=1"])
    assert build_tick_setup(low).gains.sliding.limit_v == 1.0
