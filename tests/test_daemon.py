"""The daemon: its life cycle, what it refuses, and what becomes of it when something dies."""

from __future__ import annotations

import json
import os
import signal
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemons import Daemon, daemon
from patience import PATIENCE_S

from pamctl.cli.assembly import SHARED_MEMORY, ao_path, rig_of
from pamctl.cli.running import ring_path, run_meta
from pamctl.daemon.announcements import Announcements
from pamctl.daemon.client import Client, Declined, Unreachable
from pamctl.daemon.latch import Latch
from pamctl.daemon.refusal import Refused
from pamctl.daemon.service import Service
from pamctl.daemon.session import Workshop
from pamctl.daemon.shelf import Shelf
from pamctl.log import Log, read
from pamctl.log.check import check
from pamctl.realtime.clock import VirtualClock
from pamctl.replay import replay
from pamctl.settings import resolve

SQUARE: dict[str, Any] = {"kind": "square", "frequency_hz": 4.0, "cycles": 1}
TRACKING: dict[str, Any] = {
    "kind": "tracking", "offset_mm": 8.0, "amplitude_mm": 2.0, "transition_s": 0.5,
    "approach_s": 0.5, "settle_s": 0.1, "cycles": 1,
}  # fmt: skip

NOT_HOMED = "rig.homing.enabled=false"


