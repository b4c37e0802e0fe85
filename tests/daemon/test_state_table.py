"""The table of states against what a session does, in this process and with processes of its own.

Orders come in any order, and the loop dies at any moment. The state changes only as the table says,
an order that the table does not allow is refused and changes nothing, and every log is whole.
"""

from __future__ import annotations

import json
import os
import random
import signal
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from support.processes.daemons import QUICK, SQUARE, TRACKING, Daemon, daemon

import pamctl
from pamctl.daemon.client import DaemonDeclinedError
from pamctl.daemon.in_process import InProcessLoop, InProcessMaker
from pamctl.daemon.rig_session import RigSession
from pamctl.daemon.session_life import STATES, RigState
from pamctl.log import read
from pamctl.settings.resolve import RunSettings

SHORT = [*QUICK, "rig.homing.enabled=false", "rig.loop.stop_ramp_s=0.05"]
SINE = pamctl.Sine(offset_mm=4, amplitude_mm=0.5, frequency_hz=5, cycles=1, fade_s=0.1)

ORDERS: list[tuple[str, dict[str, object]]] = [
    ("goto", {"position_m": 5e-3, "within_s": 0.3}),
    ("start", {"experiment": SQUARE, "name": "square"}),
    ("start", {"experiment": TRACKING, "name": "tracking"}),
    ("stop", {}),
    ("disarm", {}),
    ("estop", {}),
    ("mark", {"text": "here"}),
    ("set", {"changes": ["controller.lambda_per_s=30"]}),
]


class SimulatedSession(RuleBasedStateMachine):
    """A simulated rig whose state is noted at every tick."""

    @initialize(homes=st.booleans())
    def begin(self, homes: bool) -> None:
        self.folder = tempfile.TemporaryDirectory()
        overrides = QUICK if homes else SHORT
        self.rig = pamctl.simulate(logs=self.folder.name, overrides=overrides)
        self.session: RigSession = self.rig._link._session  # type: ignore[attr-defined]
        self.seen = [RigState.IDLE]
        self.session._maker = _WatchedMaker(self._note)

    def _note(self) -> None:
        state = self.session.state
        if state != self.seen[-1]:
            assert state in STATES[self.seen[-1]].leads_to, (self.seen[-1], state)
            self.seen.append(state)

    def _give(self, name: str, call: Callable[[], object]) -> None:
        before, fault = self.session.state, self.session.fault
        tick = self.rig.status()["tick"]
        allowed = [state for state, row in STATES.items() if name in row.takes] or [*RigState]
        try:
            call()
        except pamctl.PamctlError as refused:
            why = str(refused)
        else:
            why = ""
        if why and self.session.fault == fault:
            assert self.session.state == before, why
            assert self.rig.status()["tick"] == tick or before in allowed
        elif not why:
            assert before in allowed, name
        self._note()

    @rule(position_mm=st.integers(1, 9))
    def goto(self, position_mm: int) -> None:
        self._give("goto", lambda: self.rig.goto(position_mm * 1e-3, within_s=0.5))

    @rule()
    def start(self) -> None:
        self._give("start", lambda: self.rig.start(SINE))

    @rule()
    def run(self) -> None:
        self._give("start", lambda: self.rig.run(SINE))

    @rule(name=st.sampled_from(["stop", "disarm", "ack"]))
    def end(self, name: str) -> None:
        self._give(name, getattr(self.rig, name))

    @rule()
    def estop(self) -> None:
        self.rig.estop()
        assert self.session.state == RigState.FAULT
        self._note()

    @rule()
    def remark(self) -> None:
        self._give("mark", lambda: self.rig.mark("here"))

    @rule()
    def tune(self) -> None:
        self._give("set", lambda: self.rig.set(lambda_per_s=30, ramp_s=0.1))

    @rule(duration_s=st.sampled_from([0.01, 0.1, 0.4]))
    def wait_a_little(self, duration_s: float) -> None:
        with suppress(pamctl.PamctlError):
            for _ in range(5):
                self.rig.sleep(duration_s / 5)
                self._note()

    @rule()
    def let_the_loop_die(self) -> None:
        """It ends with its next tick, at the safe voltage, and nobody has asked for it."""
        loop = self.session.carrier
        if isinstance(loop, InProcessLoop):
            loop.stop_now()
            with pytest.raises(pamctl.PamctlError, match="acknowledge it"):
                self.rig.sleep(0.01)
            assert self.session.state == RigState.FAULT
            self._note()

    @invariant()
    def a_fault_has_a_reason(self) -> None:
        if hasattr(self, "session"):
            assert bool(self.session.fault) == (self.session.state == RigState.FAULT)
            assert self.session.carrier is None or not self.session.fault

    def teardown(self) -> None:
        if not hasattr(self, "rig"):
            return
        self.rig.close()
        assert self.session.state in (RigState.IDLE, RigState.FAULT)
        for log in Path(self.folder.name).glob("*.mcap"):
            assert read(log).events[-1]["event"] == "outcome"
        self.folder.cleanup()


