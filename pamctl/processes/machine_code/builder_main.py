"""Builds machine code, once: `python -m pamctl.processes.machine_code.builder_main`.

The front starts it with the settings of its run on standard input. It outlives the front, and
nobody waits for it.
"""

from __future__ import annotations

import fcntl
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

from hal.sim.sim_rig import SimRig
from pamctl.compiled_ahead.layout import NotFlat
from pamctl.control.law import KERNELS, answer
from pamctl.plant.model import plant_parameters
from pamctl.plant.native_plant import PlantWords, advance_and_sense
from pamctl.plant.parameters import PlantParameters
from pamctl.processes.backends import build_clock, build_rig
from pamctl.processes.machine_code.libraries import (
    find_leap_library,
    find_plant_library,
    find_tick_library,
    may_be_native,
)
from pamctl.processes.machine_code.old_libraries import remove_old_libraries
from pamctl.realtime.tick import TickSetup
from pamctl.realtime.tick_words import TickWords
from pamctl.realtime.whole_tick import run_whole_tick
from pamctl.settings.build import build_tick_setup
from pamctl.settings.resolve import from_resolved
from pamctl.simulate.leap import LeapWords, may_leap, run_simulated_tick


def main() -> None:
    """Build once; other builders of the same code leave it to this one."""
    _take_only_idle_time()
    settings = from_resolved(sys.stdin.read())
    setup = build_tick_setup(settings)
    _build_once(find_tick_library(setup), partial(build_tick_library, setup))
    if may_be_native(settings):
        parameters = plant_parameters(settings.plant)
        with suppress(NotFlat):
            path = find_plant_library(parameters)
            _build_once(path, partial(build_plant_library, parameters))
    rig = build_rig(settings, build_clock(settings, may_spin=False)).rig if settings.fast else None
    if isinstance(rig, SimRig) and may_leap(rig):
        _build_once(find_leap_library(setup, rig), partial(build_leap_library, setup, rig))
    remove_old_libraries(find_tick_library(setup).parent)


def _build_once(path: Path, build: Callable[[Path], None]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path.with_suffix(".lock"), "w") as lock, suppress(BlockingIOError):
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not path.exists():
            _build(build, path)


def _take_only_idle_time() -> None:
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


def _build(build: Callable[[Path], None], path: Path) -> None:
    try:
        build(path)
    except Exception as error:  # whatever the compiler says: the next run must be able to tell it
        reason = str(error).strip().partition("\n")[0]
        path.with_suffix(".failed").write_text(f"{type(error).__name__}: {reason}")


def build_tick_library(setup: TickSetup, path: Path) -> None:
    """Build the machine code of a set-up's tick."""
    from pamctl.compiled_ahead.emit import build_library

    source, names = TickWords(setup).write_glue()
    law = KERNELS[type(setup.gains)]
    build_library(source, run_whole_tick, names, "idbd", path, (answer, law))


def build_plant_library(parameters: PlantParameters, path: Path) -> None:
    """Build the machine code of a plant."""
    from pamctl.compiled_ahead.emit import build_library

    source, names = PlantWords(parameters).write_glue()
    build_library(source, advance_and_sense, names, "id", path)


def build_leap_library(setup: TickSetup, rig: SimRig, path: Path) -> None:
    """Build the machine code of many ticks over a simulated rig."""
    from pamctl.compiled_ahead.emit import build_library

    source, names = LeapWords(setup, rig).write_leap()
    law = KERNELS[type(setup.gains)]
    build_library(source, run_simulated_tick, names, "idbdd", path, (answer, law))


if __name__ == "__main__":
    main()
