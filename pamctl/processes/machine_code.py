"""The tick as machine code: find it for a run, have it built, or say why there is none."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from pamctl.compiled_ahead.layout import NotFlat
from pamctl.compiled_ahead.library import find_library_path, find_linker, hash_module
from pamctl.control.law import KERNELS
from pamctl.realtime.tick import TickSetup
from pamctl.realtime.tick_path import PlainTick, TickPath, load_compiled_tick
from pamctl.realtime.tick_words import TickWords
from pamctl.settings.build import build_tick_setup
from pamctl.settings.resolve import RunSettings, settings_to_json

FORBIDDEN = "PAMCTL_NO_BUILD"
"""Environment variable: where it is set, nothing is built."""


def find_tick_library(setup: TickSetup) -> Path:
    """Return where the machine code of a set-up's tick is, or will be. Raises `NotFlat`."""
    source, names = TickWords(setup).write_glue()
    kernel = KERNELS[type(setup.gains)]
    outside = hash_module(sys.modules[kernel.__module__])
    name = f"tick-{kernel.__name__}"
    return find_library_path(name, source, repr(names), f"{kernel.__module__}", outside)


def load_tick(setup: TickSetup) -> tuple[TickPath, str]:
    """Return the fastest tick there is, and what it is in words for the log."""
    try:
        return load_compiled_tick(find_tick_library(setup), setup), "machine code"
    except (NotFlat, OSError, AttributeError):
        return PlainTick(), "plain Python"


def start_building(settings: RunSettings) -> str:
    """Build what is missing, in the background; return a note for the user, or nothing.

    The builder outlives this process. It takes only time that nobody else wants.
    """
    if os.environ.get(FORBIDDEN) or sys.platform != "linux":
        return ""
    try:
        path = find_tick_library(build_tick_setup(settings))
    except NotFlat as error:
        return f"the tick runs in plain Python: {error}"
    if path.exists():
        return ""
    failed = path.with_suffix(".failed")
    with suppress(OSError):
        return (
            f"the tick runs in plain Python, its machine code cannot be built: {failed.read_text()}"
        )
    if find_linker() is None:
        return "the tick runs in plain Python: machine code needs a C compiler, install gcc"
    builder = subprocess.Popen(
        [sys.executable, "-m", "pamctl.processes.builder_main"],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    assert builder.stdin is not None
    with suppress(BrokenPipeError), builder.stdin as sink:
        sink.write(settings_to_json(settings).encode())
    return (
        "the tick runs in plain Python this time: its machine code is being built in the "
        "background, once (some 20 s)"
    )
