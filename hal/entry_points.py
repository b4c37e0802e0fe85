"""What installed packages offer to pamctl through entry points.

Python's own look-up reads a file of every installed package, anew at each call: here it is done
once a process.
"""

from __future__ import annotations

from functools import cache
from importlib import metadata
from importlib.metadata import EntryPoints
from typing import Any


@cache
def _read_all() -> Any:  # a type of its own in Python 3.11
    return metadata.entry_points()


def find_entry_points(group: str) -> EntryPoints:
    """Return the entry points of a group, such as `pamctl.laws`."""
    found: EntryPoints = _read_all().select(group=group)
    return found
