"""Faults that need real processes, over the card's stand-in: `pamctl run` from end to end.

After each: the output at the safe voltage, the log complete to its last tick, the exit code as
documented, the next start clean. Made-up time and the other faults: `test_faults.py`.
"""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
from standin.standin import PERMIT, Card
from support.card_rigs import READ_VOLTS
from support.patience import PATIENCE_S
from support.processes.card_runs import (
    AT_ONCE,
    OWN_SAFE_V,
    PAMCTL,
    await_writes,
    log_of,
    own,
    start,
)
from support.processes.children import PARTS, await_children
from support.processes.killing import kill_as_one
from support.runs import AO_STEP_V

from pamctl.log.reader import Log
from pamctl.signals import Phase

assert own  # a fixture

PACED_BY_THE_CARD = ("--set", "rig.nidaq.timing=hardware_timed")
MOVING = 300
"""Writes after which the valve is off its safe voltage."""


def assert_left_in_order(card: Card, process: subprocess.Popen[str], code: int) -> str:
    """Check what must hold after every end; return what was said of it."""
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == code, said
    assert card.output_v == pytest.approx(OWN_SAFE_V, abs=AO_STEP_V)
    log = log_of(card)
    assert np.array_equal(np.diff(log["tick"]) - 1, log["missed"][1:])
    assert [event["event"] for event in log.events].count("outcome") == 1
    assert len(log) > MOVING // 2
    return said


def assert_next_start_is_clean(card: Card) -> None:
    card.mend()
    (card.path.parent / "cwd" / "run.mcap").unlink()
    process = start(card, *AT_ONCE, *PACED_BY_THE_CARD, "--duration", "0.1")
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, said
    assert card.output_v == pytest.approx(OWN_SAFE_V, abs=AO_STEP_V)


def child_of(front: subprocess.Popen[str], name: str) -> int:
    return await_children(front.pid, name)[name]


@pytest.mark.long
def test_a_driver_that_never_returns_is_killed_with_its_loop(own: Card) -> None:
    """The read ignores its timeout and all signals: only the guardian can act."""
    own.fail(READ_VOLTS, hang_s=60.0, is_deaf=True, after=MOVING, times=1)
    process = start(own, *AT_ONCE, *PACED_BY_THE_CARD)
    said = assert_left_in_order(own, process, code=1)
    assert "silent for" in said
    assert "the guardian drove the safe voltage" in said
    assert any(event["event"] == "guardian_takeover" for event in log_of(own).events)
    assert_next_start_is_clean(own)


@pytest.mark.long
def test_a_card_that_is_gone_ends_with_69_its_own_words_and_an_alarm(own: Card) -> None:
    """No software reaches the output then: a person must act."""
    process = start(own, *AT_ONCE)
    await_writes(own, process, MOVING)
    own.registers.is_gone = 1
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 69, said
    next_ones = ("reading the encoder", "reading the pressure sensor", "writing to the valve")
    assert any(call in said for call in next_ones), said
    assert "-201003" in said
    assert "THE SAFE VOLTAGE COULD NOT BE DRIVEN" in said
    assert "cut the air supply" in said


def test_a_loop_paced_by_the_card_that_dies_leaves_it_safe(own: Card) -> None:
    process = start(own, *AT_ONCE, *PACED_BY_THE_CARD, STANDIN_THREADS="0")
    await_writes(own, process, MOVING)
    loop = child_of(process, "loop_main")
    # Python packages start no threads: each would have to die as well.
    assert len(list(Path(f"/proc/{loop}/task").iterdir())) == 1
    os.kill(loop, signal.SIGKILL)
    assert "the guardian drove the safe voltage" in assert_left_in_order(own, process, code=1)


@pytest.mark.long
def test_a_tick_that_takes_too_long_is_recorded_as_missed_and_the_run_goes_on(own: Card) -> None:
    own.fail("DAQmxWriteAnalogScalarF64", hang_s=6.5e-3, is_deaf=True, after=MOVING, times=1)
    process = start(own, *AT_ONCE, "--duration", "0.6")
    assert_left_in_order(own, process, code=0)
    assert log_of(own)["missed"].max() >= 5


def spent_s(log: Log, phase: Phase) -> float:
    """How long a phase took, ticks that were missed in it included."""
    return float(np.sum(log["dt_s"][log["phase"] == phase]))


BUG = """
import sys
if "pamctl.processes.loop_main" in sys.orig_argv:
    from pamctl.realtime import tick
    right, calls = tick.respond, []

    def wrong(*arguments):
        calls.append(None)
        return right(*arguments) if len(calls) < 900 else 1 / 0

    tick.respond = wrong
"""


def test_an_exception_in_the_law_ends_with_1_and_its_name(own: Card, tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(BUG)
    path = os.pathsep.join(filter(None, [str(tmp_path), os.environ.get("PYTHONPATH")]))
    # The wrong law is no kernel.
    changed = {"PYTHONPATH": path, "PAMCTL_PLAIN_PYTHON": "1"}
    process = start(own, *AT_ONCE, **changed)
    assert "ZeroDivisionError" in assert_left_in_order(own, process, code=1)
    log = log_of(own)
    # The law is also called to rehearse: before the rig is open, and before ticks.
    assert 150 < len(log) < 899
    assert log.events[-1]["reason"].startswith("ZeroDivisionError")


@pytest.mark.long
def test_pamctl_safe_drives_the_card_after_everything_was_killed(own: Card) -> None:
    process = start(own, *AT_ONCE, *PACED_BY_THE_CARD)
    await_writes(own, process, MOVING)
    kill_as_one(process.pid, *await_children(process.pid, *PARTS).values())
    process.communicate(timeout=PATIENCE_S)
    assert own.output_v > OWN_SAFE_V + 1.0
    done = subprocess.run(
        [PAMCTL, "safe", "--backend", "nidaq", *start_options(own)],
        env={**own.environment(), PERMIT: "1"}, capture_output=True, text=True, timeout=PATIENCE_S,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert own.output_v == pytest.approx(OWN_SAFE_V, abs=AO_STEP_V)


def start_options(card: Card) -> list[str]:
    return ["--set", f"rig.nidaq.device={card.name}", "--set", f"rig.safe_volts={OWN_SAFE_V}"]
