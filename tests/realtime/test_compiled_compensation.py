"""A run that undoes known effects gives the same rows in machine code as in plain Python."""

from __future__ import annotations

import math
import sys
from itertools import chain

import pytest
from support.runs import MemoryJournal, ScriptedSupervisor, parts, run_settings

from pamctl.compensation.around_the_law import CELLS, Compensation, list_wanted_v
from pamctl.compiled_ahead.layout import LONGEST_TABLE, Block, NotFlat
from pamctl.processes.machine_code import builder_main, libraries
from pamctl.realtime.cued_helm import CuedHelm
from pamctl.realtime.loop import ControlLoop
from pamctl.realtime.tick_path import PlainTick, load_compiled_tick
from pamctl.recording.ring import tick_struct
from pamctl.settings.build import build_program, build_tick_setup, nominal_zero_of
from pamctl.signals import Truth, list_tick_fields

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
    path = libraries.find_tick_library(SETUP)
    if not path.exists():
        builder_main.build_tick_library(SETUP, path)
    tick = load_compiled_tick(path, SETUP)
    plain, compiled = run_with(PlainTick()), run_with(tick)
    assert len(plain.ticks) > 1000
    packing = tick_struct(list_tick_fields(compensates=True))
    rows = [[packing.pack(*chain(*record)) for record in run.ticks] for run in (plain, compiled)]
    assert rows[0] == rows[1]
    assert repr(plain.keyframes) == repr(compiled.keyframes)
    assert math.isfinite(tick.state.compensated.corrected_position_m)
    assert not tick.fits(SETUP._replace(compensation=None))


def test_a_tuple_is_kept_number_by_number_up_to_a_length() -> None:
    table = tuple(float(i) for i in range(CELLS + 1))
    block = Block(table, 2)
    buffer = bytearray(8 * block.end)
    block.write(buffer, table)
    assert block.read(buffer) == table
    with pytest.raises(NotFlat):
        Block((0.0,) * (LONGEST_TABLE + 1), 0)
