"""Runs in memory, shared by the tests of the loop and of what it is made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, NamedTuple

from hal.backend import Plant
from hal.faulty import FaultSettings, FaultyRig
from hal.sim import SimRig, sensor_chain
from pamctl.base.errors import Ending
from pamctl.kernel.calls import PlainCall, prepare
from pamctl.kernel.layout import Block
from pamctl.plant.model import plant_parameters
from pamctl.plant.simulated import SimulatedPlant
from pamctl.realtime.clock import VirtualClock
from pamctl.realtime.loop import ControlLoop
from pamctl.realtime.program import CuedHelm
from pamctl.realtime.tick_runner import TickRunner
from pamctl.recording.rows import (
    COMPENSATED_TICK,
    PLAIN_TICK,
    ROW_BYTES,
    ROW_HEADER,
    RowKind,
    TickRow,
    make_rows,
    tick_struct,
)
from pamctl.settings.build import build_program, build_tick_setup, nominal_zero_of
from pamctl.settings.resolve import RunSettings, resolve
from pamctl.signals import Phase, TickRecord, Truth, list_tick_fields

MS = 1_000_000
COUNT_M = 25.4e-3 / 8000.0
AO_STEP_V = 20.0 / 65536.0


def run_settings(*overrides: str, **choices: Any) -> RunSettings:
    """Return the settings of a simulated run without a clock, under the paper's own gains."""
    return resolve(
        **{"controller": "paper-table3-qsmc", "fast": True, **choices}, overrides=overrides
    )


@cache
def row_layout(compensates: bool) -> Block[TickRow]:
    """Return where the numbers of a row are: found once, as that takes a millisecond."""
    return make_rows(compensates, 1).block


PLAIN_SIZE, COMPENSATED_SIZE = (
    tick_struct(list_tick_fields(compensates)).size for compensates in (False, True)
)


def unpack_row(row: bytes | bytearray) -> TickRecord:
    """Return the record in a row of the ring."""
    kind, size, tick, t_ns = ROW_HEADER.unpack_from(row)
    assert (kind, size) in ((RowKind.TICK, PLAIN_SIZE), (RowKind.TICK, COMPENSATED_SIZE))
    record = row_layout(size == COMPENSATED_SIZE).read(row).record
    assert (tick, t_ns) == (record.timing.tick, record.raw.encoder_t_ns)
    return record


def pack_row(record: TickRecord) -> bytearray:
    """Return the row of the ring with a record."""
    compensates = record.compensation is not None
    kind = COMPENSATED_TICK if compensates else PLAIN_TICK
    row = bytearray(ROW_BYTES)
    value = TickRow(kind, record.timing.tick, record.raw.encoder_t_ns, record)
    row_layout(compensates).write(row, value)
    return row


@dataclass
class MemoryJournal:
    """Keeps everything, and loses nothing."""

    ticks: list[TickRecord] = field(default_factory=list)
    events: list[tuple[int, Mapping[str, object]]] = field(default_factory=list)
    keyframes: list[tuple[int, Sequence[float]]] = field(default_factory=list)

    def put_row(self, row: bytearray, late_s: float, missed: int) -> None:
        record = unpack_row(row)
        assert (record.timing.late_s, record.timing.missed) == (late_s, missed)
        self.ticks.append(record)

    def rehearse_row(self, row: bytearray) -> None:
        pass

    def put_event(self, tick: int, t_ns: int, event: Mapping[str, object]) -> None:
        self.events.append((tick, event))

    def put_keyframe(self, tick: int, t_ns: int, state: Sequence[float]) -> None:
        self.keyframes.append((tick, state))

    def end_ticks(self) -> None:
        pass

    def named(self, name: str) -> list[Mapping[str, object]]:
        """Return the events of one name."""
        return [event for _, event in self.events if event["event"] == name]

    def phase(self, phase: Phase) -> list[TickRecord]:
        """Return the ticks of one phase."""
        return [record for record in self.ticks if record.reference.phase == phase]


@dataclass
class ScriptedSupervisor:
    """Wants what the test wants, from given ticks on; None is never."""

    ending: Ending | None = None
    stop_at: int | None = None
    abort_at: int | None = None
    tick: int = -1

    def wants_abort(self) -> bool:
        self.tick += 1  # asked once in every tick
        return self.abort_at is not None and self.tick >= self.abort_at

    def find_stop(self, tick: int) -> Ending | None:
        return self.ending if self.stop_at is not None and tick >= self.stop_at else None


class Run(NamedTuple):
    """A run that is over, and all that it left behind."""

    ending: Ending
    journal: MemoryJournal
    rig: SimRig
    plant: Plant


class Faulted(NamedTuple):
    """The parts of a run that has not begun: a rig inside its faults."""

    rig: SimRig
    whole: FaultyRig
    plant: Plant
    clock: VirtualClock


def parts(
    settings: RunSettings,
    faults: Sequence[FaultSettings] = (),
    missed: Mapping[int, int] | None = None,
    plant: Plant | None = None,
) -> Faulted:
    """Build the simulated rig of a run, so that a test can look behind its wires."""
    clock = VirtualClock(MS, missed)
    plant = plant or SimulatedPlant(plant_parameters(settings.plant), prepare=prepare)
    sim = settings.rig.sim  # type: ignore[union-attr]
    rig = SimRig(
        plant,
        sensor_chain(sim, settings.rig.calibration),
        safe_output_v=settings.rig.safe_volts,
        now_ns=clock.now_ns,
        output_delay_ticks=sim.output_delay_ticks,
        seed=settings.seed,
    )
    return Faulted(rig, FaultyRig(rig, faults), plant, clock)


def steered(settings: RunSettings, journal: MemoryJournal) -> dict[str, Any]:
    """Return the parts of a loop that steer it, and the journal that they write into."""
    setup, program = build_tick_setup(settings), build_program(settings)
    gains = settings.controller.model_dump(mode="json")
    return {
        "setup": setup,
        "nominal_zero": nominal_zero_of(settings),
        "program": program,
        "helm": CuedHelm(setup, gains, program, journal),
        "journal": journal,
    }


def run(
    settings: RunSettings,
    *faults: FaultSettings,
    missed: Mapping[int, int] | None = None,
    supervisor: ScriptedSupervisor | None = None,
    journal: MemoryJournal | None = None,
    wrap: Callable[[FaultyRig], Any] = lambda rig: rig,
    plant: Plant | None = None,
    plain: bool = False,
) -> Run:
    """Run the loop to its end, on the settings' plant or another one; `plain` in Python."""
    if plain and plant is None:
        plant = SimulatedPlant(plant_parameters(settings.plant))
    made = parts(settings, faults, missed, plant)
    journal = journal or MemoryJournal()
    steering = steered(settings, journal)
    ending = ControlLoop(
        rig=wrap(made.whole),
        clock=made.clock,
        tick=TickRunner(steering["setup"], PlainCall) if plain else None,
        **steering,
        supervisor=supervisor or ScriptedSupervisor(),
        truth=lambda: Truth(made.plant.position_m, made.plant.pressure_pa),
    ).run()
    return Run(ending, journal, made.rig, made.plant)
