"""Where a user's machine code is kept, and why none can be."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path
from shutil import disk_usage

_CACHE_BYTES = 50_000_000
"""Free space that machine code may need."""


def find_code_folder() -> Path:
    """Return the user's private folder for machine code; /tmp is shared, and thus no substitute."""
    if given := os.environ.get("XDG_CACHE_HOME"):
        return Path(given) / "pamctl"
    try:
        return Path.home() / ".cache" / "pamctl"
    except RuntimeError:  # neither HOME nor an entry among the users, as in a container
        return Path(os.devnull) / "pamctl"


@cache
def explain_unwritable(folder: Path) -> str:
    """Make a folder for machine code; tell why none can be kept in it. Empty where it can be."""
    if Path(os.devnull) in folder.parents:
        return "this user has no home directory; name a folder with XDG_CACHE_HOME"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if disk_usage(folder).free < _CACHE_BYTES:  # numba fails on a full disk
            return f"less than {_CACHE_BYTES / 1e6:.0f} MB are free at {folder}"
        # A folder below may be of another user, as after a run with sudo.
        places = [folder, *filter(Path.is_dir, folder.iterdir())]
    except OSError as error:
        return f"{folder}: {error.strerror or error}"
    foreign = [str(place) for place in places if not os.access(place, os.W_OK)]
    return f"{foreign[0]}: it cannot be written" if foreign else ""
