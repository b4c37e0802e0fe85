"""`pamctl run` over the stand-in card, as processes."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from standin.standin import Card, here

from pamctl.processes.backends import SHARED_MEMORY
from support.command_line import start_process
from support.patience import BUSY_PC, PATIENCE_S

PAMCTL = str(Path(sys.executable).with_name("pamctl"))
PATIENT = [p for one in BUSY_PC for p in ("--set", one)]
RUN = [PAMCTL, "run", "--backend", "nidaq", "--quiet", "--log", "run.mcap", *PATIENT]
AT_ONCE = ("--set", "rig.homing.enabled=false")
OWN_SAFE_V = 0.625


@pytest.fixture
def own(tmp_path: Path) -> Iterator[Card]:
    """A card of its own name that this process does not drive; its output was left at 8 V."""
    here()  # for the compiler
    (tmp_path / "cwd").mkdir()
    own = Card(tmp_path / "registers", f"Dev{os.getpid()}x{random.randrange(10**6)}")
    own.registers.ao_v[0] = 8.0
    yield own
    (SHARED_MEMORY / f"pamctl-{own.name}.lock").unlink(missing_ok=True)


def of(own: Card) -> tuple[str, str]:
    """The option that makes a run drive this card."""
    return "--set", f"rig.nidaq.device={own.name}"


def start(own: Card, *arguments: str, **environment: str) -> subprocess.Popen[str]:
    return start_process(
        [*RUN, *of(own), "--set", f"rig.safe_volts={OWN_SAFE_V}", *arguments],
        cwd=own.path.parent / "cwd",
        env={**own.environment(), **environment},
    )


def await_writes(own: Card, process: subprocess.Popen[str], writes: int) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while own.registers.ao_writes < writes:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline_s, "the loop does not write"
        time.sleep(0.02)


def log_of(own: Card):
    from pamctl.log.reader import read

    return read(own.path.parent / "cwd" / "run.mcap")
