"""The daemon and its runs when something is stopped, dies or freezes."""

import json
import os
import signal
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from support.patience import PATIENCE_S
from support.processes.children import await_gone, list_children
from support.processes.daemons import (
    NOT_HOMED,
    SQUARE,
    Daemon,
    as_root,
    daemon,
    nobody,
    run_to_its_end,
)
from support.processes.killing import kill_as_one
from support.processes.rings import age_ring, await_ring

from pamctl.daemon.client import DaemonDeclinedError, DaemonUnreachableError
from pamctl.daemon.protocol import RequestRefusedError
from pamctl.daemon.rig_session import RigSession
from pamctl.daemon.serving import Announcements
from pamctl.daemon.session import Workshop
from pamctl.daemon.shelf import Latch, Shelf
from pamctl.log import LogError, read
from pamctl.offline.tick_replay import replay_log
from pamctl.processes.backends import SHARED_MEMORY, ao_path, build_safe_rig
from pamctl.settings.resolve import resolve
from pamctl.signals import Phase


@pytest.fixture(scope="module")
def shared_hurt(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    with daemon(tmp_path_factory.mktemp("hurt"), "hurt", NOT_HOMED) as made:
        yield made


@pytest.fixture
def hurt(shared_hurt: Daemon) -> Iterator[Daemon]:
    """A daemon whose processes are killed or frozen, and which must recover."""
    yield shared_hurt
    if shared_hurt.state() == "fault":
        shared_hurt.wait_until(lambda status: not status["pids"])
        shared_hurt.ask("ack")
    shared_hurt.ask("disarm")
    assert shared_hurt.state() == "idle"


def holding(made: Daemon) -> Path:
    """Bring the muscle under pressure, so that the safe voltage is a change."""
    log = made.ask("goto", position_m=8e-3, within_s=0.5)["log"]
    made.wait_until(lambda s: s["state"] == "ready" and s["log"] is not None and not made.is_safe())
    return Path(log)


@pytest.mark.long
def test_an_emergency_stop_is_safe_within_a_few_ticks_and_latched(hurt):
    log = holding(hurt)
    hurt.ask("estop")
    hurt.wait_safe()
    status = hurt.wait_for("fault")
    assert status["fault"] == "emergency stop"
    hurt.wait_until(lambda s: not s["pids"])
    with pytest.raises(DaemonDeclinedError, match="acknowledge"):
        hurt.ask("start", experiment=SQUARE, name="square")
    assert hurt.ask("ack")["fault"] == "emergency stop"
    ran = read(log)
    assert ran.events[-1]["reason"] == "emergency stop"
    assert replay_log(ran).is_equal


@as_root
def test_another_users_daemon_knows_the_fault_too_and_may_have_it_acknowledged():
    place = SHARED_MEMORY / "several-users"  # as /dev/shm is
    place.mkdir()
    place.chmod(0o1777)
    Latch(place / "rig.fault").engage("safety trip")
    with nobody():
        assert Latch(place / "rig.fault").release() == "safety trip"
    assert Latch(place / "rig.fault").reason == ""


@pytest.mark.long
def test_a_loop_that_freezes_is_a_fault_and_the_log_is_whole(hurt):
    """One that dies: `test_daemon_waits.py`, `test_state_table.py`."""
    log = holding(hurt)
    os.kill(hurt.ask("status")["pids"]["loop"], signal.SIGSTOP)
    hurt.wait_safe()
    status = hurt.wait_for("fault")
    assert "loop" in status["fault"]
    hurt.wait_until(lambda s: not s["pids"])
    ran = read(log)
    assert ran.events[-1]["event"] == "outcome"
    assert replay_log(ran).is_equal
    hurt.ask("ack")
    run_to_its_end(hurt, SQUARE)


def holds_numpy(made: Daemon) -> bool:
    return "numpy" in Path(f"/proc/{made.process.pid}/maps").read_text()


@pytest.mark.long
def test_a_recorder_that_dies_is_a_fault_and_its_ticks_are_rescued(hurt):
    log = holding(hurt)
    os.kill(hurt.ask("status")["pids"]["recorder"], signal.SIGKILL)
    hurt.wait_safe()
    assert "the recorder failed" in hurt.wait_for("fault")["fault"]
    hurt.wait_until(lambda s: not s["pids"])
    finished = [path for path in hurt.finished_logs() if path.name.startswith(log.stem)]
    assert any(read(path).events[-1]["event"] == "outcome" for path in finished)
    # A process of its own did it: this one stays small, and never lets go of the rig.
    assert not holds_numpy(hurt)


@pytest.mark.long
def test_a_daemon_that_is_killed_leaves_the_valve_safe_and_the_next_one_knows_its_fault(tmp_path):
    with daemon(tmp_path, "latch", NOT_HOMED, forget=False) as first:
        log = holding(first)
        pids = first.ask("status")["pids"]
        first.process.kill()
        first.wait_safe()
        first.process.wait()
        await_gone(*pids.values())
        ran = read(log)
        assert ran.events[-1]["event"] == "outcome"
        assert "commanding process" in ran.events[-1]["reason"]
    assert first.socket.exists(), "nobody was left to remove it"
    with daemon(tmp_path, "latch", NOT_HOMED, forget=False) as second:
        status = second.ask("status")
        assert (status["state"], status["tick"], status["log"]) == ("idle", None, None)
        second.ask("estop")
        second.process.kill()
        second.process.wait()
    with daemon(tmp_path, "latch", NOT_HOMED) as again:
        assert again.ask("status")["fault"] == "emergency stop"
        with pytest.raises(DaemonDeclinedError, match="acknowledge"):
            again.ask("start", experiment=SQUARE, name="square")
        again.ask("ack")
        assert Latch(ao_path(again.device).with_suffix(".fault")).reason == ""


@pytest.mark.long
def test_the_next_start_after_all_were_killed_finishes_the_log_and_stays_small(tmp_path):
    with daemon(tmp_path, "own", NOT_HOMED) as made:
        log = holding(made)
        kill_as_one(made.process.pid, *list_children(made.process.pid))
        made.process.wait()
    with pytest.raises(LogError):
        read(log)
    age_ring(await_ring(made.process.pid))
    with daemon(tmp_path, "next", NOT_HOMED) as after:
        assert len(read(log)) > 0
        assert f"finished {log}" in (tmp_path / "daemon.err").read_text()
        assert not holds_numpy(after)


@pytest.mark.long
def test_more_signals_end_it_at_once_and_leave_no_fault(tmp_path):
    slowly = ("rig.loop.stop_ramp_s=5", "rig.loop.ring_rows=65536")
    with daemon(tmp_path, "hurry", NOT_HOMED, *slowly) as made:
        log = holding(made)
        made.process.send_signal(signal.SIGTERM)
        with pytest.raises(DaemonUnreachableError):  # it has heard the first one
            made.wait_until(lambda status: False)
        deadline_s = time.monotonic() + PATIENCE_S
        while made.process.poll() is None:  # however many come, they do not interrupt its end
            assert time.monotonic() < deadline_s
            made.process.send_signal(signal.SIGTERM)
            time.sleep(1e-3)
        assert made.process.returncode == 0
        assert made.is_safe()
        assert not made.socket.exists()
        ran = read(log)
        assert np.count_nonzero(ran["phase"] == Phase.STOPPING) < 4900, "the ramp was cut short"
        assert ran.events[-1]["event"] == "outcome"
        assert not ao_path(made.device).with_suffix(".fault").exists()


def test_a_daemon_that_is_ending_starts_nothing(tmp_path):
    settings = resolve()
    workshop = Workshop(build_safe_rig(settings.rig), "none")
    latch = Latch(tmp_path / "fault")
    service = RigSession(settings, {"controller": "qsmc"}, workshop, Shelf(tmp_path), latch)
    service.close()
    for ask in (partial(service.start, SQUARE, "late", None), partial(service.goto, 8e-3, None)):
        with pytest.raises(RequestRefusedError, match="is being ended"):
            ask()


@pytest.mark.long
def test_a_daemon_tells_each_event_keeps_the_newest_logs_and_ends_with_a_signal(tmp_path):
    options = ["--json", "--keep", "1", "--idle-after", "1"]
    with daemon(tmp_path, "json", NOT_HOMED, options=options) as made:
        others = [made.logs / "20250101-000000-qsmc-tracking-1.mcap", made.logs / "mine.csv"]
        for path in others:
            path.touch()
        first = run_to_its_end(made, SQUARE, "run0")
        beside = first.with_name(f"{first.stem}-trip.csv")
        beside.touch()
        second = run_to_its_end(made, SQUARE, "run1")
        assert made.wait_for("idle")["pids"] == {}
        assert made.finished_logs() == sorted([others[0], second])
        assert others[1].exists()
        assert not beside.exists()
        made.ask("estop")
        made.ask("ack")
        last = holding(made)
        made.process.send_signal(signal.SIGINT)
        assert made.process.wait(PATIENCE_S) == 0
        assert made.is_safe()
        assert not made.socket.exists()
    ran = read(last)
    assert np.ptp(ran["t_s"][ran["phase"] == Phase.STOPPING]) > 0.15
    told = [json.loads(line) for line in made.told.read_text().splitlines()]
    assert all(event["time_s"] > 1e9 for event in told)
    assert told[0]["event"] == "listening"
    assert (told[-1]["event"], told[-1]["exit_code"]) == ("ended", 0)
    assert told[-1]["reason"] == "stopped by SIGINT"
    events = [event["event"] for event in told if event["event"] != "state"]
    for expected in ("run begins", "run over", "idle", "estop", "acknowledged", "ended"):
        assert expected in events
        events = events[events.index(expected) :]
    logs = [event["log"] for event in told if event["event"] == "run over"]
    assert logs == [str(first), str(second)]
    states = [(event["state"], event["fault"]) for event in told if event["event"] == "state"]
    assert states[0] == ("idle", "")
    assert ("running", "") in states


def test_a_slow_stuck_or_gone_reader_of_events_delays_nobody():
    ours, its = os.pipe()
    stuck = Announcements(its)
    for number in range(20_000):
        stuck.put({"number": number})
    stuck.end()
    first = os.read(ours, 1 << 16).splitlines()
    assert [json.loads(line)["number"] for line in first[:100]] == list(range(100))
    os.close(ours)
    gone = Announcements(its)
    gone.put({"number": 1})
    gone.end()
    os.close(its)
