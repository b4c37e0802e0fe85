"""Orders and states are described once: every door offers them, and a daemon keeps to the table."""

import asyncio
import json
import os
import random
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import pytest
import typer
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from pydantic import Field
from support.processes.daemons import QUICK, SQUARE, TRACKING, Daemon, daemon
from typer.testing import CliRunner

import pamctl
from pamctl.cli.app import build_app
from pamctl.cli.orders import make_verb
from pamctl.cli.verbs import VERBS
from pamctl.daemon.client import Client, DaemonDeclinedError
from pamctl.daemon.in_process import InProcessLoop, InProcessMaker
from pamctl.daemon.protocol import INVALID_PARAMS, list_orders, order
from pamctl.daemon.rig_session import RigSession
from pamctl.daemon.server import Server
from pamctl.daemon.session_life import STATES, RigState
from pamctl.live.page_orders import PageRefusal, translate_order
from pamctl.log import read
from pamctl.session.daemon_rig import DaemonRig
from pamctl.settings.resolve import RunSettings

READ_BY_VIEWERS = {"settings", "recent", "undo", "load"}
"""Orders without a verb of their name: `gains load` loads, and the page takes back."""


@order(on_page=True, said="waved {times} times to {height_m:g} m")
def wave(
    self: RigSession,
    height_m: Annotated[float, Field(ge=0, le=0.03, description="Height of a wave")],
    times: Annotated[int, Field(ge=1, le=9, description="Number of waves")] = 2,
    within_s: Annotated[float | None, Field(gt=0, description="Time of all waves")] = None,
) -> dict[str, object]:
    """Wave with the muscle."""
    return {"height_m": height_m, "times": times, "state": str(self.state)}


@pytest.fixture
def session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RigSession]:
    monkeypatch.setattr(RigSession, "wave", wave, raising=False)
    with pamctl.simulate(logs=tmp_path, overrides=QUICK) as rig:
        yield rig._link._session  # type: ignore[attr-defined]


@contextmanager
def listening(session: RigSession, path: Path) -> Iterator[None]:
    """Serve the orders of a session on a socket, as the daemon does."""
    events = asyncio.new_event_loop()

    def serve() -> None:
        server = Server(session)
        events.run_until_complete(server.listen(path))
        ready.set()
        events.run_forever()
        events.run_until_complete(server.close())
        for task in asyncio.all_tasks(events):
            task.cancel()
        events.run_until_complete(events.shutdown_default_executor())
        events.run_until_complete(asyncio.sleep(0))
        events.close()

    ready = threading.Event()
    thread = threading.Thread(target=serve)
    thread.start()
    ready.wait()
    try:
        yield
    finally:
        events.call_soon_threadsafe(events.stop)
        thread.join()


def test_a_new_order_is_given_by_socket_python_page_and_verb(session, tmp_path):
    path = tmp_path / "socket"
    expected = {"height_m": 0.02, "times": 2, "state": "idle"}
    with listening(session, path):
        with Client(path) as client:
            assert client.call("wave", {"height_m": 0.02}) == expected
            with pytest.raises(DaemonDeclinedError, match="height_m") as wrong:
                client.call("wave", {"height_m": 0.2})
            assert wrong.value.code == INVALID_PARAMS
        with DaemonRig(path) as rig:
            assert rig.wave(0.02) == expected  # type: ignore[attr-defined]
            with pytest.raises(pamctl.PamctlError, match="times"):
                rig.wave(0.02, times=10)  # type: ignore[attr-defined]
        assert translate_order({"do": "wave", "height_m": 0.01}) == ("wave", {"height_m": 0.01})
        with pytest.raises(PageRefusal, match="height_m"):
            translate_order({"do": "wave", "height_m": 1})
        app = typer.Typer()
        app.command()(make_verb(list_orders(RigSession)["wave"]))
        run = CliRunner().invoke
        done = run(app, ["20mm", "--times", "3", "--socket", str(path)])
        assert (done.exit_code, done.output) == (0, "waved 3 times to 0.02 m\n")
        told = run(app, ["20mm", "--json", "--socket", str(path)])
        assert json.loads(told.output) == expected
        shown = run(app, ["--help"], env={"COLUMNS": "200"}).output
        for part in ("Wave with the muscle.", "Number of waves", "--within", "more than 0 s"):
            assert part in shown
        assert run(app, ["20mm", "--within", "0", "--socket", str(path)]).exit_code == 2


def test_the_simulated_rig_takes_a_new_order_too(session, tmp_path):
    with pamctl.simulate(logs=tmp_path, overrides=QUICK) as rig:
        assert rig.wave(0.01, times=1)["times"] == 1  # type: ignore[attr-defined]
        with pytest.raises(AttributeError, match="no 'waive'"):
            rig.waive()  # type: ignore[attr-defined]


def test_recent_ticks_begin_with_the_first_where_none_is_named(tmp_path):
    with pamctl.simulate(logs=tmp_path, overrides=QUICK) as rig:
        rig.goto(8e-3, within_s=0.2)
        ticks = rig._ask("recent", every=50, fields=["tick"])["ticks"]  # type: ignore[attr-defined]
        assert ticks[:3] == [[0], [50], [100]]
        later = rig._ask("recent", every=50, fields=["tick"], after_tick=50)["ticks"]  # type: ignore[attr-defined]
        assert later[0] == [100]


def test_each_order_has_a_verb_whose_help_is_its_own():
    app = build_app()
    for name, told in list_orders(RigSession).items():
        if name in READ_BY_VIEWERS:
            continue
        assert name in VERBS, f"add a line for {name} to cli/verbs.py"
        shown = CliRunner().invoke(app, [name, "--help"], env={"COLUMNS": "200"})
        assert shown.exit_code == 0
        if name != "mark":  # its verb marks a run without a daemon too
            assert (told.body.__doc__ or "").splitlines()[0] in shown.output


def test_who_may_give_an_order_stands_beside_it():
    orders = list_orders(RigSession)
    assert {name for name, told in orders.items() if told.at_once} == {"estop"}
    only_the_socket = {name for name, told in orders.items() if not told.on_page}
    assert only_the_socket == {"status", "settings", "recent", "load"}
    assert {name for name, told in orders.items() if not told.changes} == {
        "status", "settings", "recent", "estop",
    }  # fmt: skip


def test_the_table_of_states_names_orders_and_states_that_there_are():
    assert {*STATES} == {*RigState}
    for row in STATES.values():
        assert row.takes <= {*list_orders(RigSession)}
        assert row.leads_to <= {*map(str, RigState)}


# --- the table of states -------------------------------------------------------------------------

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


def test_a_run_that_was_just_ordered_is_homing_and_not_what_the_tick_before_it_was(tmp_path):
    with pamctl.simulate(logs=tmp_path, overrides=QUICK) as rig:
        rig.start(SINE)
        assert rig._link._session.state == RigState.HOMING  # type: ignore[attr-defined]


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
        wants_abort = loop.wants_abort

        def look_and_ask() -> bool:
            self._look()
            return wants_abort()

        loop.wants_abort = look_and_ask  # type: ignore[method-assign]
        return loop


SimulatedSession.TestCase.settings = settings(
    max_examples=6, stateful_step_count=10, deadline=None, suppress_health_check=[*HealthCheck]
)
TestSimulatedSession = SimulatedSession.TestCase


@pytest.mark.long
def test_a_daemon_keeps_to_the_table_while_its_processes_are_killed(tmp_path):
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
