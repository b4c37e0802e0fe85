"""Find the format of a measured file by its first bytes, and read it.

A text is read here: its encoding, its lines, the mark between its cells. What holds for the whole
file is decided once, from its first rows. Rows of plain numbers are read together; all others are
read cell by cell, and what is wrong is named with line and cell.

What a package parses is parsed in a process of its own: a damaged file may crash its parser, or
take all memory.
"""

from __future__ import annotations

import bz2
import codecs
import csv
import gzip
import lzma
import os
import pickle
import re
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from io import TextIOWrapper
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np
import zstandard

from hal.child import advise_install, child_command
from pamctl.base.new_file import describe_irregular_file
from pamctl.log.importing.cell_texts import tell_kind
from pamctl.log.importing.column_map import TextHints
from pamctl.log.importing.measured_table import BOMB_BYTES, BOMB_RATIO, ImportRefused, MeasuredTable
from pamctl.log.importing.table_rows import HEAD_ROWS, Row, TableBuilder, TableLayout, find_layout

MEMORY_BYTES = 6 << 30
"""Where the system can limit it. Every table that can be imported needs less."""
LONGEST_S = 900.0
LARGEST_BYTES = 4 << 30


class _Format(NamedTuple):
    name: str
    function: str
    """What parses it, with its module in this folder."""
    package: str = ""
    """What `pip` calls the package that reads it; empty for one that is always there."""


