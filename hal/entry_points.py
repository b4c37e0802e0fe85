"""What installed packages offer to pamctl through entry points.

Python's own look-up reads a file of every installed package, anew at each call: here it is done
once a process.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import metadata
from importlib.metadata import EntryPoint, EntryPoints
from typing import Any


@cache
def _read_all() -> Any:  # a type of its own in Python 3.11
    return metadata.entry_points()


def find_entry_points(group: str) -> EntryPoints:
    """Return the entry points of a group, such as `pamctl.laws`."""
    found: EntryPoints = _read_all().select(group=group)
    return found


RIGS = "pamctl.rigs"
_SHIPPED_RIGS = (
    EntryPoint("sim", "hal.sim:SIM", RIGS),
    EntryPoint("nidaq", "hal.nidaq.nidaq_backend:NIDAQ", RIGS),
    EntryPoint("comedi", "hal.comedi.comedi_backend:COMEDI", RIGS),
)
"""Their entry points again: an editable install that was made before them knows none."""


@cache
def find_rig_points() -> Mapping[str, EntryPoint]:
    """Return the entry points of the backends by their names, the shipped ones first."""
    points = {point.name: point for point in _SHIPPED_RIGS}
    for point in sorted(find_entry_points(RIGS), key=lambda point: point.name):
        # A shipped name stays with the shipped record.
        points.setdefault(point.name, point)
    return points
