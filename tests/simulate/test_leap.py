"""Many ticks at once are the loop's ticks: the same rows, frozen states and events, to the bit.

The source that is compiled runs here in plain Python, with its words and rows; machine code of it
takes a minute to build, so it is compared where a run has built it before.
"""

from __future__ import annotations

import math
import random
from itertools import chain
from typing import Any

import pytest
from support.plain_library import PlainLibrary
from support.runs import MemoryJournal, ScriptedSupervisor, parts, run_settings, unpack_row

from hal.faulty import FaultSettings
from pamctl.compiled_ahead.library import KernelLibrary
from pamctl.exit_codes import Ending
from pamctl.processes.machine_code import libraries
from pamctl.realtime.cued_helm import CuedHelm
from pamctl.realtime.loop import ControlLoop
from pamctl.realtime.tick_path import CompiledTick, PlainTick
from pamctl.realtime.whole_tick import run_whole_tick
from pamctl.recording.ring import ROW_BYTES, tick_struct
from pamctl.settings.build import build_program, build_tick_setup, nominal_zero_of
from pamctl.settings.resolve import RunSettings
from pamctl.signals import Truth, list_tick_fields
from pamctl.simulate.leap import (
    GaussState,
    Leap,
    LeapWords,
    draw_deviate,
    may_leap,
    run_simulated_tick,
)

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


def run_both(settings: RunSettings, *faults: FaultSettings, compiled: bool = False) -> Any:
    """Return how a run ends and what it leaves, tick by tick and with leaps."""
    outcome: list[tuple[Ending, RowsInMemory]] = []
    for leaps in (False, True):
        made, journal, setup = parts(settings, faults), RowsInMemory(), build_tick_setup(settings)
        program, tick, many = build_program(settings), PlainTick(), None
        rig = made.whole if faults else made.rig
        if leaps and compiled:
            tick, many = libraries.load_leap(setup, rig, made.clock)
        elif leaps:
            words = LeapWords(setup, made.rig)
            one = PlainLibrary(*words.write_glue(), run_whole_tick)
            tick = CompiledTick(one, words, setup)
            all_of_them = PlainLibrary(*words.write_leap(), run_simulated_tick)
            many = Leap(all_of_them, words, made.rig, made.clock)
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
    compensates = bool(journal.ticks[0].compensation)
    packing = tick_struct(list_tick_fields(compensates))
    return [packing.pack(*chain(*record)) for record in journal.ticks]


CASES = {
    "homing, tracking and stop": SHORT,
    "a late output": (*SHORT, "rig.homing.enabled=false", "rig.sim.output_delay_ticks=1"),
    "a plant with effects": (
        *SHORT,
        "rig.homing.enabled=false",
        "plant.effects.valve_spool.time_constant_s=0.002",
        "plant.effects.pressure_sensor_lag.time_constant_s=0.003",
        "plant.effects.stribeck.rise=0.3",
    ),
    "a compensated valve": (
        *SHORT,
        "rig.homing.enabled=false",
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
def test_a_run_with_leaps_leaves_what_a_run_without_leaves(case: str) -> None:
    assert_equal(run_both(run_settings(*CASES[case])))


def test_machine_code_leaves_the_same() -> None:
    settings = run_settings(*SHORT)
    rig = parts(settings).rig
    setup = build_tick_setup(settings)
    needed = [libraries.find_leap_library(setup, rig), libraries.find_tick_library(setup)]
    if not all(path.exists() for path in needed):
        pytest.skip("no run has built the machine code yet: `pamctl run --fast` does")
    KernelLibrary(needed[0])
    assert_equal(run_both(settings, compiled=True))


def test_the_noise_is_that_of_pythons_generator() -> None:
    theirs, ours = random.Random(7), random.Random(7)
    uniforms = [ours.random() for _ in range(1000)]
    noise = GaussState(math.nan, 0)
    for _ in range(999):
        deviate, noise = draw_deviate(noise, uniforms)
        assert deviate == theirs.gauss(0.0, 1.0)
    assert noise.next_deviate == theirs.gauss_next


def test_a_plant_with_commands_on_their_way_is_left_to_the_loop() -> None:
    settings = run_settings("plant.effects.command_delay.delay_s=0.0015")
    assert not may_leap(parts(settings).rig)
    tick, many = libraries.load_leap(
        build_tick_setup(settings), parts(settings).rig, parts(settings).clock
    )
    assert many is None
    assert isinstance(tick, PlainTick | CompiledTick)
