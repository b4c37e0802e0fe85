"""The tick as machine code: find it for a run, have it built, or say why there is none."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from hal.rig import Rig
from hal.sim.sim_rig import SimRig
from pamctl.code_folder.find_code_folder import explain_unwritable
from pamctl.compiled_ahead.layout import NotFlat
from pamctl.compiled_ahead.library import (
    FORBIDDEN,
    KernelLibrary,
    find_library_path,
    find_linker,
    hash_module,
)
from pamctl.control.law import KERNELS
from pamctl.plant.model import plant_parameters
from pamctl.plant.native_plant import NativePlant, PlantWords
from pamctl.plant.parameters import PlantParameters
from pamctl.plant.simulated import SimulatedPlant
from pamctl.processes.backends import build_clock, build_rig
from pamctl.processes.machine_code.old_libraries import touch_library
from pamctl.realtime.clock import Clock, VirtualClock
from pamctl.realtime.tick import TickSetup
from pamctl.realtime.tick_path import PlainTick, TickPath, load_compiled_tick
from pamctl.realtime.tick_words import TickWords
from pamctl.settings.build import build_tick_setup
from pamctl.settings.resolve import RunSettings, settings_to_json
from pamctl.simulate.leap import Leap, LeapWords, may_leap

_IN_WORDS = {"tick": "the tick", "plant": "the simulated plant", "leap": "the run as a whole"}
"""What runs in plain Python where a library is missing, by the first word of the file's name."""


def find_tick_library(setup: TickSetup) -> Path:
    """Return where the machine code of a set-up's tick is, or will be. Raises `NotFlat`."""
    source, names = TickWords(setup).write_glue()
    return _find(setup, "tick", source, names)


def _find(setup: TickSetup, name: str, source: str, names: dict[str, type]) -> Path:
    kernel = KERNELS[type(setup.gains)]
    outside = hash_module(sys.modules[kernel.__module__])
    parts = (source, repr(names), kernel.__module__, outside)
    return find_library_path(f"{name}-{kernel.__name__}", *parts)


def load_tick(setup: TickSetup) -> tuple[TickPath, str]:
    """Return the fastest tick there is, and what it is in words for the log."""
    try:
        return load_compiled_tick(find_tick_library(setup), setup), "machine code"
    except (NotFlat, OSError, AttributeError):
        return PlainTick(), "plain Python"


def find_leap_library(setup: TickSetup, rig: SimRig) -> Path:
    """Return where the machine code of many ticks is, or will be. Raises `NotFlat`."""
    source, names = LeapWords(setup, rig).write_leap()
    return _find(setup, "leap", source, names)


def load_leap(setup: TickSetup, rig: Rig, clock: Clock) -> tuple[TickPath, Leap | None]:
    """Return the fastest tick for a run without a clock, and what runs many of them at once."""
    if isinstance(rig, SimRig) and isinstance(clock, VirtualClock) and may_leap(rig):
        with suppress(NotFlat, OSError, AttributeError):
            words = LeapWords(setup, rig)
            tick = load_compiled_tick(find_tick_library(setup), setup, words)
            library = KernelLibrary(find_leap_library(setup, rig))
            return tick, Leap(library, words, rig, clock)
    return load_tick(setup)[0], None


def find_plant_library(parameters: PlantParameters) -> Path:
    """Return where the machine code of a plant is, or will be. Raises `NotFlat`."""
    source, names = PlantWords(parameters).write_glue()
    return find_library_path("plant", source, repr(names))


def load_plant(settings: RunSettings) -> SimulatedPlant | None:
    """Return the plant of a simulated rig as machine code, if there is any."""
    if not may_be_native(settings):
        return None
    parameters = plant_parameters(settings.plant)
    with suppress(NotFlat, OSError, AttributeError):
        return NativePlant(KernelLibrary(find_plant_library(parameters)), parameters)
    return None


def may_be_native(settings: RunSettings) -> bool:
    """Tell whether a run in real time has a plant that machine code can advance."""
    if settings.fast or not settings.rig.record.is_simulated:
        return False
    return not SimulatedPlant(plant_parameters(settings.plant)).is_delayed


def list_libraries(settings: RunSettings) -> list[Path]:
    """List the machine code that a run can use. Raises `NotFlat`."""
    setup = build_tick_setup(settings)
    libraries = [find_tick_library(setup)]
    if may_be_native(settings):
        with suppress(NotFlat):
            libraries.append(find_plant_library(plant_parameters(settings.plant)))
    if settings.fast:
        rig = build_rig(settings, build_clock(settings, may_spin=False)).rig
        if isinstance(rig, SimRig) and may_leap(rig):
            with suppress(NotFlat):  # a plant with correction tables
                libraries.append(find_leap_library(setup, rig))
    return libraries


def start_building(settings: RunSettings) -> str:
    """Build what is missing, in the background; return a note for the user, or nothing.

    The builder outlives this process. It takes only time that nobody else wants.
    """
    if os.environ.get(FORBIDDEN) or sys.platform != "linux":
        return ""
    try:
        libraries = list_libraries(settings)
    except NotFlat as error:
        return f"the tick runs in plain Python: {error}"
    for path in libraries:
        touch_library(path)
    missing = [path for path in libraries if not path.exists()]
    if not missing:
        return ""
    what = _IN_WORDS[missing[0].name.partition("-")[0]]
    for path in missing:
        failed = path.with_suffix(".failed")
        with suppress(OSError):
            return (
                f"{what} runs in plain Python, its machine code cannot be built: "
                f"{failed.read_text()}; remove {failed} to try again"
            )
    if find_linker() is None:
        return f"{what} runs in plain Python: machine code needs a C compiler, install gcc"
    if why := explain_unwritable(missing[0].parent):
        return f"{what} runs in plain Python, machine code cannot be kept: {why}"
    builder = subprocess.Popen(
        [sys.executable, "-m", "pamctl.processes.machine_code.builder_main"],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    assert builder.stdin is not None
    with suppress(BrokenPipeError), builder.stdin as sink:
        sink.write(settings_to_json(settings).encode())
    return (
        f"{what} runs in plain Python this time: its machine code is being built in the "
        "background, once (a minute or less)"
    )
