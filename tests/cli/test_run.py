"""`pamctl run` from the outside: real processes, real signals, real files."""

import fcntl
import json
import os
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command_line import run_pamctl, run_process, start_process
from support.patience import BUSY_PC, PATIENCE_S
from support.processes.children import await_children
from support.processes.rings import await_phase, await_tick
from typer.testing import CliRunner

from pamctl.cli.app import app
from pamctl.log.reader import Log, read
from pamctl.processes.backends import SHARED_MEMORY
from pamctl.report.report import format_terminal
from pamctl.report.reported_run import report_run
from pamctl.settings.resolve import from_resolved, resolve
from pamctl.signals import Phase

PAMCTL = str(Path(sys.executable).with_name("pamctl"))
DEVICE = f"testrun{os.getpid()}"
ON_OUR_DEVICE = tuple(
    part
    for setting in (f"rig.sim.device={DEVICE}", "rig.homing.enabled=false", *BUSY_PC)
    for part in ("--set", setting)
)
"""In real time a run needs a device for itself, and others may be running on this PC."""


@pytest.fixture(autouse=True, scope="module")
def _device() -> Iterator[None]:
    yield
    for left in SHARED_MEMORY.glob(f"pamctl-{DEVICE}.*"):
        left.unlink()


def pamctl(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return run_pamctl(*arguments, cwd=cwd)


def fast_run(cwd: Path, *arguments: str, log: str = "run.mcap") -> tuple[dict[str, object], Log]:
    """Run without a clock: the loop and its recorder are real, the front is in this process."""
    options = ["--fast", "--json", "--log", str(cwd / log), *arguments]
    done = CliRunner().invoke(app, ["run", *options])
    assert done.stdout, done.stderr
    return json.loads(done.stdout), read(cwd / log)


@contextmanager
def running(cwd: Path, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Run in real time until the block ends."""
    front = start_process(
        [PAMCTL, "run", "--quiet", "--log", "run.mcap", *ON_OUR_DEVICE, *arguments], cwd=cwd
    )
    with front:
        try:
            yield front
        finally:
            front.kill()


def await_ticks(front: subprocess.Popen[Any], ticks: int) -> None:
    await_tick(front.pid, lambda newest: newest["tick"] >= ticks)


def assert_gapless_but_for_missed_ticks(log: Log) -> None:
    assert np.array_equal(np.diff(log["tick"]) - 1, log["missed"][1:])


def outcome(log: Log) -> dict[str, object]:
    return next(event for event in log.events if event["event"] == "outcome")


# --- a run without a clock ---------------------------------------------------------------

SHORT = ("--duration", "0.5", "--seed", "7", "--set", "rig.loop.stop_ramp_s=0.25")


BRISK = (
    "--duration", "5", "--set", "experiment.approach_s=2", "--set", "experiment.settle_s=1"
)  # fmt: skip
"""Two seconds of tracking, after three to get there."""


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Log:
    return fast_run(tmp_path_factory.mktemp("short"), *SHORT)[1]


@pytest.fixture(scope="module")
def brisk(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, object], Log]:
    return fast_run(tmp_path_factory.mktemp("whole"), *BRISK)


@pytest.fixture
def of_every_phase(brisk: tuple[dict[str, object], Log]) -> Log:
    return brisk[1]


@pytest.mark.long
def test_a_fast_run_compares_its_tracking_with_table_iv(tmp_path):
    report, log = fast_run(tmp_path)
    assert report["exit_code"] == 0
    tracked = np.isin(log["phase"], (Phase.TRACK, Phase.REST))
    error_m = (log["position_m"] - log["reference_m"])[tracked]
    assert report["tracking"]["measured"]["max_m"] == pytest.approx(np.abs(error_m).max())
    true_m = np.abs(log["true_position_m"] - log["reference_m"])[tracked].max()
    assert report["tracking"]["true"]["max_m"] == pytest.approx(true_m)
    assert report["tracking"]["measured"]["rms_m"] == pytest.approx(np.sqrt(np.mean(error_m**2)))
    assert {row["law"] for row in report["paper"]} == {"qsmc", "smc"}
    assert report["timing"] is None
    assert outcome(log)["code"] == 0


def test_a_run_homes_approaches_tracks_and_stops_in_this_order(of_every_phase):
    log = of_every_phase
    phases = log["phase"][np.flatnonzero(np.diff(log["phase"], prepend=-1))]
    assert phases.tolist() == [Phase.HOMING, Phase.APPROACH, Phase.TRACK, Phase.STOPPING]
    zeroed = [event for event in log.events if event["event"] == "zeroed"]
    assert zeroed[-1]["sensor_zero_v"] == pytest.approx(0.215, abs=1e-3)
    assert zeroed[-1]["encoder_zero_counts"] == 1000.0


def test_duration_counts_from_the_end_of_homing(short):
    assert np.count_nonzero(short["phase"] == Phase.APPROACH) == 500


def test_the_log_carries_the_resolved_configuration(short):
    embedded = from_resolved(json.dumps(short.config))
    asked = resolve(duration_s=0.5, seed=7, fast=True, overrides=["rig.loop.stop_ramp_s=0.25"])
    assert embedded == asked
    assert short.gains[0]["law"] == "qsmc"
    assert short.metadata["run"]["controller"] == "qsmc"


def test_a_dry_run_prints_a_configuration_that_resolves_to_itself(tmp_path):
    done = pamctl("run", "--dry-run", "--set", "controller.lambda_per_s=12", cwd=tmp_path)
    assert done.returncode == 0
    assert from_resolved(done.stdout) == resolve(overrides=["controller.lambda_per_s=12"])
    assert not list(tmp_path.iterdir())


# --- a run in real time ------------------------------------------------------------------


def test_in_real_time_ticks_lie_on_the_grid_until_sigterm_stops_the_run_smoothly_with_143(tmp_path):
    with running(tmp_path, "--json") as front:
        await_ticks(front, 800)
        front.terminate()
        told, said = front.communicate(timeout=PATIENCE_S)
    assert front.returncode == 143
    assert "SIGTERM" in said
    report, log = json.loads(told), read(tmp_path / "run.mcap")
    assert_gapless_but_for_missed_ticks(log)
    off_grid_s = log["t_s"] - log["tick"] * 1e-3
    # No drift: whatever happens to single ticks, the last lie where the grid has them.
    assert np.abs(np.median(off_grid_s[-200:]) - np.median(off_grid_s[:200])) < 2e-3
    assert np.allclose(log["dt_s"][1:], np.diff(log["t_s"]), atol=1e-9)
    assert report["timing"]["wake_up"]["p50_s"] >= 0
    assert log.metadata["timing_setup"]["mode"] == "auto"
    assert log["phase"][-1] == Phase.STOPPING
    assert outcome(log)["code"] == report["exit_code"] == 143


@pytest.mark.long
def test_a_recorder_frozen_for_good_ends_the_run_and_loses_nothing(tmp_path):
    with running(tmp_path) as front:
        await_ticks(front, 300)
        os.kill(await_children(front.pid, "recorder")["recorder"], signal.SIGSTOP)
        _, said = front.communicate(timeout=PATIENCE_S)
    assert front.returncode == 1
    assert "finished from the ring" in said
    log = read(tmp_path / "run.mcap")
    assert_gapless_but_for_missed_ticks(log)
    assert "no sign of life" in str(outcome(log)["reason"])


# --- trips -------------------------------------------------------------------------------


@pytest.mark.long
def test_a_rehearsed_fault_ends_the_run_with_its_exit_code_and_reason(tmp_path):
    fault = "rig.faults=[{kind: pressure_nan, from_tick: 2500}]"
    report, log = fast_run(tmp_path, "--set", fault, "--set", "rig.homing.enabled=false")
    assert report["exit_code"] == 4
    assert "no finite number" in str(report["reason"])
    assert len(log) >= 2500
    assert log["tripped"][-1]
    assert log["applied_v"][-1] == pytest.approx(0.0, abs=1e-3)
    table = (tmp_path / "run-trip.csv").read_text().splitlines()
    assert len(table) - 1 in (2000, 2001)  # as the first of 2 s rounds
    assert table[0].startswith("tick,t_s,dt_s")


# --- bad input ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "code", "complaint"),
    [
        (["--duration", "0"], 2, "--duration 0.0: duration_s: must be greater than 0"),
        (["--duration", "nan"], 2, "must be a finite number"),
        (["--backend", "moog"], 2, "--backend moog: unknown; there are sim, nidaq"),
        (["--backend", "nidaq", "--fast"], 2, "only a simulation can do without a clock"),
        (["--backend", "nidaq", "--rig", "sim"], 2, "is for the backend sim"),
        (["--controller", "qsmk"], 2, "did you mean 'qsmc'?"),
        (["--controller", "missing.yaml"], 78, "missing.yaml"),
        (["--set", "controller.lamda=1"], 78, "did you mean 'lambda_per_s'?"),
        (["--set", "controller.lambda_per_s=-1"], 78, "must be greater than 0 (got -1)"),
        (["--set", "nonsense"], 78, "must read KEY=VALUE"),
        (["--log", "there-already.mcap"], 2, "exists, and a log is never overwritten"),
        (["--log", "no/such/place.mcap"], 2, "there is no directory no/such"),
        (["--log", "/proc/log.mcap"], 2, "cannot be created"),
        (["--no-such-option"], 2, "No such option"),
    ],
)
def test_bad_input_gets_one_clear_error_and_changes_nothing(
    tmp_path, monkeypatch, arguments, code, complaint
):
    (tmp_path / "there-already.mcap").write_bytes(b"precious")
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["run", *arguments])
    assert done.exit_code == code, done.exception
    assert complaint in done.stderr
    assert "Traceback" not in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["there-already.mcap"]
    assert (tmp_path / "there-already.mcap").read_bytes() == b"precious"


def test_without_a_run_json_still_prints_one_document(tmp_path: Path) -> None:
    # In a process of its own: other tests load the stand-in driver into this one.
    no_driver = run_process(
        [sys.executable, "-m", "pamctl", "run", "--backend", "nidaq", "--json"], cwd=tmp_path
    )
    assert "install NI-DAQmx" in no_driver.stderr
    assert "Traceback" not in no_driver.stderr
    assert not list(tmp_path.iterdir())
    assert json.loads(no_driver.stdout)["exit_code"] == no_driver.returncode == 69
    bad = pamctl("run", "--set", "controller.lamda=1", "--json", cwd=tmp_path)
    assert json.loads(bad.stdout)["exit_code"] == bad.returncode == 78


def test_a_changed_experiment_is_not_compared_with_table_iv(brisk):
    changed, _ = brisk
    assert changed["tracking"]["measured"]["max_m"] < 292e-6
    assert changed["paper"] == []


def test_a_zero_that_homing_cannot_find_explains_why_the_true_error_is_larger(brisk, tmp_path):
    dry = "plant.effects.coulomb_friction.force_n=5"
    stuck, _ = fast_run(tmp_path, *BRISK, "--set", dry)
    said = [format_terminal(report_run(figures, "qsmc")) for figures in (stuck, brisk[0])]
    told = ["friction or creep lets it rest elsewhere" in text for text in said]
    assert told == [True, False]


def test_a_bad_line_of_a_file_is_named_with_its_place(tmp_path):
    (tmp_path / "mine.yaml").write_text(
        "law: pid\nlength_unit: mm\nlpf2_hz: 1e2\n"
        "kp_v_per_length: 1e-1\nki_v_per_length_s: -2\nkd_v_s_per_length: 0\n"
    )
    done = pamctl("run", "--controller", "mine.yaml", cwd=tmp_path)
    assert done.returncode == 78
    said = "mine.yaml:5:1: controller.ki_v_per_length_s: must be at least 0 (got -2)"
    assert done.stderr.strip() == said


@pytest.mark.long
def test_a_log_on_a_full_disk_ends_the_run_and_is_complete_to_its_last_tick(tmp_path):
    if os.geteuid():
        pytest.skip("mounting a small file system needs root")
    small = tmp_path / "small"
    small.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=14m", "tmpfs", small], check=True)
    try:
        done = pamctl(
            "run", "--fast", "--experiment", "tracking-1", "--log", "small/run.mcap", cwd=tmp_path
        )
        assert done.returncode == 1
        assert "disk is full" in done.stderr
        log = read(small / "run.mcap")
        assert np.array_equal(log["tick"], np.arange(len(log)))
        assert outcome(log)["reason"] == "the log's disk is full"
        assert log["phase"][-1] == Phase.STOPPING
    finally:
        subprocess.run(["umount", small], check=True)


def test_the_mode_require_fails_if_real_time_scheduling_is_refused(tmp_path):
    if os.geteuid():
        pytest.skip("giving up privileges needs root")
    # Without CAP_SYS_NICE and CAP_IPC_LOCK root is refused like anyone else.
    drop = ["setpriv", "--bounding-set", "-sys_nice,-ipc_lock", "--inh-caps", "-all"]
    options = ["--rt", "require", "--log", "run.mcap", "--quiet", *ON_OUR_DEVICE]
    command = [*drop, PAMCTL, "run", *options]
    done = run_process(command, cwd=tmp_path)
    assert done.returncode == 69
    assert "fifo: " in done.stderr


def test_a_closed_terminal_stops_a_run_smoothly_with_129(tmp_path):
    ours, its = os.openpty()
    front = subprocess.Popen(
        [PAMCTL, "run", "--log", "run.mcap", *ON_OUR_DEVICE],
        cwd=tmp_path,
        stdin=its,
        stdout=its,
        stderr=its,
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    )
    os.close(its)
    try:
        await_ticks(front, 200)
        os.close(ours)
        front.wait(PATIENCE_S)
    finally:
        front.kill()
        front.wait()
    assert front.returncode == 129
    log = read(tmp_path / "run.mcap")
    assert log["phase"][-1] == Phase.STOPPING
    assert outcome(log)["code"] == 129


def test_the_second_of_fifty_ctrl_c_stops_at_once_and_leaves_the_summary_whole(tmp_path):
    with running(tmp_path, "--set", "rig.loop.stop_ramp_s=5") as front:
        await_ticks(front, 200)
        front.send_signal(signal.SIGINT)
        await_phase(front.pid, Phase.STOPPING)
        for _ in range(49):
            front.send_signal(signal.SIGINT)
            time.sleep(0.01)
        told, said = front.communicate(timeout=PATIENCE_S)
    assert front.returncode == 130
    assert "log: " in told
    assert "Traceback" not in said
    log = read(tmp_path / "run.mcap")
    assert outcome(log)["code"] == 130
    assert 0 < np.count_nonzero(log["phase"] == Phase.STOPPING) < 4900


def test_a_limit_of_open_files_that_is_too_low_is_one_line(tmp_path):
    most = 16
    command = f"ulimit -n {most} && exec {sys.executable} -m pamctl run --log {tmp_path}/run.mcap"
    done = run_process(["sh", "-c", command], cwd=tmp_path)
    assert done.returncode == 69
    assert done.stderr.count("\n") == 1
    assert f"may open only {most} files" in done.stderr
    assert not (tmp_path / "run.mcap").exists()
