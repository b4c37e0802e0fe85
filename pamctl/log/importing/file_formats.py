"""Find the format of a measured file by its first bytes, and read it.

A text is read here. What a package parses is parsed in a process of its own: a damaged file may
crash its parser, or take all memory.
"""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import os
import pickle
import subprocess
import sys
import zipfile
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, cast

from hal.child import child_command
from pamctl.log.importing.column_map import TextHints
from pamctl.log.importing.measured_table import (
    BOMB_BYTES,
    BOMB_RATIO,
    ImportRefused,
    MeasuredTable,
)
from pamctl.regular_file import describe_irregular_file

MEMORY_BYTES = 6 << 30
"""Where the system can limit it. Every table that can be imported needs less."""
LONGEST_S = 900.0
LARGEST_BYTES = 4 << 30


class _Format(NamedTuple):
    name: str
    function: str
    package: str = ""
    """What `pip` calls the package that reads it; empty for one that is always there."""


_MAT = _Format("MAT", "matlab_tables:parse_mat")
_HDF5 = _Format("HDF5 (MAT -v7.3)", "matlab_tables:parse_hdf5", "h5py")
_EXCEL = _Format("Excel", "lab_tables:parse_excel", "openpyxl")
_NUMPY = _Format("NPZ", "lab_tables:parse_npz")
_TDMS = _Format("TDMS", "lab_tables:parse_tdms", "nptdms")
_LVM = _Format("LVM", "lab_tables:parse_lvm", "lvm-read")
_PARSED = {
    b"MATLAB 5.0": _MAT,
    b"MATLAB 7.3": _HDF5,
    b"\x89HDF\r\n\x1a\n": _HDF5,
    b"TDSm": _TDMS,
    b"LabVIEW Measurement": _LVM,
    b"PAR1": _Format("Parquet", "lab_tables:parse_parquet", "pyarrow"),
    b"\x93NUMPY": _NUMPY,
}
_BY_ENDING = {".mat": _MAT, ".tdms": _TDMS, ".lvm": _LVM, ".xlsx": _EXCEL, ".xlsm": _EXCEL}
"""Only where the first bytes say nothing: MAT files of version 4, and damaged files."""
_CLOSED = {
    b"\x89MCAP0\r\n": ("MCAP", "a log of pamctl needs no import; export another one's topics as "
                       "CSV or Parquet, such as with `mcap` or Foxglove"),
    b"#ROSBAG V": ("a ROS bag", "export its topics as CSV, such as with `rostopic echo -p`"),
    b"SQLite format 3": ("SQLite (ROS 2 bags are)", "export its topics or tables as CSV"),
    b"TDSh": ("a TDMS index", "give the .tdms file beside it"),
    b"\xd0\xcf\x11\xe0": ("the old format of Excel (.xls)", "save it as .xlsx or CSV"),
    b"MDF     ": ("MDF (.mf4, .dat)", "export it as CSV or MAT, such as with asammdf"),
    b"ARROW1": ("Feather", "save it as Parquet or CSV"),
    b"%PDF": ("PDF", "it holds no measurement; ask for the numbers as CSV"),
    b"|CF,": ("imc FAMOS", "export it as CSV or MAT"),
    b'{"': ("JSON", "save it as CSV"),
    b"[{": ("JSON", "save it as CSV"),
    b"<": ("XML or HTML", "save it as CSV"),
    b"7z\xbc\xaf'\x1c": ("7-Zip", "unpack it first"),
    b"Rar!": ("RAR", "unpack it first"),
}  # fmt: skip
"""Formats that are often tried, with what to do."""
_PACKED: dict[bytes, Callable[[Path], Any]] = {
    b"\x1f\x8b": gzip.open,
    b"BZh": bz2.open,
    b"\xfd7zXZ\0": lzma.open,
}
_ZSTANDARD = b"\x28\xb5\x2f\xfd"


class _Unpacked(io.RawIOBase):
    """A compressed file, unpacked while it is read; it ends a bomb."""

    def __init__(self, path: Path, stream: Any) -> None:
        self._path, self._stream = path, stream
        self._most = max(BOMB_BYTES, BOMB_RATIO * path.stat().st_size)
        self._taken = 0

    def readable(self) -> bool:
        return True

    def close(self) -> None:
        self._stream.close()
        super().close()

    def readinto(self, buffer: Any) -> int:
        try:
            part = self._stream.read(len(buffer))
        except (OSError, EOFError, lzma.LZMAError, ValueError) as error:
            raise ImportRefused(f"{self._path} is damaged: {error}; unpack what is whole") from None
        self._taken += len(part)
        if self._taken > self._most:
            raise ImportRefused(
                f"{self._path} unpacks to more than {self._most >> 20} MB, {BOMB_RATIO} times its "
                "size: unpack it yourself if it is a measurement"
            )
        buffer[: len(part)] = part
        return len(part)


