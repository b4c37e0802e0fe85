"""Many ticks at once are the loop's ticks: the same rows, frozen states and events, to the bit."""

from __future__ import annotations

from typing import Any

import pytest
from support.runs import (
    MemoryJournal,
    ScriptedSupervisor,
    pack_row,
    parts,
    run_settings,
    unpack_row,
)

from hal.faulty import FaultSettings
from pamctl.exit_codes import Ending
from pamctl.kernel.calls import NativeCall, PlainCall
from pamctl.offline.many_ticks import find_many_ticks
from pamctl.realtime.loop import ControlLoop
from pamctl.realtime.program import CuedHelm
from pamctl.realtime.tick_runner import TickRunner
from pamctl.recording.rows import ROW_BYTES
from pamctl.settings.build import build_program, build_tick_setup, nominal_zero_of
from pamctl.settings.resolve import RunSettings
from pamctl.signals import Truth

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
def test_a_run_with_leaps_leaves_what_a_run_without_leaves(case: str) -> None:
    assert_equal(run_both(run_settings(*CASES[case])))


def test_a_rig_with_faults_is_left_to_the_loop() -> None:
    settings = run_settings(*SHORT)
    made = parts(settings)
    assert find_many_ticks(build_tick_setup(settings), made.whole, made.clock) is None
