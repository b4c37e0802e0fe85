"""Programs to choose from, and the one that answers what two full strokes leave open."""

import math
from itertools import accumulate

import numpy as np
import pytest
from support.made_records import COUNT_M, PERIOD_S, ask_only

from pamctl.control.course import reference_at
from pamctl.control.experiment import plan_experiment
from pamctl.diagnose import Record, diagnose
from pamctl.diagnose.drawn_programs import (
    LONGEST_S,
    SHORTEST_S,
    draw_programs,
    find_rig_limits,
    make_program,
    make_repeated_part,
    read_rig_limits,
    sample_commands,
)
from pamctl.offline.closed_loop import simulate_run
from pamctl.plant.drive import drive_coupled
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.parameters import parameters_of
from pamctl.settings.resolve import resolve, settings_to_data

COUNT = 30


@pytest.mark.parametrize("command_v", [5.0, 2.0])
def test_programs_stay_within_command_and_length_and_begin_alike(command_v):
    begin = make_repeated_part(command_v, command_v)
    drawn = [d.program for d in draw_programs(COUNT, command_v, begin, seed=3)]
    again = [d.program for d in draw_programs(COUNT, command_v, begin, seed=3)]
    assert drawn == again
    assert len({p.model_dump_json() for p in drawn}) == COUNT
    commands = [sample_commands(p, 1e-3) for p in drawn]
    shared = min(map(len, commands))
    assert all(np.max(np.abs(c)) <= command_v for c in commands)
    assert all(SHORTEST_S - 0.1 <= len(c) * 1e-3 <= LONGEST_S + 3.0 for c in commands)
    assert sum(len(c) * 1e-3 <= LONGEST_S + 0.01 for c in commands) > 0.7 * COUNT
    assert all(np.array_equal(c[:3000], commands[0][:3000]) for c in commands if shared > 3000)
    assert all(c[-1] == -command_v for c in commands)


def test_blocks_of_a_pool_are_mixed_anew_within_the_length():
    begin = make_repeated_part(5.0, 5.0)
    pool = [block for d in draw_programs(3, 5.0, begin, seed=3) for block in d.blocks]
    mixed = [*draw_programs(COUNT, 5.0, begin, seed=3, pool=pool)]
    blocks = [block for d in mixed for block in d.blocks]
    assert 0.6 < sum(block in pool for block in blocks) / len(blocks) < 1.0
    assert all(len(sample_commands(d.program, 1e-3)) * 1e-3 <= LONGEST_S + 3.0 for d in mixed)
    assert len({d.program.model_dump_json() for d in mixed}) == COUNT


def test_sampled_commands_are_those_of_the_rigs_course():
    """The course is evaluated as the loop does, tick by tick."""
    for drawn in draw_programs(6, 5.0, make_repeated_part(5.0, 5.0), seed=1):
        program = drawn.program
        segments = plan_experiment(program).segments
        ends = [*accumulate(s.duration_s for s in segments)]
        commands = sample_commands(program, 1e-3)
        at, begin = 0, 0.0
        for tick, command in enumerate(commands):
            t_s = tick * 1e-3
            while t_s >= ends[at] - 1e-9:
                begin, at = ends[at], at + 1
            assert reference_at(segments[at], t_s - begin).reference_valve_v == command


def test_the_limits_are_those_of_the_rig_and_trip_where_the_loop_trips():
    parts = "{wave: hold, valve_v: -5, duration_s: 0.5}, {wave: square, frequency_hz: 2, cycles: 1}"
    strokes = f"experiment.parts=[{parts}]"
    base = ["rig.homing.enabled=false", "rig.sim.sensor_noise_v=0", strokes]
    for limit_pa, trips in ((500e3, False), (300e3, True)):
        changes = [*base, f"rig.limits.pressure_pa={limit_pa}"]
        settings = resolve(experiment="diagnosis", overrides=changes, fast=True)
        limits = read_rig_limits(settings_to_data(settings), "here")
        assert limits.pressure_pa == limit_pa
        commands = sample_commands(settings.experiment, 1e-3)  # type: ignore[arg-type]
        run = drive_coupled(plant_parameters(settings.plant), commands, 1e-3)
        assert limits.allows(run) is not trips
        assert limits.admits(commands, run, 1e-3) is not trips
        assert (simulate_run(settings).tripped_s is not None) is trips


def test_without_settings_the_limits_are_what_the_records_reached():
    t_s = np.arange(10) * 1e-3
    record = Record(
        "r", t_s, np.full(10, -2.0), np.linspace(1e5, 2e5, 10), np.linspace(0, 5e-3, 10)
    )
    limits = find_rig_limits([record])
    assert (limits.command_v, limits.pressure_pa, limits.high_m) == (2.0, 2e5, 5e-3)
    assert limits.safety is None
    assert math.isclose(limits.low_m, 0.0)


@pytest.mark.parametrize("atmosphere_pa", [101.3e3, 78e3])
def test_a_gentle_program_is_admitted_at_any_altitude(atmosphere_pa):
    places = ("rig.calibration", "plant.parameters")
    settings = resolve(overrides=[f"{p}.atmospheric_pressure_pa={atmosphere_pa}" for p in places])
    limits = read_rig_limits(settings_to_data(settings), "these settings")
    commands_v = np.repeat([-5.0, 1.0, 0.0], [200, 100, 200])
    steps_s = np.full(len(commands_v) - 1, 1e-3)
    run = drive_coupled(plant_parameters(settings.plant), commands_v, steps_s)
    assert run.pressure_pa[0] == pytest.approx(atmosphere_pa)
    assert limits.allows(run)
    assert limits.admits(commands_v, run, 1e-3)


OFFSET_V = 0.1


def run(commands_v: np.ndarray, seed: int, experiment: object = None) -> Record:
    """Run a muscle whose valve's null is off, finely stepped."""
    random = np.random.default_rng(seed)
    driven = drive_coupled(
        parameters_of({"null_offset.offset_v": OFFSET_V}), commands_v, PERIOD_S, steps=16
    )
    return Record(
        f"run-{seed}",
        np.arange(len(commands_v)) * PERIOD_S,
        valve_v=commands_v,
        pressure_pa=driven.pressure_pa + random.normal(0.0, 300.0, len(commands_v)),
        position_m=np.floor(driven.position_m / COUNT_M + random.uniform()) * COUNT_M,
        settings={"experiment": experiment} if experiment else {},
    )


def test_full_strokes_leave_the_valve_open_and_the_chosen_program_names_its_null():
    strokes = run(sample_commands(make_program(make_repeated_part(5.0, 5.0)), PERIOD_S), 1)
    asked = ask_only("null_offset", "valve_asymmetry", "valve_deadband", "valve_curve")
    first = diagnose([strokes], [], PlantSettings(), without=asked)
    assert {"null_offset", "valve_asymmetry", "valve_deadband"} <= {*first.explanations}
    chosen = first.deciding
    assert chosen is not None
    assert chosen.promises
    again = run(sample_commands(chosen.program, PERIOD_S), 2, chosen.to_experiment())
    assert again["pressure_pa"].max() <= chosen.pressure_pa + 5e3
    second = diagnose([strokes, again], [], PlantSettings(), without=asked)
    assert second.explanations == ("null_offset",)
    (offset,) = (n for n in second.numbers if n.name == "null_offset.offset_v")
    assert offset.value == pytest.approx(OFFSET_V, rel=0.02)
    judged = {f.refuted: f for f in second.forecasts}
    assert {"valve_deadband", "valve_asymmetry"} <= {*judged}
    assert all(f.is_good for f in judged.values()), judged
