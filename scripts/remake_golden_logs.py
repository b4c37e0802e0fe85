"""Make the golden logs of tests/golden/ again: real runs, each replayed before it is kept.

    python scripts/remake_golden_logs.py [NAME...]

Run it when the tick or the format of a log changes on purpose: `pamctl replay` holds every later
version to these logs. The card's log needs gcc.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from pamctl.base.errors import ExitCode
from pamctl.log import read
from pamctl.offline.tick_replay import replay_log
from pamctl.processes.backends import SHARED_MEMORY
from pamctl.recording.ring import Ring

ROOT = Path(__file__).resolve().parent.parent
GOLDEN = Path("tests/golden")
LARGEST_BYTES = 250_000


class Recipe(NamedTuple):
    """One run; Ctrl-C stops it at the tick `interrupt_at`."""

    arguments: tuple[str, ...]
    ends_with: ExitCode = ExitCode.OK
    interrupt_at: int | None = None
    on_card: bool = False


def make_overrides(**keys: object) -> tuple[str, ...]:
    """Write `--set section.key=value` for `section__key=value`."""
    return tuple(
        word
        for key, value in keys.items()
        for word in ("--set", f"{key.replace('__', '.')}={value}")
    )


TRACKING = ("--experiment", str(GOLDEN / "tracking.yaml"))
SIMULATED = ("--rig", str(GOLDEN / "rig.yaml"))
FAST = (*SIMULATED, "--fast")
ON_CARD = ("--rig", str(GOLDEN / "card.yaml"), "--rt", "off")
QSMC = ("--controller", "qsmc", *make_overrides(controller__lpf1_hz=200))
SHORTER = make_overrides(
    experiment__transition_s=0.25,
    experiment__approach_s=0.25,
    experiment__settle_s=0.05,
    experiment__rest_s=0.05,
)


def fault(kind: str, from_tick: int, ticks: int = 1_000_000, size: float = 0.0) -> str:
    return f"{{kind: {kind}, from_tick: {from_tick}, ticks: {ticks}, size: {size}}}"


SLOW_READS = [fault("slow_read", at, 1, 0.005 + 1e-5 * at) for at in range(40, 900, 95)]

RECIPES: Mapping[str, Recipe] = {
    "qsmc": Recipe((*FAST, *TRACKING, *QSMC)),
    # Only the sign of Eq. 15, in counts of the other direction, until it chatters.
    "qsmc-chatter": Recipe(
        (
            *(*FAST, *TRACKING, *QSMC),
            *make_overrides(
                controller__reaching_law="eta", controller__eta=2e6, controller__phi=20
            ),
            *make_overrides(rig__calibration__encoder_sign=-1),
        )
    ),
    "smc": Recipe(
        (
            *FAST,
            *TRACKING,
            *SHORTER,
            "--controller",
            "smc",
            *make_overrides(rig__loop__rate_hz=1000),
        )
    ),
    "pid-delayed": Recipe(
        (
            *(*FAST, *TRACKING, "--controller", "pid", "--plant", "paper-valve109"),
            *make_overrides(controller__lpf1_hz=200, controller__lpf2_hz=200),
            *make_overrides(rig__sim__output_delay_ticks=1),
        )
    ),
    "steps": Recipe((*FAST, "--experiment", str(GOLDEN / "steps.yaml"), *QSMC)),
    "readonly": Recipe((*FAST, *TRACKING, *QSMC, "--readonly", "--duration", "0.5")),
    "trip-wire": Recipe(
        (*FAST, *TRACKING, *QSMC, *make_overrides(rig__faults=f"[{fault('broken_wire', 500)}]")),
        ends_with=ExitCode.SAFETY_TRIP,
    ),
    "trip-nan": Recipe(
        (*FAST, *TRACKING, *QSMC, *make_overrides(rig__faults=f"[{fault('pressure_nan', 450)}]")),
        ends_with=ExitCode.SAFETY_TRIP,
    ),
    "missed": Recipe(
        (
            *(*SIMULATED, *TRACKING, *QSMC),
            *make_overrides(experiment__cycles=50, rig__faults=f"[{', '.join(SLOW_READS)}]"),
        ),
        ends_with=ExitCode.SIGINT,
        interrupt_at=900,
    ),
    "card": Recipe((*ON_CARD, *TRACKING, *QSMC), on_card=True),
    "card-clocked": Recipe(
        (*ON_CARD, *TRACKING, *QSMC, *make_overrides(rig__nidaq__timing="hardware_timed")),
        on_card=True,
    ),
}


def environment_of(recipe: Recipe, directory: Path) -> dict[str, str]:
    """Return the environment of a run; for the card: the stand-in's driver, and a card."""
    if not recipe.on_card:
        return dict(os.environ)
    sys.path.insert(0, str(ROOT / "tests"))
    from standin.standin import Card

    return dict(Card(directory / "registers").environment())


def run(recipe: Recipe, log: Path, environment: Mapping[str, str]) -> int:
    """Run to the end; return the exit code."""
    command = [sys.executable, "-m", "pamctl", "run", "--quiet", "--log", str(log)]
    with subprocess.Popen(
        [*command, *recipe.arguments], cwd=ROOT, env=environment, stdout=subprocess.DEVNULL
    ) as process:
        if recipe.interrupt_at is not None:
            interrupt(process, recipe.interrupt_at)
        return process.wait(timeout=120)


def interrupt(process: subprocess.Popen[bytes], tick: int) -> None:
    """Press Ctrl-C in a tick of the run."""
    while not (found := list(SHARED_MEMORY.glob(f"pamctl-{process.pid}-*.ring"))):
        if process.poll() is not None:
            return
        time.sleep(0.01)
    with Ring.attach(found[0]) as ring:
        while process.poll() is None and (ring.latest_tick() or {"tick": -1})["tick"] < tick:
            time.sleep(0.001)
    process.send_signal(signal.SIGINT)


def complaint(recipe: Recipe, code: int, log: Path) -> str:
    """Return the problem of a fresh log; empty if it may be kept."""
    if code != recipe.ends_with:
        return f"ended with {code} instead of {int(recipe.ends_with)}"
    found = replay_log(read(log))
    if not found.is_equal:
        return f"does not replay: {found.differences[:1]}"
    if log.stat().st_size > LARGEST_BYTES:
        return f"has {log.stat().st_size} bytes, more than {LARGEST_BYTES}"
    return ""


def remake(name: str) -> str:
    """Make one log and keep it; return the problem, empty if there is none."""
    with tempfile.TemporaryDirectory() as directory:
        fresh = Path(directory) / f"{name}.mcap"
        recipe = RECIPES[name]
        code = run(recipe, fresh, environment_of(recipe, Path(directory)))
        if not fresh.exists():
            return "left no log"
        wrong = complaint(recipe, code, fresh)
        if not wrong:
            shutil.copy(fresh, ROOT / GOLDEN)
        return wrong


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(RECIPES), metavar="NAME")
    failures = 0
    for name in parser.parse_args().names:
        wrong = remake(name)
        failures += bool(wrong)
        kept = ROOT / GOLDEN / f"{name}.mcap"
        print(f"{name}: {wrong or f'{len(read(kept))} ticks, {kept.stat().st_size} bytes'}")
    return failures


if __name__ == "__main__":
    sys.exit(main())