_MAT = _Format("MAT", "matlab_tables.parse_mat")
_HDF5 = _Format("HDF5 (MAT -v7.3)", "matlab_tables.parse_hdf5", "h5py")
_EXCEL = _Format("Excel", "parsed_tables.parse_excel", "openpyxl")
_NUMPY = _Format("NPZ", "parsed_tables.parse_npz")
_TDMS = _Format("TDMS", "parsed_tables.parse_tdms", "nptdms")
_LVM = _Format("LVM", "parsed_tables.parse_lvm", "lvm-read")
_PARSED = {
    b"MATLAB 5.0": _MAT,
    b"MATLAB 7.3": _HDF5,
    b"\x89HDF\r\n\x1a\n": _HDF5,
    b"TDSm": _TDMS,
    b"LabVIEW Measurement": _LVM,
    b"PAR1": _Format("Parquet", "parsed_tables.parse_parquet", "pyarrow"),
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
_ZSTANDARD_HEAD = 18
"""The longest head of a frame, in bytes."""
Packer = Callable[[Path, str], Any]
_PACKED: dict[bytes, Packer] = {
    b"\x1f\x8b": gzip.open,
    b"BZh": bz2.open,
    b"\xfd7zXZ\0": lzma.open,
    b"\x28\xb5\x2f\xfd": zstandard.open,
}
_DAMAGED = (OSError, EOFError, ValueError, lzma.LZMAError, zlib.error, zstandard.ZstdError)


def read_table(source: Path, hints: TextHints | None = None) -> MeasuredTable:
    """Read a measured file; raise ImportRefused with what it is and the fix if that cannot be."""
    hints = hints or TextHints()
    if something := describe_irregular_file(source):
        raise ImportRefused(f"cannot read {source}: it is {something}")
    try:
        with source.open("rb") as plain:
            magic = plain.read(8)
        packer = next((opener for mark, opener in _PACKED.items() if magic.startswith(mark)), None)
        begin = next(_unpack(source, packer), b"")[:512]
        kind = _find_format(source, begin, is_packed=packer is not None)
        if kind is not None:
            return _parse_apart(source, kind, hints)
        return read_text(source, hints, begin, packer)
    except OSError as error:
        raise ImportRefused(f"cannot read {source}: {error.strerror or error}") from error


def _unpack(path: Path, packer: Packer | None) -> Iterator[bytes]:
    """Yield what a file holds; raise ImportRefused where its packing is damaged, or a bomb."""
    if packer is None:
        with path.open("rb") as file:
            yield from iter(lambda: file.read(_BLOCK), b"")
        return
    most, taken = max(BOMB_BYTES, BOMB_RATIO * path.stat().st_size), 0
    try:
        with packer(path, "rb") as file:
            while block := file.read(_BLOCK):
                taken += len(block)
                if taken > most:
                    raise ImportRefused(
                        f"{path} unpacks to more than {most >> 20} MB, {BOMB_RATIO} times its "
                        "size: unpack it yourself if it is a measurement"
                    )
                yield block
        if packer is zstandard.open:  # it says nothing of a frame that is cut short
            with path.open("rb") as file:
                least = zstandard.frame_content_size(file.read(_ZSTANDARD_HEAD))
            if taken < least:
                raise EOFError(f"it ends after {taken} of {least} bytes")
    except _DAMAGED as error:
        raise ImportRefused(f"{path} is damaged: {error}; unpack what is whole") from None


def _find_format(source: Path, begin: bytes, *, is_packed: bool) -> _Format | None:
    """Return who parses a file, None for a text; raise ImportRefused for what nobody here reads."""
    kind = next((kind for magic, kind in _PARSED.items() if begin.startswith(magic)), None)
    if kind is _LVM and b"Writer_Version" not in begin:
        kind = None  # a table that a program of LabVIEW wrote in a form of its own
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
    if not size:
        raise ImportRefused(f"{path} is empty")
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
    try:
        module, name = kind.function.split(".")
        parse: Any = getattr(import_module(f"pamctl.log.importing.{module}"), name)
        table: MeasuredTable = parse(path, hints)
        return table
    except ImportRefused as refusal:
        return str(refusal)
    except ModuleNotFoundError as error:
        package = kind.package or error.name
        return (
            f"cannot read {path}: {kind.name} files need the package {package}; "
            f"{advise_install(str(package))}"
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


WIDE_GAP = "two spaces or more"
_LONGEST_LINE = 100_000
"""Characters; the parser of cells takes no longer ones."""
_BLOCK = 1 << 18
_DELIMITERS = {"\t": "tab", ";": "semicolon", "|": "|", ",": "comma", WIDE_GAP: WIDE_GAP,
               " ": "spaces"}  # fmt: skip
_COMMENT = re.compile(r"\s*(?:#+|%+|//+|!)\s*")
_SPECIAL = ('"', "#", "%", "!", "//")
"""What lines may have that are no plain rows: a cell in quotes, a comment."""
_BOMS = ((b"\xff\xfe\0\0", "utf-32"), (b"\0\0\xfe\xff", "utf-32"), (b"\xef\xbb\xbf", "utf-8-sig"),
         (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"))  # fmt: skip


class TextBlock(NamedTuple):
    """Some lines of a file, without their ends."""

    first: int
    text: str
    is_cut: bool = False
    """For the last line alone, where nothing ends it."""

    @property
    def lines(self) -> list[str]:
        """All of them."""
        return self.text.split("\n")


def read_text(path: Path, hints: TextHints, begin: bytes, packer: Packer | None) -> MeasuredTable:
    """Read a file of text; raise ImportRefused with the line and the cell that has no reading."""
    encoding, remarks = _find_encoding(path, hints.encoding or "", begin, packer)
    with TextIOWrapper((packer or open)(path, "rb"), encoding) as file:
        try:
            delimiter, table = _read_blocks(path, _split_blocks(path, file), hints)
        except csv.Error as error:
            raise ImportRefused(f"{path} has a cell that has no end: {error}") from None
    plain = "utf-8" if encoding == "utf-8-sig" else encoding
    form = f"text in {plain}, {_DELIMITERS[delimiter]} between cells"
    return table.finish(form, remarks)


def _read_blocks(
    path: Path, blocks: Iterator[TextBlock], hints: TextHints
) -> tuple[str, TableBuilder]:
    begun = list(islice(blocks, 2))  # the second one may be the last line of a short file
    first = begun[0] if begun else TextBlock(1, "")
    head = TextBlock(1, "\n".join([line for one in begun for line in one.lines][: 2 * HEAD_ROWS]))
    delimiter, layout = _choose_delimiter(path, head)
    builder = TableBuilder(path, layout, hints)
    skipped = next((row.number for row in list(_split_rows(head, delimiter))[layout.first :]), 1)
    below = first.text.split("\n", skipped - 1)
    begun[:1] = [TextBlock(skipped, below[-1], first.is_cut)] if len(below) == skipped else []
    for block in chain(begun, blocks):
        text = _unquote(block.text, delimiter)
        if not block.is_cut and builder.take_plain(block.first, text, delimiter):
            continue
        columns = _split_evenly(text, delimiter, len(layout.kinds))
        if columns is None:
            builder.take_rows(_split_rows(block, delimiter), is_cut=block.is_cut)
        else:
            lines = block.first + np.arange(len(columns[0]))
            builder.take(lines, columns, is_cut=block.is_cut)
    return delimiter, builder


def _unquote(text: str, delimiter: str) -> str:
    """Return lines without the quotes where all cells have them, and no mark within."""
    marks = (text.count(delimiter), text.count("\n"))
    is_whole = text[:1] == text[-1:] == '"' and text.count('"') == 2 * (sum(marks) + 1)
    is_whole = is_whole and marks == (text.count(f'"{delimiter}"'), text.count('"\n"'))
    return text.replace('"', "") if is_whole else text


def _split_evenly(text: str, delimiter: str, width: int) -> list[list[str]] | None:
    """Return the cells by column; None where a line has another number of cells, or quotes."""
    if delimiter in (" ", WIDE_GAP) or width == 1 or any(mark in text for mark in _SPECIAL):
        return None
    count = text.count("\n") + 1
    cells = text.replace("\n", f"{delimiter}\n").split(delimiter)
    there = len(cells) // count
    if there < width or len(cells) != there * count:
        return None
    first = "".join(cells[::there]).split("\n")  # all line breaks, if the lines are even
    is_even = len(first) == count and all(
        not "".join(cells[at::there]).strip() for at in range(width, there)
    )
    return [first, *(cells[at::there] for at in range(1, width))] if is_even else None


def _find_encoding(
    path: Path, stated: str, begin: bytes, packer: Packer | None
) -> tuple[str, list[str]]:
    encoding = stated or next((name for bom, name in _BOMS if begin.startswith(bom)), "")
    if not encoding and len(begin) > 3 and begin[0] and begin[1:4:2] == b"\0\0":
        encoding = "utf-16-le"
    for name in (encoding,) if encoding else ("utf-8", "cp1252"):
        try:
            for _ in codecs.iterdecode(_unpack(path, packer), name):
                pass
        except LookupError:
            raise ImportRefused(f"there is no encoding {name!r}; try utf-8 or cp1252") from None
        except UnicodeError:
            continue
        told = (
            "the text is not UTF-8; it is read as Windows-1252 (Western Europe), which concerns "
            "names and units, not numbers; if they look wrong, say `encoding: NAME` in the map"
        )
        return name, [told] if name == "cp1252" and not encoding else []
    tried = encoding or "UTF-8 or Windows-1252"
    raise ImportRefused(f"{path} is no text in {tried}; say `encoding: NAME` in the map")


def _split_blocks(path: Path, file: TextIO) -> Iterator[TextBlock]:
    """Yield the lines in blocks, the last line alone where nothing ends it."""
    number, rest = 1, ""
    while text := file.read(_BLOCK):
        text = rest + text
        whole, end, rest = text.rpartition("\n")
        count = whole.count("\n") + len(end)
        if len(text) > 1000 * count:  # else no line can be that long but a few
            for at, line in enumerate(text.split("\n"), number):
                if len(line) > _LONGEST_LINE:
                    detail = f"the line is longer than {_LONGEST_LINE} characters"
                    raise ImportRefused(f"{path}:{at}: {detail}: is this a table of numbers?")
        while '"' in whole and sum(x.count('"') for x in whole.rsplit("\n", 50)[-50:]) % 2:
            whole, end, line = whole.rpartition("\n")  # a cell goes on in the next block
            rest = f"{line}\n{rest}"
            count -= 1
        if end:
            yield TextBlock(number, whole)
        number += count
    if rest.strip():
        yield TextBlock(number, rest, is_cut=True)


def _split_rows(block: TextBlock, delimiter: str) -> Iterator[Row]:
    """Yield the rows that are not empty; a quoted cell may hold line breaks."""
    if delimiter in (" ", WIDE_GAP):
        wide = re.compile(r"\s{2,}|\t")
        for number, line in enumerate(block.lines, block.first):
            comment = _match_comment(line, line.split(maxsplit=1))
            text = line[comment.end() :] if comment else line.strip()
            if text:
                cells = text.split() if delimiter == " " else wide.split(text)
                yield Row(number, cells, comment is not None)
        return
    reader = csv.reader(block.lines, delimiter=delimiter, skipinitialspace=delimiter != "\t")
    number = block.first
    for cells in reader:
        begun, number = number, block.first + reader.line_num
        comment = _match_comment(cells[0], cells) if cells else None
        if comment:
            cells[0] = cells[0][comment.end() :].strip('"')
        is_separator = begun == 1 and cells[:1] and cells[0].lower().startswith("sep=")
        if any(map(str.strip, cells)) and not is_separator:
            yield Row(begun, cells, comment is not None)


def _match_comment(text: str, cells: Sequence[str]) -> re.Match[str] | None:
    """Return the mark of a comment; None for a row that begins with a word such as `#N/A`."""
    comment = _COMMENT.match(text)
    return None if comment and tell_kind(cells[0]) == "m" else comment


def _choose_delimiter(path: Path, head: TextBlock) -> tuple[str, TableLayout]:
    """Return the mark that makes the most cells of the table numbers or times.

    A column of empty cells does not count.
    """
    found: dict[float, tuple[str, TableLayout]] = {}
    for delimiter in _DELIMITERS:
        try:
            rows = list(islice(_split_rows(head, delimiter), HEAD_ROWS))
        except csv.Error:
            continue
        layout = find_layout(rows)
        if layout is None:
            continue
        numeric = sum(kind in "nt" for kind in layout.kinds)
        is_named = not all(map(str.isdecimal, layout.names))
        told = len(layout.kinds.replace("m", ""))
        score = numeric / told + (numeric > 1) + 0.1 * is_named
        found.setdefault(score, (delimiter, layout))
    if found:
        return found[max(found)]
    first = next((line for line in head.lines if line.strip()), "")
    if not first:
        raise ImportRefused(f"{path} is empty")
    raise ImportRefused(
        f"{path} holds no rows of numbers within its first {HEAD_ROWS} lines; "
        f"it begins with {first[:60]!r}"
    )


if __name__ == "__main__":
    main()
