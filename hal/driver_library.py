"""The C library of a card's driver: which file it is, and whether it is the tests' stand-in."""

from __future__ import annotations

import os
from pathlib import Path

from hal.rig import RigError

STAND_IN_PERMIT = "PAMCTL_PERMIT_STAND_IN"
"""Environment variable that permits the stand-in drivers; only tests set it."""


def find_loaded_library(name: str) -> str:
    """Return the path of the library (`libcomedi.so`) that this process has really loaded."""
    for mapping in Path("/proc/self/maps").read_text().splitlines():
        if f"/{name}" in mapping:
            return mapping.split(maxsplit=5)[5]
    return ""


def refuse_stand_in(device: str, library: str) -> None:
    """Raise `RigError` for a stand-in driver, except in the tests."""
    if STAND_IN_PERMIT not in os.environ:
        raise RigError(
            f"{device} is not a card: it is the stand-in driver of pamctl's tests, in {library}",
            fix="take its directory out of LD_LIBRARY_PATH",
        )