class _WatchedMaker(InProcessMaker):
    """Its loops let somebody look at the session with every tick."""

    def __init__(self, look: Callable[[], None]) -> None:
        self._look = look

    def begin(self, settings: RunSettings, names: Mapping[str, str]) -> InProcessLoop:
        loop = super().begin(settings, names)
        note = loop.note_tick

        def note_and_look(row: bytearray) -> None:
            note(row)
            self._look()

        loop.note_tick = note_and_look  # type: ignore[method-assign]
        return loop


SimulatedSession.TestCase.settings = settings(
    max_examples=6, stateful_step_count=10, deadline=None, suppress_health_check=[*HealthCheck]
)
TestSimulatedSession = SimulatedSession.TestCase


@pytest.mark.long
def test_a_daemon_keeps_to_the_table_while_its_processes_are_killed(tmp_path: Path) -> None:
    draw = random.Random(2)
    with daemon(tmp_path, "table", *SHORT, options=["--json"]) as made:
        for _ in range(8):
            _give_any_order(made, draw)
            if draw.random() < 0.4:
                _kill_any_process(made, draw)
        made.process.send_signal(signal.SIGTERM)
        made.process.wait()
        for log in made.finished_logs():
            assert read(log).events[-1]["event"] == "outcome"
        events = [json.loads(line) for line in made.told.read_text().splitlines()]
    states = [RigState(event["state"]) for event in events if event["event"] == "state"]
    assert len(states) > 4
    for before, after in pairwise(states):
        # The watch looks every 5 ms: a state that is shorter may not be seen.
        skipped = {next_state for mid in STATES[before].leads_to for next_state in _leads_to(mid)}
        assert after in STATES[before].leads_to | skipped, states


def _leads_to(state: str) -> frozenset[str]:
    return STATES[RigState(state)].leads_to


def _give_any_order(made: Daemon, draw: random.Random) -> None:
    name, params = draw.choice(ORDERS)
    state = RigState(made.state())
    named = [each for each, row in STATES.items() if name in row.takes]
    with suppress(DaemonDeclinedError):
        made.ask(name, **params)
        # It may have come to a state that takes the order since it was looked at.
        assert not named or state in named or state in (RigState.STOPPING, RigState.HOMING)
    made.wait_for("ready", "idle", "fault", "running")
    if made.state() == RigState.FAULT:
        made.wait_until(lambda status: "loop" not in status["pids"])
        assert made.is_safe()
        assert made.ask("ack")["fault"]
        assert made.state() == RigState.IDLE


def _kill_any_process(made: Daemon, draw: random.Random) -> None:
    pids = made.ask("status")["pids"]
    if not pids:
        return
    with suppress(ProcessLookupError):
        os.kill(draw.choice(sorted(pids.values())), signal.SIGKILL)
    made.wait_for("fault", "idle", "ready")
    if made.state() == RigState.FAULT:
        made.wait_until(lambda status: "loop" not in status["pids"])
        assert made.is_safe()
        made.ask("ack")
