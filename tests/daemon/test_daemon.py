"""The daemon: its life cycle, its gains, and what it refuses."""

import asyncio
import json
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.command_line import run_pamctl, run_process
from support.patience import PATIENCE_S
from support.processes.daemons import (
    SQUARE,
    TRACKING,
    Daemon,
    as_root,
    daemon,
    nobody,
    parked,
    run_to_its_end,
)
from support.small_log import require_right_index

from pamctl.daemon.client import Client, DaemonDeclinedError, DaemonUnreachableError
from pamctl.daemon.server import Server, SocketError, require_no_daemon
from pamctl.log import Log, read
from pamctl.log.check import check_log
from pamctl.offline.tick_replay import replay_log
from pamctl.processes.backends import SHARED_MEMORY
from pamctl.settings.resolve import resolve
from pamctl.signals import Phase

GOLDEN = Path(__file__).parents[1] / "golden"


@pytest.fixture(scope="module")
def shared_up(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    # What compiles a replay must not do so beside a loop that ticks: for both it takes longer.
    assert replay_log(read(GOLDEN / "qsmc.mcap")).is_equal
    with daemon(tmp_path_factory.mktemp("up"), "up") as made:
        yield made


@pytest.fixture
def up(shared_up: Daemon) -> Daemon:
    """A daemon shared by tests that leave it parked or idle."""
    if shared_up.state() == "fault":  # a test that has failed does not take all others along
        shared_up.ask("ack")
    return shared_up


# --- the life cycle ------------------------------------------------------------------


@pytest.mark.long
def test_each_run_has_a_whole_log_of_its_own_that_replays_to_the_bit_and_the_first_one_homes(up):
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
        replayed = replay_log(log)
        assert replayed.is_equal, replayed.differences
        assert replayed.is_whole
        assert check_log(path).ok
        require_right_index(path)
    phase = read(first)["phase"]
    went_through = phase[np.flatnonzero(np.diff(phase, prepend=-1))]
    assert went_through[:3].tolist() == [Phase.HOMING, Phase.OPEN_LOOP, Phase.STOPPING]
    assert Phase.HOMING not in read(second)["phase"]
    assert up.is_safe()
    assert read(second)["tick"][0] > read(first)["tick"][-1], "the loop went on between the runs"


def test_a_position_is_held_until_another_is_requested_or_the_run_is_stopped(up):
    log = up.ask("goto", position_m=8e-3, within_s=0.5)["log"]
    held = up.wait_until(lambda s: s["state"] == "ready" and s["log"] is not None)
    assert held["tick"]["reference_m"] == pytest.approx(8e-3)
    assert up.ask("goto", position_m=5e-3, within_s=0.5)["log"] == log
    up.wait_until(lambda s: s["tick"]["reference_m"] == pytest.approx(5e-3))
    up.ask("stop")
    parked(up)
    ran = read(log)
    assert [e["reason"] for e in ran.events if e["event"] == "stopping"] == ["stopped by request"]
    stopping = ran["phase"] == Phase.STOPPING
    assert np.ptp(ran["t_s"][stopping]) > 0.15
    assert np.all(np.diff(ran["valve_v"][stopping]) <= 1e-12), "a ramp down to the safe command"
    moved = np.isfinite(ran["reference_m"])
    speed = np.abs(np.diff(ran["reference_m"][moved]) / np.diff(ran.t[moved]))
    assert speed.max() < 2.2 * 8e-3 / 0.5, "the reference never jumps"
    assert replay_log(ran).is_equal


def test_a_run_from_a_held_position_begins_there(up):
    up.ask("goto", position_m=9e-3, within_s=0.5)
    up.wait_until(lambda s: s["state"] == "ready" and s["log"] is not None)
    log = run_to_its_end(up, TRACKING)
    ran = read(log)
    assert ran["reference_m"][0] == pytest.approx(9e-3, abs=1e-5)
    assert replay_log(ran).is_equal


# --- gains ---------------------------------------------------------------------------


def ticks_since_the_encoder_counted(log: Log) -> np.ndarray:
    """The law differentiates a count, which moves the command by tenths of a volt."""
    index = np.arange(len(log))
    counted = np.diff(log["position_m"], prepend=log["position_m"][0]) != 0.0
    return index - np.maximum.accumulate(np.where(counted, index, 0))


@pytest.mark.long
def test_gains_change_without_a_jump_and_replay_follows_them(up):
    """A busy machine gives few ticks in a row: gains change until enough of them were seen."""
    before = up.ask("status")["controller"]["lambda_per_s"]
    seen, deadline_s = 0, time.monotonic() + PATIENCE_S
    while seen <= 20:
        assert time.monotonic() < deadline_s, "the machine gives no ticks"
        log = up.ask("goto", position_m=8e-3, within_s=0.5)["log"]
        up.wait_until(lambda s: s["state"] == "ready" and s["log"] is not None)
        up.ask("set", changes=["controller.lambda_per_s=25"], ramp_s=0.2)
        up.wait_ticks(1000)
        up.ask("set", changes=[f"controller.lambda_per_s={before}"], ramp_s=0.2)
        up.wait_ticks(500)
        up.ask("stop")
        parked(up)
        ran = read(log)
        assert [g["lambda_per_s"] for g in ran.gains] == [before, 25, before]
        changed, changed_back = (gains["tick"] for gains in ran.gains[1:])
        between = (ran["phase"] == Phase.REST) & (ran["tick"] >= changed)
        between &= ran["tick"] < changed_back
        calm = between & (ticks_since_the_encoder_counted(ran) > 30) & (ran["missed"] == 0)
        step_v = np.abs(np.diff(ran["command_v"], prepend=np.nan))
        assert np.all(step_v[calm] < 0.02)
        replayed = replay_log(ran)
        assert replayed.is_equal, replayed.differences
        seen += np.count_nonzero(calm)


def test_a_gain_out_of_bounds_is_refused_with_the_bound_and_changes_nothing(up):
    before = up.ask("status")["controller"]
    for change, said in (
        ("controller.lambda_per_s=-1", "^controller.lambda_per_s.* greater than 0"),
        ("controller.lambda_per_s", "KEY=VALUE"),
        ("controller.eta=-0.1", "at least 0"),
        ("controller.lambda=12", "lambda_per_s"),
        ("controller.lambda_per_s=fast", "number"),
        ("controller.lpf1_hz=499", "0.45"),
        ("rig.limits.pressure_pa=9e9", "only keys of the controller"),
    ):
        with pytest.raises(DaemonDeclinedError, match=said):
            up.ask("set", changes=[change])
    assert up.ask("status")["controller"] == before


@pytest.mark.long
def test_another_law_is_refused_during_a_run_and_accepted_between_runs(up):
    from pamctl.settings.resolve import settings_to_data

    pid, qsmc = (settings_to_data(resolve(controller=name).controller) for name in ("pid", "qsmc"))
    up.ask("start", experiment=SQUARE | {"cycles": 50}, name="square")
    up.wait_for("running")
    with pytest.raises(DaemonDeclinedError, match="another law"):
        up.ask("load", controller=pid, name="pid")
    up.ask("stop")
    parked(up)
    up.ask("load", controller=pid, name="pid")
    log = run_to_its_end(up, TRACKING)
    up.ask("load", controller=qsmc, name="qsmc")
    assert read(log).metadata["run"]["law"] == "pid"
    assert replay_log(read(log)).is_equal


# --- experiments made of forms ----------------------------------------------------------


def start(up: Daemon, *arguments: str) -> subprocess.CompletedProcess[str]:
    return run_pamctl("start", "--socket", up.socket, *arguments)


@pytest.mark.long
def test_a_sine_starts_with_keys_from_the_command_line_and_replays(up):
    """Its motion is that of the simulation: `test_daemon_session.py`, `test_motion_runs.py`."""
    keys = ("--set", "amplitude_mm=2", "--set", "frequency_hz=1", "--set", "experiment.cycles=2")
    done = start(up, "sine", *keys, "--duration", "0.5", "--json")
    assert done.returncode == 0, done.stderr
    parked(up)
    log = read(json.loads(done.stdout)["log"])
    experiment = log.config["experiment"]
    keys_of_it = (experiment[key] for key in ("amplitude_mm", "frequency_hz", "cycles"))
    assert [*keys_of_it] == [2, 1, 2]
    assert replay_log(log).is_equal


def test_a_key_that_a_form_lacks_or_a_motion_beyond_the_stroke_starts_nothing(up):
    typo = start(up, "sine", "--set", "amplitude_v=2")
    assert typo.returncode == 78
    assert "did you mean 'amplitude_mm'" in typo.stderr
    far = start(up, "sine", "--set", "offset_mm=31")
    assert far.returncode != 0
    assert "a position of 33" in far.stderr
    assert up.state() in ("idle", "ready")


@pytest.mark.long
def test_gains_of_a_sequence_end_with_its_run(up):
    before = up.ask("status")["controller"]["lambda_per_s"]
    parts = [
        {"kind": "move", "to_mm": 9, "duration_s": 1},
        {"kind": "gains", "set": {"lambda_per_s": 0.5 * before}, "ramp_s": 0.1},
        {"kind": "mark", "text": "softer"},
        {"kind": "move", "to_mm": 8, "duration_s": 1},
    ]
    log = read(run_to_its_end(up, {"kind": "sequence", "parts": parts}))
    assert [e["text"] for e in log.events if e["event"] == "mark"] == ["softer"]
    assert [gains["lambda_per_s"] for gains in log.gains] == [before, 0.5 * before]
    assert replay_log(log).is_equal
    after = read(run_to_its_end(up, HOLD))
    assert [gains["lambda_per_s"] for gains in after.gains] == [before]
    assert replay_log(after).is_equal


HOLD = {"kind": "hold", "position_mm": 5.0, "transition_s": 1.0, "hold_s": 0.2}


def test_the_largest_table_fits_into_a_request(up, tmp_path):
    parked(up)
    t_s = np.arange(8000) * 1.2345e-3
    values = 9.0 + np.sin(t_s * 2 * np.pi / t_s[-1] - np.pi / 2) + 1e-7 * np.sin(997 * t_s)
    rows = "\n".join(f"{t:.9f},{x:.9f}" for t, x in zip(t_s, values, strict=True))
    (tmp_path / "points.csv").write_text(f"time_s,position_mm\n{rows}\n")
    (tmp_path / "mine.yaml").write_text("kind: table\nfile: points.csv\n")
    done = start(up, str(tmp_path / "mine.yaml"), "--duration", "1")
    assert done.returncode == 0, done.stderr
    parked(up)


# --- refusals ------------------------------------------------------------------------


def test_a_second_daemon_on_the_device_is_refused(up, tmp_path):
    command = [sys.executable, "-m", "pamctl", "daemon", "--logs", str(tmp_path)]
    command += ["--socket", str(tmp_path / "s"), "--set", f"rig.sim.device={up.device}"]
    done = run_process(command)
    assert done.returncode == 69
    assert "is held by process" in done.stderr
    assert up.state() in ("idle", "ready")


def test_a_socket_that_cannot_be_had_neither_removes_nor_leaves_a_file(up, tmp_path):
    with pytest.raises(SocketError, match="a daemon answers there already"):
        require_no_daemon(up.socket)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(SocketError, match="there is something else"):
        require_no_daemon(tmp_path / "notes.txt")
    assert (tmp_path / "notes.txt").read_text() == "mine"
    with pytest.raises(SocketError, match="there is no such group"):
        asyncio.run(Server({}).listen(tmp_path / "socket", "no-such-group"))
    assert not (tmp_path / "socket").exists()
    assert up.state() in ("idle", "ready")


def test_only_user_and_group_may_steer(up):
    assert stat.S_IMODE(up.socket.stat().st_mode) == 0o660


@as_root
def test_a_user_without_permission_learns_who_has_it():
    path = SHARED_MEMORY / "forbidden.sock"
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))
        listening.listen()
        path.chmod(0o600)
        with nobody(), pytest.raises(DaemonUnreachableError, match="not permitted; join the group"):
            Client(path)
