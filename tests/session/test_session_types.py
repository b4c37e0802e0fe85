"""A user's script passes `mypy --strict`, and its mistakes do not."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from support.command_line import run_process

ROOT = Path(__file__).resolve().parents[2]

SCRIPT = """
import asyncio
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import pamctl


def steer(rig: pamctl.SteeredRig) -> pamctl.Run:
    rig.goto(12e-3, within_s=2)
    rig.set(lambda_per_s=90, ramp_s=1)
    log: Path = rig.start(pamctl.Chirp(amplitude_mm=1, start_hz=0.5, end_hz=8, duration_s=20))
    for tick in rig.live(rate_hz=10, duration_s=3):
        print(tick["position_m"] * 1e3, log)
    rig.mark("half way")
    parts = [pamctl.Move(to_mm=9, duration_s=1), pamctl.Pause(duration_s=2)]
    rig.run(pamctl.MotionSequence(parts=parts))
    return rig.run("sine", duration_s=5)


with pamctl.connect() as here, pamctl.simulate("paper", controller="pid") as there:
    error_m: NDArray[np.float64] = steer(here).error_m - steer(there).error_m
    try:
        there.run(pamctl.Sine(amplitude_mm=2, frequency_hz=1))
    except pamctl.PamctlError as error:
        print(error.fix, int(error.exit_code), error.log)


async def wait() -> float:
    async with pamctl.aio.connect("/tmp/sock") as rig:
        await rig.goto(12e-3)
        run = await rig.run(pamctl.Sine(amplitude_mm=2, frequency_hz=1))
        async for tick in rig.live(20):
            print(tick["pressure_pa"])
    return run.metrics.rms_error_m


asyncio.run(wait())
"""
WRONG = """
import pamctl

with pamctl.simulate("paper") as rig:
    rig.goto("12mm")
    pamctl.Sine(amplitude=2, frequency_hz=1)
    rig.run(3)
    rig.metrics
"""


@pytest.mark.long
def test_a_strict_script_has_no_error_and_a_wrong_one_has_each(tmp_path: Path) -> None:
    right, wrong = tmp_path / "right.py", tmp_path / "wrong.py"
    right.write_text(SCRIPT)
    wrong.write_text(WRONG)
    # With the house's own settings, which are strict, its cache serves here too.
    settings = ["--config-file", str(ROOT / "pyproject.toml"), "--strict"]
    command = [sys.executable, "-m", "mypy", *settings, str(right), str(wrong)]
    done = run_process(command, cwd=ROOT)
    lines = [line for line in done.stdout.splitlines() if ": error:" in line]
    assert not [line for line in lines if "right.py" in line], done.stdout
    found = {int(line.split(":")[1]) for line in lines if "wrong.py" in line}
    assert found == {5, 6, 7, 8}, done.stdout
