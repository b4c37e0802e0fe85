"""Machine code of earlier versions is removed; what was used last, or is in use, stays."""

from __future__ import annotations

import fcntl
import os
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="machine code is built on Linux")


def fill(folder: Path) -> list[Path]:
    """Make three libraries of two kinds, the first the oldest, each with its lock."""
    made = []
    for kind in ("tick-qsmc", "plant"):
        for age in range(3):
            library = folder / f"{kind}-{age:020d}.so"
            for path in (library, library.with_suffix(".lock")):
                path.write_text("code")
                os.utime(path, (1e9 + age, 1e9 + age))
            made.append(library)
    return made


def test_the_last_used_of_each_kind_stay(tmp_path: Path) -> None:
    from pamctl.processes.machine_code.old_libraries import remove_old_libraries, touch_library

    made = fill(tmp_path)
    touch_library(made[0])  # the oldest tick is used again
    assert sorted(remove_old_libraries(tmp_path, kept=2)) == [made[3], made[1]]
    left = {path.name for path in tmp_path.iterdir()}
    kept = (made[0], made[2], made[4], made[5])
    assert left == {p.with_suffix(s).name for p in kept for s in (".so", ".lock")}


def test_a_library_in_use_and_one_that_is_being_built_stay(tmp_path: Path) -> None:
    from pamctl.processes.machine_code.old_libraries import remove_old_libraries

    made = fill(tmp_path)
    with made[0].open("rb") as used, made[3].with_suffix(".lock").open("rb") as building:
        fcntl.flock(used, fcntl.LOCK_SH)  # as `KernelLibrary` holds it
        fcntl.flock(building, fcntl.LOCK_EX)
        assert sorted(remove_old_libraries(tmp_path, kept=1)) == [made[4], made[1]]
    assert all(library.exists() for library in (made[0], made[2], made[3], made[5]))


def test_a_loaded_library_is_held(tmp_path: Path) -> None:
    from pamctl.compiled_ahead.library import hold_library

    library = tmp_path / "tick-qsmc-1.so"
    library.write_text("code")
    held = hold_library(library)
    with library.open("rb") as other, pytest.raises(BlockingIOError):
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
    os.close(held)
