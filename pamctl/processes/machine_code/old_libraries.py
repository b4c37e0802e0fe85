"""Remove machine code that is no longer used: each version of the sources leaves some behind."""

from __future__ import annotations

import os
from collections import defaultdict
from contextlib import suppress
from pathlib import Path

KEPT = 8
"""Libraries of a kind that stay: a user may change between some plants."""


def remove_old_libraries(folder: Path, kept: int = KEPT) -> list[Path]:
    """Keep the last used libraries of each kind, and those in use; return what was removed.

    The kind is the name before the digest, as in `leap-qsmc-16fe9a9e02a967d9a7ad.so`. A reason why
    one could not be built is as old as its file.
    """
    kinds: defaultdict[str, list[tuple[float, str]]] = defaultdict(list)
    for stem in {path.stem for path in folder.glob("*-*.*") if path.is_file()}:
        kinds[stem.rpartition("-")[0]].append((_find_last_use(folder / stem), stem))
    old = [stem for found in kinds.values() for _, stem in sorted(found)[:-kept]]
    return [folder / f"{stem}.so" for stem in old if _remove_unused(folder / stem)]


def touch_library(path: Path) -> None:
    """Take note that a library is used now."""
    with suppress(OSError):
        os.utime(path)


def _find_last_use(stem: Path) -> float:
    times_s = [0.0]
    for suffix in (".so", ".failed", ".lock"):
        with suppress(OSError):
            times_s.append(stem.with_suffix(suffix).stat().st_mtime)
    return max(times_s)


def _remove_unused(stem: Path) -> bool:
    """Remove the files of a library, unless a process has it open or a builder is at work."""
    import fcntl  # machine code is built on Linux only

    held = []
    try:
        for suffix in (".so", ".lock"):
            with suppress(FileNotFoundError):
                held.append(stem.with_suffix(suffix).open("rb"))
                fcntl.flock(held[-1], fcntl.LOCK_EX | fcntl.LOCK_NB)
        for suffix in (".so", ".failed", ".lock"):
            stem.with_suffix(suffix).unlink(missing_ok=True)
    except OSError:
        return False
    finally:
        for file in held:
            file.close()
    return True