def read_table(source: Path, hints: TextHints | None = None) -> MeasuredTable:
    """Read a measured file; raise ImportRefused with what it is and the fix if that cannot be."""
    hints = hints or TextHints()
    if something := describe_irregular_file(source):
        raise ImportRefused(f"cannot read {source}: it is {something}")
    try:
        open_file = _choose_opening(source)
        with open_file() as file:
            begin = file.read(512)
        kind = _find_format(source, begin, is_packed=open_file.__name__ == "open_packed")
        if kind is not None:
            return _parse_apart(source, kind, hints)
        from pamctl.log.importing.text_table import read_text

        return read_text(source, hints, open_file)
    except OSError as error:
        raise ImportRefused(f"cannot read {source}: {error.strerror or error}") from error


def _choose_opening(source: Path) -> Callable[[], BinaryIO]:
    with source.open("rb") as file:
        begin = file.read(8)
    packer = next((opener for magic, opener in _PACKED.items() if begin.startswith(magic)), None)
    if begin.startswith(_ZSTANDARD):
        packer = _open_zstandard
    if packer is None:
        return lambda: source.open("rb")

    def open_packed() -> BinaryIO:
        return cast(BinaryIO, io.BufferedReader(_Unpacked(source, packer(source)), 1 << 18))

    return open_packed


def _open_zstandard(path: Path) -> Any:
    import zstandard

    return zstandard.ZstdDecompressor().stream_reader(path.open("rb"), closefd=True)


def _find_format(source: Path, begin: bytes, *, is_packed: bool) -> _Format | None:
    """Return who parses a file, None for a text; raise ImportRefused for what nobody here reads."""
    kind = next((kind for magic, kind in _PARSED.items() if begin.startswith(magic)), None)
    closed = next((said for magic, said in _CLOSED.items() if begin.startswith(magic)), None)
    if begin.startswith(b"PK\x03\x04") and not is_packed:
        kind, closed = _look_into_zip(source)
    if closed:
        raise ImportRefused(f"cannot read {source}: it is {closed[0]}; {closed[1]}")
    if kind is None and not is_packed and (by_name := _BY_ENDING.get(source.suffix.lower())):
        kind = by_name
    if kind is not None and is_packed:
        raise ImportRefused(f"cannot read {source}: it is a packed {kind.name} file; unpack it")
    is_wide = begin.startswith((b"\xff\xfe", b"\xfe\xff")) or begin[1:4:2] == b"\0\0" != begin[:2]
    if kind is None and b"\0" in begin and not is_wide:
        shown = " ".join(f"{byte:02x}" for byte in begin[:8])
        raise ImportRefused(
            f"cannot read {source}: it is no text, and of no format that pamctl knows (it begins "
            f"with {shown}); export it as CSV from the program that wrote it"
        )
    return kind


def _look_into_zip(source: Path) -> tuple[_Format | None, tuple[str, str] | None]:
    try:
        with zipfile.ZipFile(source) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, NotImplementedError, ValueError) as error:
        return None, ("a damaged ZIP file", f"save it again ({error})")
    if any(name.startswith("xl/") for name in names):
        return _EXCEL, None
    if names and all(name.endswith(".npy") for name in names):
        return _NUMPY, None
    if "simulink" in names or source.suffix.lower() == ".slx":
        return None, ("a model, no measurement", "save what it logged as a MAT file")
    if "mimetype" in names:
        return None, ("a document of OpenOffice or LibreOffice", "save the sheet as .xlsx or CSV")
    return None, (f"a ZIP archive of {', '.join(names[:3])}", "unpack it first")


def _parse_apart(path: Path, kind: _Format, hints: TextHints) -> MeasuredTable:
    size = path.stat().st_size
    if size > LARGEST_BYTES:
        limit = f"the limit is {LARGEST_BYTES >> 30} GB"
        raise ImportRefused(f"{path} is too large: {size / 2**30:.1f} GB, {limit}; cut it")
    command = child_command(__name__, path, *kind)
    try:
        parser = subprocess.run(
            command, input=pickle.dumps(hints), capture_output=True, check=False, timeout=LONGEST_S
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
    """Parse the file that the arguments name; write the table or the refusal to stdout."""
    out = os.dup(1)
    os.dup2(2, 1)  # what a parser prints is no answer
    hints = pickle.loads(sys.stdin.buffer.read())
    outcome = _parse_here(Path(sys.argv[1]), _Format(*sys.argv[2:5]), hints)
    with os.fdopen(out, "wb") as answer:
        answer.write(pickle.dumps(outcome, pickle.HIGHEST_PROTOCOL))


def _parse_here(path: Path, kind: _Format, hints: TextHints) -> MeasuredTable | str:
    """Return the table, or why there is none."""
    _limit_memory()
    module, _, function = kind.function.partition(":")
    try:
        parse: Any = getattr(import_module(f"pamctl.log.importing.{module}"), function)
        table: MeasuredTable = parse(path, hints)
        return table
    except ImportRefused as refusal:
        return str(refusal)
    except ModuleNotFoundError as error:
        package = kind.package or error.name
        return (
            f"cannot read {path}: {kind.name} files need the package {package}; install it with "
            f"python -m pip install {package}"
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
