"""An order is one method: the socket, Python, asyncio and the shell give it without a line more."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import pytest
import typer
from pydantic import Field
from support.processes.daemons import QUICK
from typer.testing import CliRunner

import pamctl
from pamctl.aio import AsyncRig
from pamctl.cli.app import build_app
from pamctl.cli.orders import make_verb
from pamctl.cli.verbs import VERBS
from pamctl.daemon.client import Client, DaemonDeclinedError
from pamctl.daemon.protocol import INVALID_PARAMS, list_orders, methods_of, order
from pamctl.daemon.rig_session import RigSession
from pamctl.daemon.server import Server
from pamctl.daemon.session_life import STATES, RigState
from pamctl.live.page_orders import PageRefusal, translate_order
from pamctl.session.daemon_rig import DaemonRig

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
        server = Server(methods_of(session))
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


def test_a_new_order_is_given_by_socket_python_asyncio_page_and_verb(
    session: RigSession, tmp_path: Path
) -> None:
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

        async def work() -> object:
            async with AsyncRig(lambda: DaemonRig(path)) as rig:
                return await rig.wave(0.02, within_s=1.0)  # type: ignore[attr-defined]

        assert asyncio.run(work()) == expected
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


def test_the_simulated_rig_takes_a_new_order_too(session: RigSession, tmp_path: Path) -> None:
    with pamctl.simulate(logs=tmp_path, overrides=QUICK) as rig:
        assert rig.wave(0.01, times=1)["times"] == 1  # type: ignore[attr-defined]
        with pytest.raises(AttributeError, match="no 'waive'"):
            rig.waive()  # type: ignore[attr-defined]


def test_each_order_has_a_verb_whose_help_is_its_own() -> None:
    app = build_app()
    for name, told in list_orders(RigSession).items():
        if name in READ_BY_VIEWERS:
            continue
        assert name in VERBS, f"add a line for {name} to cli/verbs.py"
        shown = CliRunner().invoke(app, [name, "--help"], env={"COLUMNS": "200"})
        assert shown.exit_code == 0
        if name != "mark":  # its verb marks a run without a daemon too
            assert (told.body.__doc__ or "").splitlines()[0] in shown.output


def test_who_may_give_an_order_stands_beside_it() -> None:
    orders = list_orders(RigSession)
    assert {name for name, told in orders.items() if told.at_once} == {"estop"}
    only_the_socket = {name for name, told in orders.items() if not told.on_page}
    assert only_the_socket == {"status", "settings", "recent", "load"}
    assert {name for name, told in orders.items() if not told.changes} == {
        "status", "settings", "recent", "estop",
    }  # fmt: skip


def test_the_table_of_states_names_orders_and_states_that_there_are() -> None:
    assert {*STATES} == {*RigState}
    for row in STATES.values():
        assert row.takes <= {*list_orders(RigSession)}
        assert row.leads_to <= {*map(str, RigState)}
