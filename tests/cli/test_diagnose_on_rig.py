"""What `pamctl diagnose --on-rig` refuses, and what its gains on trial leave behind."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from support.processes.daemons import daemon
from typer.testing import CliRunner

import pamctl
from pamctl.cli.app import app
from pamctl.exit_codes import ExitCode


@pytest.mark.parametrize(
    ("words", "said", "code"),
    [
        (["a.mcap", "--runs", "3"], "is for --on-rig", ExitCode.USAGE),
        ([], "at least one log", ExitCode.USAGE),
        (["--on-rig", "--holdout", "b.mcap"], "no effect with --on-rig", ExitCode.USAGE),
        (["--on-rig", "--then", "fly"], "give tune", ExitCode.USAGE),
        (["--on-rig", "--socket", "none.sock"], "no daemon listens", ExitCode.UNAVAILABLE),
    ],
)
def test_one_clear_error_and_nothing_is_written(
    words: list[str],
    said: str,
    code: ExitCode,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["diagnose", "--out", "out", *words])
    assert result.exit_code == code
    assert said in " ".join(result.output.split())
    assert not any(tmp_path.iterdir())


CLIENT = """
import sys
import pamctl
rig = pamctl.connect(sys.argv[1])
rig.load({**rig.gains, "lambda_per_s": 12.0}, trial_s=float(sys.argv[2]))
print("loaded", flush=True)
rig.sleep(600.0)
"""


def test_gains_on_trial_go_when_nobody_is_left_to_keep_them(tmp_path: Path) -> None:
    with daemon(tmp_path, "trial") as made:
        shipped = made.ask("status")
        command = [sys.executable, "-c", CLIENT, str(made.socket), "0.2"]
        client = subprocess.Popen(command, stdout=subprocess.PIPE)
        assert client.stdout is not None
        assert client.stdout.readline() == b"loaded\n"
        client.kill()
        client.wait()
        client.stdout.close()
        after = made.wait_until(lambda status: not status["gains_on_trial"])
        assert after["controller"] == shipped["controller"]
        assert after["names"] == shipped["names"]


@pytest.mark.long
def test_gains_on_trial_stay_through_a_run_and_for_good_once_confirmed(tmp_path: Path) -> None:
    with daemon(tmp_path, "kept") as made, pamctl.connect(made.socket) as rig:
        trial = {**rig.gains, "lambda_per_s": 12.0}
        rig.load(trial, trial_s=0.2)
        rig.goto(8e-3, within_s=0.5)  # homing and the motion last longer than the trial
        assert rig.status()["gains_on_trial"]
        assert rig.gains == trial
        rig.load(trial)
        assert not rig.status()["gains_on_trial"]
        rig.stop()
        rig.sleep(0.5)
        assert rig.gains == trial