@pytest.fixture(scope="module")
def shared_up(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    with daemon(tmp_path_factory.mktemp("up"), "up") as made:
        yield made


@pytest.fixture
def up(shared_up: Daemon) -> Daemon:
    """A daemon that is shared by tests which leave it as they found it: parked or idle."""
    if shared_up.state() == "fault":  # a test that has failed does not take all others along
        shared_up.ask("ack")
    return shared_up


@pytest.fixture(scope="module")
def shared_hurt(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    settings = (NOT_HOMED, "rig.loop.heartbeat_ms=300")
    with daemon(tmp_path_factory.mktemp("hurt"), "hurt", *settings) as made:
        yield made


@pytest.fixture
def hurt(shared_hurt: Daemon) -> Iterator[Daemon]:
    """A daemon whose processes are hurt, and which has to recover from that."""
    yield shared_hurt
    if shared_hurt.state() == "fault":
        shared_hurt.wait_until(lambda status: not status["pids"])
        shared_hurt.ask("ack")
    shared_hurt.ask("disarm")
    assert shared_hurt.state() == "idle"


@pytest.fixture
def own(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Daemon]:
    """A daemon for one test that will end it."""
    name = f"own{abs(hash(request.node.name)) % 10**6}"
    with daemon(tmp_path, name, NOT_HOMED) as made:
        yield made


def parked(made: Daemon) -> dict[str, Any]:
    return made.wait_until(
        lambda status: status["state"] in ("idle", "ready") and not status["log"]
    )


def run_to_its_end(made: Daemon, experiment: dict[str, Any], name: str = "test") -> Path:
    log = Path(made.ask("start", experiment=experiment, name=name)["log"])
    parked(made)
    return log


# --- the life cycle ------------------------------------------------------------------


def test_it_starts_idle_with_the_valve_safe(own: Daemon) -> None:
    status = own.ask("status")
    assert (status["state"], status["tick"], status["log"]) == ("idle", None, None)
    assert own.is_safe()


def test_a_run_homes_runs_stops_and_leaves_the_muscle_parked(up: Daemon) -> None:
    if up.state() == "ready":
        up.ask("disarm")
    up.ask("start", experiment=SQUARE, name="square")
    seen = []
    while not seen or seen[-1] != "ready":
        state = up.state()
        if not seen or state != seen[-1]:
            seen.append(state)
    assert seen == ["homing", "running", "stopping", "ready"]
    parked(up)
    assert up.is_safe()


def test_each_run_has_a_whole_log_of_its_own_that_replays_to_the_bit_and_the_first_one_homes(
    up: Daemon,
) -> None:
    if up.state() == "ready":
        up.ask("disarm")
    first = run_to_its_end(up, SQUARE, "first")
    second = run_to_its_end(up, TRACKING, "second")
    assert first != second
    for path, name in ((first, "first"), (second, "second")):
        log = read(path)
        assert log.metadata["run"]["experiment"] == name
        assert log.events[-1]["event"] == "outcome"
        assert log.events[-1]["code"] == 0
        replayed = replay(log)
        assert replayed.is_equal, replayed.differences
        assert replayed.is_whole
        assert check(path).ok
    assert 0 in read(first)["phase"]
    assert 0 not in read(second)["phase"]
    assert read(second)["tick"][0] > read(first)["tick"][-1], "the loop went on between the runs"


def test_a_position_is_held_until_another_is_asked_for_or_it_is_stopped(up: Daemon) -> None:
    log = up.ask("goto", position_m=8e-3, within_s=0.5)["log"]
    held = up.wait_until(lambda s: s["state"] == "ready" and s["log"] is not None)
    assert held["tick"]["reference_m"] == pytest.approx(8e-3)
    assert up.ask("goto", position_m=5e-3, within_s=0.5)["log"] == log
    up.wait_until(lambda s: s["tick"]["reference_m"] == pytest.approx(5e-3))
    up.ask("stop")
    parked(up)
    ran = read(log)
    moved = np.isfinite(ran["reference_m"])
    speed = np.abs(np.diff(ran["reference_m"][moved]) / np.diff(ran.t[moved]))
    assert speed.max() < 2.2 * 8e-3 / 0.5, "the reference never jumps"
    assert replay(ran).is_equal


def test_a_run_from_a_held_position_begins_there(up: Daemon) -> None:
    up.ask("goto", position_m=9e-3, within_s=0.5)
    up.wait_until(lambda s: s["state"] == "ready" and s["log"] is not None)
    log = run_to_its_end(up, TRACKING)
    ran = read(log)
    assert ran["reference_m"][0] == pytest.approx(9e-3, abs=1e-5)
    assert replay(ran).is_equal


def test_a_stop_is_smooth_and_says_so_in_the_log(up: Daemon) -> None:
    log = up.ask("start", experiment=TRACKING | {"cycles": 50}, name="long")["log"]
    up.wait_for("running")
    up.ask("stop")
    parked(up)
    ran = read(log)
    assert [e["reason"] for e in ran.events if e["event"] == "stopping"] == ["stopped by request"]
    stopping = ran["valve_v"][ran["phase"] == 5]
    assert len(stopping) > 150
    assert np.all(np.diff(stopping) <= 1e-12), "a ramp down to the safe command"


def test_a_remark_stands_in_the_log_where_it_was_made(up: Daemon) -> None:
    log = up.ask("start", experiment=SQUARE | {"cycles": 50}, name="marked")["log"]
    up.wait_for("running")
    up.ask("mark", text="a bump")
    up.ask("stop")
    parked(up)
    assert [e["text"] for e in read(log).events if e["event"] == "mark"] == ["a bump"]


# --- gains ---------------------------------------------------------------------------


def ticks_since_the_encoder_counted(log: Log) -> np.ndarray:
    """A count, of which the law takes derivatives, jolts the command by tenths of a volt."""
    index = np.arange(len(log))
    counted = np.diff(log["position_m"], prepend=log["position_m"][0]) != 0.0
    return index - np.maximum.accumulate(np.where(counted, index, 0))


def test_gains_change_while_it_holds_without_a_jump_and_replay_honours_them(up: Daemon) -> None:
    log = up.ask("goto", position_m=8e-3, within_s=0.5)["log"]
    up.wait_until(lambda s: s["state"] == "ready" and s["log"] is not None)
    before = up.ask("status")["controller"]["lambda_per_s"]
    up.ask("set", changes=["controller.lambda_per_s=25"], ramp_s=0.2)
    time.sleep(0.5)
    up.ask("set", changes=[f"controller.lambda_per_s={before}"], ramp_s=0.2)
    time.sleep(0.5)
    up.ask("stop")
    parked(up)
    ran = read(log)
    assert [g["lambda_per_s"] for g in ran.gains] == [before, 25, before]
    resting = ran["phase"] == 3
    changed, changed_back = (gains["tick"] for gains in ran.gains[1:])
    between = resting & (ran["tick"] >= changed) & (ran["tick"] < changed_back)
    calm = between & (ticks_since_the_encoder_counted(ran) > 30)
    assert np.count_nonzero(calm) > 20
    step_v = np.abs(np.diff(ran["command_v"], prepend=np.nan))
    assert step_v[calm].max() < 0.02
    replayed = replay(ran)
    assert replayed.is_equal, replayed.differences


def test_a_replay_with_the_gains_left_as_they_were_would_differ(up: Daemon) -> None:
    """Or the test above would prove nothing."""
    log = up.ask("goto", position_m=8e-3, within_s=0.5)["log"]
    up.wait_until(lambda s: s["state"] == "ready" and s["log"] is not None)
    up.ask("set", changes=["controller.kp_v_s3_per_length=5e-8"], ramp_s=0.1)
    time.sleep(0.3)
    up.ask("set", changes=["controller.kp_v_s3_per_length=9.95e-08"], ramp_s=0.1)
    up.ask("stop")
    parked(up)
    ran = read(log)
    del ran.gains[1:]
    replayed = replay(ran)
    assert replayed.differences[0].place.stage == "command"


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (["controller.lambda_per_s=-1"], "^controller.lambda_per_s.* greater than 0"),
        (["controller.lambda_per_s"], "KEY=VALUE"),
        (["controller.eta=-0.1"], "at least 0"),
        (["controller.lambda=12"], "lambda_per_s"),
        (["controller.lambda_per_s=fast"], "number"),
        (["controller.lpf1_hz=499"], "0.45"),
        (["rig.limits.pressure_pa=9e9"], "only keys of the controller"),
    ],
)
def test_a_gain_out_of_bounds_is_refused_with_the_bound_and_changes_nothing(
    up: Daemon, changes: list[str], said: str
) -> None:
    before = up.ask("status")["controller"]
    with pytest.raises(Declined, match=said):
        up.ask("set", changes=changes)
    assert up.ask("status")["controller"] == before


