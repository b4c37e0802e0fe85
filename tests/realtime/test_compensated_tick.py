"""A run that undoes known effects gives the same rows in machine code as in plain Python."""

from __future__ import annotations

import math
import sys

import pytest
from support.runs import MemoryJournal, ScriptedSupervisor, pack_row, parts, run_settings

from pamctl.compensation.around_the_law import Compensation, list_wanted_v
from pamctl.kernel.calls import NativeCall, PlainCall
from pamctl.realtime.cued_helm import CuedHelm
from pamctl.realtime.loop import ControlLoop
from pamctl.realtime.tick_runner import TickRunner
from pamctl.settings.build import build_program, build_tick_setup, nominal_zero_of
from pamctl.signals import Truth

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the real-time loop needs Linux")

SETTINGS = run_settings(
    "experiment.approach_s=0.6",
    "experiment.settle_s=0.2",
    "experiment.transition_s=0.7",
    "experiment.cycles=1",
    "rig.homing.enabled=false",
)
REACH_V = 5.0
SETUP = build_tick_setup(SETTINGS)._replace(
    compensation=Compensation(
        1.02,
        1e-5,
        0.98,
        -300.0,
        REACH_V,
        tuple(0.25 + 0.9 * v for v in list_wanted_v(REACH_V)),
        tuple(-0.2 - 0.9 * v for v in list_wanted_v(REACH_V)),
    )
)


def run_with(tick: object) -> MemoryJournal:
    made, journal, program = parts(SETTINGS), MemoryJournal(), build_program(SETTINGS)
    ControlLoop(
        rig=made.whole,
        clock=made.clock,
        setup=SETUP,
        nominal_zero=nominal_zero_of(SETTINGS),
        program=program,
        journal=journal,
        supervisor=ScriptedSupervisor(),
        truth=lambda: Truth(0.0, 0.0),
        helm=CuedHelm(SETUP, SETTINGS.controller.model_dump(mode="json"), program, journal),
        tick=tick,
    ).run()
    return journal


def test_a_compensated_run_has_the_same_rows_and_frozen_states() -> None:
    tick = TickRunner(SETUP, NativeCall)
    plain, compiled = run_with(TickRunner(SETUP, PlainCall)), run_with(tick)
    assert len(plain.ticks) > 1000
    rows = [[*map(pack_row, run.ticks)] for run in (plain, compiled)]
    assert rows[0] == rows[1]
    assert repr(plain.keyframes) == repr(compiled.keyframes)
    assert math.isfinite(tick.state.compensated.corrected_position_m)
