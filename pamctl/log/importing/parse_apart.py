"""Parse a file in a process of its own: a damaged file may crash its parser, or take all memory.

parse_apart("run.tdms")  ->  a process that runs this module with `run.tdms` as its argument
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from hal.child import child_command
from pamctl.log.importing.measured_table import ImportRefused, MeasuredTable

MEMORY_BYTES = 6 << 30
"""Where the system can limit it. Every table that can be imported needs less."""
LONGEST_S = 900.0
LARGEST_BYTES = 4 << 30


class _Format(NamedTuple):
    name: str
    module: str
    function: str
    package: str = ""
    """What `pip` calls the package that reads it; empty for one that is always there."""


_HERE = "pamctl.log.importing"
PARSERS = {
    ".mat": _Format("MAT", f"{_HERE}.mat_table", "parse_mat"),
    ".tdms": _Format("TDMS", f"{_HERE}.lab_files.tdms_table", "parse_tdms", "nptdms"),
    ".lvm": _Format("LVM", f"{_HERE}.lab_files.lvm_table", "parse_lvm", "lvm-read"),
    ".xlsx": _Format("Excel", f"{_HERE}.lab_files.excel_table", "parse_excel", "openpyxl"),
    ".xlsm": _Format("Excel", f"{_HERE}.lab_files.excel_table", "parse_excel", "openpyxl"),
}
"""By the ending of a file's name."""


def parse_apart(path: Path) -> MeasuredTable:
    """Read a file by its ending; raise ImportRefused with the fix if that is impossible."""
    kind = PARSERS[path.suffix.lower()]
    try:
        size = path.stat().st_size
    except OSError as error:
        raise ImportRefused(f"cannot read {path}: {error.strerror}") from error
    if size > LARGEST_BYTES:
        limit = f"the limit is {LARGEST_BYTES >> 30} GB"
        raise ImportRefused(f"{path} is too large: {size / 2**30:.1f} GB, {limit}; cut it")
    command = child_command(__name__, path)
    try:
        parser = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, check=False, timeout=LONGEST_S
        )
    except subprocess.TimeoutExpired:
        detail = f"its parser did not end within {LONGEST_S:.0f} s"
        raise ImportRefused(f"cannot read {path}: {detail}; save the file again") from None
    if parser.returncode:
        raise ImportRefused(
            f"{path} is a damaged {kind.name} file: its parser crashed (code {parser.returncode}); "
            "save the file again"
        )
    outcome = pickle.loads(parser.stdout)
    if isinstance(outcome, str):
        raise ImportRefused(outcome)
    table: MeasuredTable = outcome
    return table


def main() -> None:
    """Parse the file that is named by the argument; write the table or the refusal to stdout."""
    out = os.dup(1)
    os.dup2(2, 1)  # what a parser prints is no answer
    outcome = _parse_here(Path(sys.argv[1]))
    with os.fdopen(out, "wb") as answer:
        answer.write(pickle.dumps(outcome))


def _parse_here(path: Path) -> MeasuredTable | str:
    """Return the table, or why there is none."""
    kind = PARSERS[path.suffix.lower()]
    _limit_memory()
    try:
        parse: Callable[[Path], MeasuredTable] = getattr(import_module(kind.module), kind.function)
        return parse(path)
    except ImportRefused as refusal:
        return str(refusal)
    except ModuleNotFoundError as error:
        return (
            f"cannot read {path}: {kind.name} files need the package "
            f"{kind.package or error.name}; install it with pip install '.[labfiles]'"
        )
    except OSError as error:
        return f"cannot read {path}: {error.strerror or error}"
    except MemoryError:
        detail = f"more than {MEMORY_BYTES >> 30} GB of memory"
        return f"{path} would take {detail}: it is damaged, or cut it into parts"
    # A parser may raise anything for a file that is damaged, or of another kind.
    except Exception as error:
        return f"{path} is not a complete {kind.name} file: {type(error).__name__}: {error}"


def _limit_memory() -> None:
    try:
        import resource
    except ImportError:  # Windows
        return
    limits = resource.getrlimit(resource.RLIMIT_AS)
    hard = limits[1]
    soft = MEMORY_BYTES if hard == resource.RLIM_INFINITY else min(MEMORY_BYTES, hard)
    try:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    except (ValueError, OSError):  # macOS may refuse it
        return


if __name__ == "__main__":
    main()