def test_another_law_is_refused_while_a_run_goes_on_and_taken_between_runs(up: Daemon) -> None:
    from pamctl.settings import resolve, to_data

    pid, qsmc = (to_data(resolve(controller=name).controller) for name in ("pid", "qsmc"))
    up.ask("start", experiment=SQUARE | {"cycles": 50}, name="square")
    up.wait_for("running")
    with pytest.raises(Declined, match="another law"):
        up.ask("load", controller=pid, name="pid")
    up.ask("stop")
    parked(up)
    up.ask("load", controller=pid, name="pid")
    log = run_to_its_end(up, TRACKING)
    up.ask("load", controller=qsmc, name="qsmc")
    assert read(log).metadata["run"]["law"] == "pid"
    assert replay(read(log)).is_equal


# --- refusals ------------------------------------------------------------------------


def test_a_second_run_is_refused_while_one_goes_on(up: Daemon) -> None:
    up.ask("start", experiment=SQUARE | {"cycles": 50}, name="square")
    up.wait_for("running")
    with pytest.raises(Declined, match="the state is running"):
        up.ask("start", experiment=SQUARE, name="again")
    with pytest.raises(Declined, match="stop it first"):
        up.ask("goto", position_m=5e-3)
    up.ask("stop")
    parked(up)


@pytest.mark.parametrize(
    ("method", "params", "said"),
    [
        ("start", {"experiment": {"kind": "square"}, "name": "x"}, "frequency_hz"),
        ("start", {"experiment": {"kind": "dance"}, "name": "x"}, "kind"),
        ("start", {"experiment": SQUARE, "name": "../../etc/passwd"}, "name"),
        ("start", {"experiment": SQUARE, "name": "x", "duration_s": 0}, "duration_s"),
        ("goto", {"position_m": 0.5}, "outside the stroke"),
        ("goto", {"position_m": "far"}, "position_m"),
        ("stop", {}, "nothing is running"),
        ("ack", {}, "no fault"),
        ("mark", {"text": "x"}, "nothing is being logged"),
        ("mark", {}, "text"),
        ("explode", {}, "no method"),
        ("status", {"verbose": True}, "verbose"),
    ],
)
def test_what_cannot_be_done_is_refused_with_the_reason(
    up: Daemon, method: str, params: dict[str, Any], said: str
) -> None:
    parked(up)
    with pytest.raises(Declined, match=said):
        up.ask(method, **params)


