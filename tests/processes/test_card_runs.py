"""`pamctl run` on the card, from the command to the log, over the stand-in driver."""

from __future__ import annotations

import json
import os
import signal
import subprocess

import numpy as np
import pytest
from standin.standin import PERMIT, Card, library
from support.card_rigs import READ_VOLTS
from support.patience import PATIENCE_S
from support.processes.card_runs import (
    AT_ONCE,
    OWN_SAFE_V,
    RUN,
    await_writes,
    log_of,
    of,
    own,
    start,
)
from support.processes.children import await_children
from support.runs import AO_STEP_V

from pamctl.signals import Phase

assert own  # a fixture


@pytest.mark.long
def test_a_run_on_the_card_is_complete_and_ends_at_the_safe_voltage(own: Card) -> None:
    # In the plainest of locales: every name handed to the driver must survive it.
    process = start(own, "--duration", "1", "--json", LC_ALL="C")
    said, complaints = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, complaints
    report = json.loads(said)
    assert report["log_is_whole"]
    assert report["backend"] == "nidaq"

    assert own.written_v[-1] == own.output_v == pytest.approx(OWN_SAFE_V, abs=AO_STEP_V)
    log = log_of(own)
    assert log["phase"][-1] == Phase.STOPPING
    assert np.ptp(log["t_s"][log["phase"] == Phase.APPROACH]) > 0.5
    identity = log.metadata["rig"]
    assert identity["library"] == str(library())
    assert identity["serial_number"] == "DECAF"
    # Every tick's write is on record as the card saw it: the last ones, whole.
    last_writes = own.written_v[-20:-4]
    applied = log["applied_v"].tolist()
    found = [applied[at : at + 16] == last_writes for at in range(len(applied) - 16, 0, -1)]
    assert any(found[:16])


def test_ctrl_c_leaves_the_card_safe_and_its_driver_s_threads_were_raised_and_unpinned(
    own: Card,
) -> None:
    """Else a killed loop frees the card only when its busy CPU gets round to them."""
    process = start(own, *AT_ONCE)
    await_writes(own, process, 300)
    loop = await_children(process.pid, "loop_main")["loop_main"]
    tasks = [int(task) for task in os.listdir(f"/proc/{loop}/task")]
    own_cpus = os.sched_getaffinity(loop)
    found = [
        (os.sched_getscheduler(task) & 0xFFFF, os.sched_getaffinity(task))
        for task in tasks
        if task != loop
    ]
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert own.output_v == pytest.approx(OWN_SAFE_V, abs=AO_STEP_V)
    assert log_of(own)["phase"][-1] == Phase.STOPPING
    (noted,) = (e for e in log_of(own).events if e["event"] == "foreign_threads")
    if os.geteuid() or os.sched_getaffinity(0) == own_cpus or not noted["done"]:
        pytest.skip("needs two CPUs and SCHED_FIFO, which only root is sure to be allowed")
    assert found == [(os.SCHED_FIFO, os.sched_getaffinity(0))] * 4


@pytest.mark.long
def test_when_the_loop_freezes_the_guardian_takes_the_card_over(own: Card) -> None:
    process = start(own, *AT_ONCE)
    await_writes(own, process, 700)
    loop = await_children(process.pid, "loop_main")["loop_main"]
    os.kill(loop, signal.SIGSTOP)
    _, complaints = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert "the guardian drove the safe voltage" in complaints
    assert own.output_v == pytest.approx(OWN_SAFE_V, abs=AO_STEP_V)
    assert any(event["event"] == "guardian_takeover" for event in log_of(own).events)


@pytest.mark.long
def test_a_card_that_fails_in_the_middle_of_a_run_ends_it_with_69_and_safe(own: Card) -> None:
    own.fail(READ_VOLTS, -201003, after=700, times=1)
    process = start(own, *AT_ONCE)
    _, complaints = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 69, complaints
    assert "device error -201003" in complaints
    assert "nilsdev" in complaints
    assert "Traceback" not in complaints
    assert own.output_v == pytest.approx(OWN_SAFE_V, abs=AO_STEP_V)
    log = log_of(own)
    assert 650 < len(log) <= 701
    assert next(e for e in log.events if e["event"] == "outcome")["code"] == 69


def test_a_broken_wire_trips_the_run_on_the_card(own: Card) -> None:
    process = start(own, *AT_ONCE)
    await_writes(own, process, 300)
    own.registers.wire_is_broken = 1
    _, complaints = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 4
    assert "broken wire" in complaints
    assert own.output_v == pytest.approx(OWN_SAFE_V, abs=AO_STEP_V)


@pytest.mark.parametrize(
    ("arguments", "environment", "complaint"),
    [
        ([], {PERMIT: None}, "stand-in driver of pamctl's tests"),
        (["--set", "rig.nidaq.device=Dev9"], {}, "nilsdev"),
        ([], {"LD_LIBRARY_PATH": None}, "install NI-DAQmx"),
    ],
)
def test_a_card_that_cannot_be_had_is_refused_before_anything_is_touched(
    own: Card, arguments: list[str], environment: dict[str, None], complaint: str
) -> None:
    within = {k: v for k, v in own.environment().items() if k not in environment}
    done = subprocess.run(
        [*RUN, *of(own), *arguments],
        cwd=own.path.parent / "cwd",
        env=within,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 69
    assert complaint in done.stderr
    assert "Traceback" not in done.stderr
    assert own.output_v == 8.0
    assert not list((own.path.parent / "cwd").iterdir())


def test_a_broken_env_file_beside_the_run_is_named_as_the_culprit(own: Card) -> None:
    (own.path.parent / "cwd" / ".env").write_bytes(b"\xff\xfe")
    process = start(own, *AT_ONCE)
    _, complaints = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 69
    assert "a broken .env" in complaints
    assert "Traceback" not in complaints
