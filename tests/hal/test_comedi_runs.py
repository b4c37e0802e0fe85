"""`pamctl` on a card behind comedi, from the command to the log, over the stand-in library."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from standin.standin import COMEDI_SONAME, Card, library, require_compiler
from support.command_line import run_process, start_process
from support.patience import BUSY_PC, PATIENCE_S
from support.processes.card_runs import await_writes
from support.processes.children import await_children
from support.runs import AO_STEP_V

from pamctl.log.reader import read
from pamctl.processes.backends import SHARED_MEMORY
from pamctl.signals import Phase

PAMCTL = str(Path(sys.executable).with_name("pamctl"))
SAFE_V = 0.625
safe = pytest.approx(SAFE_V, abs=AO_STEP_V)


@pytest.fixture
def own(tmp_path: Path) -> Iterator[Card]:
    """A card that this process does not drive, of its own name; its output was left at 8 V."""
    require_compiler()
    (tmp_path / "cwd").mkdir()
    own = Card(tmp_path / "registers", f"comedi{os.getpid()}{random.randrange(10**6)}")
    own.registers.ao_v[0] = 8.0
    yield own
    (SHARED_MEMORY / f"pamctl-{own.name}.lock").unlink(missing_ok=True)


def start(own: Card, *command: str, **environment: str | None) -> subprocess.Popen[str]:
    """Start a verb of pamctl on the card; an environment variable that is None is taken away."""
    options = [
        f"rig.comedi.device=/dev/{own.name}",
        f"rig.safe_volts={SAFE_V}",
        "rig.homing.enabled=false",
        *BUSY_PC,
    ]
    changed = {**own.environment(), **environment}
    return start_process(
        [PAMCTL, *command, "--backend", "comedi", *(p for one in options for p in ("--set", one))],
        cwd=own.path.parent / "cwd",
        env={name: value for name, value in changed.items() if value is not None},
    )


RUN = ("run", "--quiet", "--log", "run.mcap")


@pytest.mark.long
def test_a_run_is_complete_ends_at_the_safe_voltage_and_replays_to_the_bit(own: Card) -> None:
    process = start(own, *RUN, "--duration", "1", "--json", LC_ALL="C")
    said, complaints = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, complaints
    report = json.loads(said)
    assert report["log_is_whole"]
    assert report["backend"] == "comedi"
    assert own.written_v[-1] == own.output_v == safe
    log = read(own.path.parent / "cwd" / "run.mcap")
    assert log["phase"][-1] == Phase.STOPPING
    identity = log.metadata["rig"]
    assert identity["library"] == str(library(COMEDI_SONAME))
    assert identity["calibrated_by"] == str(own.calibration_path)
    assert identity["reads_in_one_call"]

    # On a PC without the library and without the card.
    replayed = run_process([PAMCTL, "replay", "run.mcap"], cwd=own.path.parent / "cwd")
    assert replayed.returncode == 0, replayed.stderr
    assert "equal" in replayed.stdout


def test_when_the_loop_dies_the_guardian_takes_the_card_over(own: Card) -> None:
    process = start(own, *RUN)
    await_writes(own, process, 700)
    os.kill(await_children(process.pid, "loop_main")["loop_main"], signal.SIGKILL)
    _, complaints = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert "the guardian drove the safe voltage" in complaints
    assert own.output_v == safe


def test_a_run_without_its_card_leaves_with_69_and_says_what_to_do(own: Card) -> None:
    process = start(own, *RUN, STANDIN_DEVICE=None)
    said, complaints = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 69, said
    assert "modprobe ni_pcimio" in complaints
    assert "Traceback" not in complaints
    assert not (own.path.parent / "cwd" / "run.mcap").exists()


def test_safe_drives_the_safe_voltage_whatever_was_left_on_the_output(own: Card) -> None:
    process = start(own, "safe")
    _, complaints = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, complaints
    assert own.output_v == safe