def test_a_second_daemon_on_the_device_or_the_socket_is_refused(up: Daemon, tmp_path: Path) -> None:
    def another(*options: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "pamctl", "daemon", "--logs", str(tmp_path), *options]
        return subprocess.run(command, capture_output=True, text=True, timeout=60)

    here = another("--socket", str(tmp_path / "s"), "--set", f"rig.sim.device={up.device}")
    assert here.returncode == 69
    assert "is held by process" in here.stderr
    there = another("--socket", str(up.socket), "--set", f"rig.sim.device={up.device}-2")
    for suffix in (".ao", ".lock"):
        ao_path(f"{up.device}-2").with_suffix(suffix).unlink(missing_ok=True)
    assert there.returncode == 69
    assert "a daemon answers there already" in there.stderr
    assert up.state() in ("idle", "ready")


@pytest.mark.parametrize(
    ("options", "said"),
    [((), "there is something else"), (("--group", "no-such-group"), "there is no such group")],
)
def test_where_no_socket_can_be_no_file_is_lost_and_none_is_left(
    tmp_path: Path, options: tuple[str, ...], said: str
) -> None:
    path = tmp_path / "notes.txt"
    if not options:
        path.write_text("mine")
    command = [sys.executable, "-m", "pamctl", "daemon", "--logs", str(tmp_path / "logs")]
    command += ["--socket", str(path), "--set", "rig.sim.device=test-no-socket", *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 69
    assert said in done.stderr
    assert (path.read_text() == "mine") if not options else not path.exists()


def test_an_experiment_may_stand_in_a_file_of_any_name(up: Daemon, tmp_path: Path) -> None:
    parked(up)
    path = tmp_path / "_mein Versuch äöü 1.yaml"
    path.write_text("kind: square\nfrequency_hz: 4.0\ncycles: 1\n")
    command = [sys.executable, "-m", "pamctl", "start", str(path), "--socket", str(up.socket)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().endswith("-mein-Versuch-1.mcap")
    parked(up)


def test_a_position_below_zero_is_no_option(up: Daemon) -> None:
    parked(up)
    command = [sys.executable, "-m", "pamctl", "goto", "-300mm", "--socket", str(up.socket)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 3
    assert "-300 mm lies outside the stroke" in done.stderr


def test_without_a_daemon_a_client_says_how_to_start_one(tmp_path: Path) -> None:
    with pytest.raises(Unreachable, match="pamctl daemon"):
        Client(tmp_path / "nothing")


def test_only_user_and_group_may_steer(up: Daemon) -> None:
    assert stat.S_IMODE(up.socket.stat().st_mode) == 0o660


# --- stops and deaths ----------------------------------------------------------------


def holding(made: Daemon) -> Path:
    """Bring the muscle under pressure, so that the safe voltage is a change."""
    log = made.ask("goto", position_m=8e-3, within_s=0.5)["log"]
    made.wait_until(lambda s: s["state"] == "ready" and s["log"] is not None and not made.is_safe())
    return Path(log)


def test_an_emergency_stop_is_safe_within_a_few_ticks_and_latched(hurt: Daemon) -> None:
    log = holding(hurt)
    hurt.ask("estop")
    hurt.wait_safe()
    status = hurt.wait_for("fault")
    assert status["fault"] == "emergency stop"
    hurt.wait_until(lambda s: not s["pids"])
    with pytest.raises(Declined, match="acknowledge"):
        hurt.ask("start", experiment=SQUARE, name="square")
    assert hurt.ask("ack")["fault"] == "emergency stop"
    ran = read(log)
    assert ran.events[-1]["reason"] == "emergency stop"
    assert replay(ran).is_equal
    run_to_its_end(hurt, SQUARE)


def test_a_daemon_that_is_restarted_remembers_its_fault_until_it_is_acknowledged(
    tmp_path: Path,
) -> None:
    with daemon(tmp_path, "latch", NOT_HOMED, forget=False) as first:
        first.ask("estop")
        first.process.kill()
        first.process.wait()
    with daemon(tmp_path, "latch", NOT_HOMED) as again:
        assert again.ask("status")["fault"] == "emergency stop"
        with pytest.raises(Declined, match="acknowledge"):
            again.ask("start", experiment=SQUARE, name="square")
        again.ask("ack")
    with daemon(tmp_path, "latch", NOT_HOMED) as third:
        assert third.state() == "idle"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be several users")
def test_another_users_daemon_knows_the_fault_too_and_may_have_it_acknowledged() -> None:
    place = SHARED_MEMORY / "several-users"  # as /dev/shm is
    place.mkdir()
    place.chmod(0o1777)
    Latch(place / "rig.fault").close_on("safety trip")
    os.seteuid(65534)
    try:
        theirs = Latch(place / "rig.fault")
        assert theirs.release() == "safety trip"
    finally:
        os.seteuid(0)
    assert Latch(place / "rig.fault").reason == ""


def test_a_safety_trip_is_latched_with_its_reason(tmp_path: Path) -> None:
    with daemon(tmp_path, "trip", NOT_HOMED, "rig.limits.stroke_high_mm=6") as made:
        made.ask("start", experiment=SQUARE, name="square")
        status = made.wait_for("fault")
        assert "stroke" in status["fault"] or "displacement" in status["fault"]
        made.wait_safe()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_loop_that_dies_or_freezes_is_a_fault_and_the_log_is_whole(
    hurt: Daemon, number: signal.Signals
) -> None:
    log = holding(hurt)
    os.kill(hurt.ask("status")["pids"]["loop"], number)
    hurt.wait_safe()
    status = hurt.wait_for("fault")
    assert "loop" in status["fault"]
    hurt.wait_until(lambda s: not s["pids"])
    ran = read(log)
    assert ran.events[-1]["event"] == "outcome"
    assert replay(ran).is_equal
    hurt.ask("ack")
    run_to_its_end(hurt, SQUARE)


def test_a_recorder_that_dies_is_a_fault_and_its_ticks_are_rescued(hurt: Daemon) -> None:
    log = holding(hurt)
    os.kill(hurt.ask("status")["pids"]["recorder"], signal.SIGKILL)
    hurt.wait_safe()
    assert "recorder" in hurt.wait_for("fault")["fault"]
    hurt.wait_until(lambda s: not s["pids"])
    finished = [path for path in hurt.finished_logs() if path.name.startswith(log.stem)]
    assert any(read(path).events[-1]["event"] == "outcome" for path in finished)
    # A process of its own did it: this one stays as small as it was, and never lets go of the rig.
    assert "numpy" not in Path(f"/proc/{hurt.process.pid}/maps").read_text()


def test_a_daemon_that_is_killed_leaves_the_valve_safe_and_the_log_whole(own: Daemon) -> None:
    log = holding(own)
    pids = own.ask("status")["pids"]
    own.process.kill()
    own.wait_safe()
    own.process.wait()
    deadline_s = time.monotonic() + 30
    while any(_lives(pid) for pid in pids.values()):
        assert time.monotonic() < deadline_s
        time.sleep(0.02)
    ran = read(log)
    assert ran.events[-1]["event"] == "outcome"
    assert "commanding process" in ran.events[-1]["reason"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_stops_it_smoothly_and_it_exits_with_0(
    own: Daemon, number: signal.Signals
) -> None:
    log = holding(own)
    own.process.send_signal(number)
    assert own.process.wait(30) == 0
    assert own.is_safe()
    ran = read(log)
    assert np.ptp(ran["t_s"][ran["phase"] == 5]) > 0.15
    assert not own.socket.exists()


def test_a_stop_may_be_slower_than_the_ticks_that_are_kept_between_runs(tmp_path: Path) -> None:
    # How far behind a recorder may be is a matter of its run's ring.
    with daemon(tmp_path, "slow", NOT_HOMED, "rig.loop.stop_ramp_s=5") as made:
        log = holding(made)
        made.ask("stop")
        parked(made)
        assert read(log).events[-1]["reason"] == "stopped by request"


def test_a_second_signal_ends_it_at_once_and_leaves_no_fault(tmp_path: Path) -> None:
    slowly = ("rig.loop.stop_ramp_s=5", "rig.loop.ring_rows=65536")
    with daemon(tmp_path, "hurry", NOT_HOMED, *slowly) as made:
        log = holding(made)
        made.process.send_signal(signal.SIGTERM)
        with pytest.raises(Unreachable):  # it has heard the first one
            made.wait_until(lambda status: False)
        made.process.send_signal(signal.SIGTERM)
        assert made.process.wait(PATIENCE_S) == 0
        assert made.is_safe()
        ran = read(log)
        assert np.count_nonzero(ran["phase"] == 5) < 4900, "the ramp was cut short"
        assert not ao_path(made.device).with_suffix(".fault").exists()


def test_nothing_begins_any_more_in_a_daemon_that_is_being_ended(tmp_path: Path) -> None:
    settings = resolve()
    workshop = Workshop([], [], rig_of(settings, VirtualClock(1)).rig, run_meta, "none", ring_path)
    latch = Latch(tmp_path / "fault")
    service = Service(settings, {"controller": "qsmc"}, workshop, Shelf(tmp_path), latch)
    service.close()
    for ask in (partial(service.start, SQUARE, "late", None), partial(service.goto, 8e-3, None)):
        with pytest.raises(Refused, match="is being ended"):
            ask()


def test_with_json_its_life_stands_on_standard_output_a_line_for_whatever_happens(
    tmp_path: Path,
) -> None:
    with daemon(tmp_path, "json", NOT_HOMED, options=["--json"]) as made:
        log = run_to_its_end(made, SQUARE, "square")
        made.ask("estop")
        made.wait_until(lambda status: not status["pids"])
        made.ask("ack")
        made.process.send_signal(signal.SIGTERM)
        assert made.process.wait(PATIENCE_S) == 0
    told = [json.loads(line) for line in made.told.read_text().splitlines()]
    assert all(event["time_s"] > 1e9 for event in told)
    assert told[0]["event"] == "listening"
    assert (told[-1]["event"], told[-1]["exit_code"]) == ("ended", 0)
    assert told[-1]["reason"] == "stopped by SIGTERM"
    events = [event["event"] for event in told if event["event"] != "state"]
    for expected in ("run begins", "run over", "estop", "acknowledged", "ended"):
        assert expected in events
        events = events[events.index(expected) :]
    assert {event["log"] for event in told if event["event"] == "run over"} == {str(log)}
    states = [(event["state"], event["fault"]) for event in told if event["event"] == "state"]
    assert states[0] == ("idle", "")
    assert ("running", "") in states
    assert ("fault", "emergency stop") in states


def test_who_reads_its_announcements_slowly_not_at_all_or_no_longer_holds_up_nobody() -> None:
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


def test_a_session_that_is_parked_for_long_ends(tmp_path: Path) -> None:
    with daemon(tmp_path, "idle", NOT_HOMED, options=["--idle-after", "1"]) as made:
        made.ask("start", experiment=SQUARE, name="square")
        made.wait_for("ready")
        assert made.wait_for("idle")["pids"] == {}


def test_only_the_newest_logs_are_kept_where_that_was_asked_for(tmp_path: Path) -> None:
    with daemon(tmp_path, "keep", NOT_HOMED, options=["--keep", "2"]) as made:
        logs = [run_to_its_end(made, SQUARE, f"run{n}") for n in range(3)]
        assert made.finished_logs() == logs[1:]


def _lives(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as status:
            return status.read().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def test_sockets_of_the_dead_are_replaced(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"
    dead = socket.socket(socket.AF_UNIX)
    dead.bind(str(path))
    dead.close()
    with daemon(tmp_path, "stale") as made:
        assert made.state() == "idle"
