"""Experiments made of forms on the daemon: keys from the command line, marks, gains of a run."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.command_line import run_pamctl
from support.processes.daemons import Daemon, daemon, parked, run_to_its_end

from pamctl.daemon.client import DaemonDeclinedError
from pamctl.log import read
from pamctl.replay import replay_log


@pytest.fixture(scope="module")
def up(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    with daemon(tmp_path_factory.mktemp("motions"), "motions") as made:
        yield made


def start(up: Daemon, *arguments: str) -> subprocess.CompletedProcess[str]:
    return run_pamctl("start", "--socket", up.socket, *arguments)


@pytest.mark.long
def test_a_sine_starts_with_keys_from_the_command_line_and_replays(up: Daemon) -> None:
    keys = ("--set", "amplitude_mm=2", "--set", "frequency_hz=1", "--set", "experiment.cycles=2")
    done = start(up, "sine", *keys, "--json")
    assert done.returncode == 0, done.stderr
    parked(up)
    log = read(json.loads(done.stdout)["log"])
    assert log.config["experiment"]["amplitude_mm"] == 2
    assert np.nanmax(log["reference_m"]) == pytest.approx(11.8e-3 + 2e-3, abs=1e-5)
    assert replay_log(log).is_equal


def test_a_key_that_a_form_lacks_or_a_motion_beyond_the_stroke_starts_nothing(up: Daemon) -> None:
    typo = start(up, "sine", "--set", "amplitude_v=2")
    assert typo.returncode == 78
    assert "did you mean 'amplitude_mm'" in typo.stderr
    far = start(up, "sine", "--set", "offset_mm=31")
    assert far.returncode != 0
    assert "a position of 33" in far.stderr
    assert up.state() in ("idle", "ready")


@pytest.mark.long
def test_gains_of_a_sequence_end_with_its_run(up: Daemon) -> None:
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


def test_the_largest_table_fits_into_a_request(up: Daemon, tmp_path: Path) -> None:
    t_s = np.arange(8000) * 1.2345e-3
    values = 9.0 + np.sin(t_s * 2 * np.pi / t_s[-1] - np.pi / 2) + 1e-7 * np.sin(997 * t_s)
    rows = "\n".join(f"{t:.9f},{x:.9f}" for t, x in zip(t_s, values, strict=True))
    (tmp_path / "points.csv").write_text(f"time_s,position_mm\n{rows}\n")
    (tmp_path / "mine.yaml").write_text("kind: table\nfile: points.csv\n")
    done = start(up, str(tmp_path / "mine.yaml"), "--duration", "1")
    assert done.returncode == 0, done.stderr
    parked(up)


def test_a_request_without_the_points_of_its_file_is_refused(up: Daemon) -> None:
    with pytest.raises(DaemonDeclinedError, match="two points at least"):
        up.ask("start", experiment={"kind": "table", "file": "points.csv"}, name="table")
