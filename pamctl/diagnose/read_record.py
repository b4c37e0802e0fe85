"""How a log, or a measured file that is imported for the while, becomes a record."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from shlex import quote
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

import pamctl.log
from pamctl.base.errors import ExitCode
from pamctl.base.texts import escape_name
from pamctl.diagnose.record import Record
from pamctl.log.check import Severity
from pamctl.log.framing import MAGIC, map_log_file
from pamctl.log.measured_signals import judge_ticks
from pamctl.log.reader import Log
from pamctl.log.run_meta import Moment, list_moments
from pamctl.signals import Phase

if TYPE_CHECKING:
    from pamctl.log.importing.column_map import ImportMap
    from pamctl.log.importing.pipeline import ImportSummary


class SameRunError(Exception):
    """A run is given twice. The message names it."""

    exit_code = ExitCode.USAGE


def require_different_runs(train: Sequence[Path], holdout: Sequence[Path]) -> None:
    """Raise SameRunError if a run is given twice, under whatever name.

    Raise `LogError` if a file cannot be read.
    """
    known: dict[bytes, Path] = {}
    paths = [*train, *holdout]
    for number, path in enumerate(paths if len(paths) > 1 else ()):
        content = _hash_content(path)
        same = known.get(content)
        if same is None:
            known[content] = path
            continue
        if number >= len(train) and same in train:
            raise SameRunError(
                f"--holdout {path} holds the same run as {same}: a log that is fitted cannot "
                "judge the fit; give another run, or no --holdout"
            )
        raise SameRunError(
            f"{path} holds the same run as {same}: a run that counts twice makes every interval "
            "narrower than it is; give it once"
        )


def _hash_content(path: Path) -> bytes:
    return sha256(map_log_file(path)).digest()


def record_of(path: str | Path, column_map: ImportMap | None = None) -> Record:
    """Read a log, or import a measured file, and return its measurement after homing.

    `column_map` says what the columns of a measured file hold; by default their names do.

    The ramp to the safe voltage at the end is left out, and so are ticks whose write failed. The
    record's notes say what is doubtful in it, and how the columns of a measured file were read.
    Raises `LogError`.
    """
    path = Path(path)
    with open_as_log(path, column_map) as (log_path, told):
        log = replace(pamctl.log.read(log_path), path=path)
        return _make_record(log, told or list_notes(log))


@contextmanager
def open_as_log(
    path: Path, column_map: ImportMap | None = None
) -> Iterator[tuple[Path, tuple[str, ...]]]:
    """Yield the path of a log, and notes; a measured file is imported, and its log removed after.

    Raises `LogError`.
    """
    if _is_log(path):
        yield path, ()
        return
    with TemporaryDirectory() as folder:
        imported = Path(folder, "imported.mcap")
        yield imported, _import_beside(path, imported, column_map)


_OF_THE_FILE = {"file", "columns", "map", "unit", "gauge", "sign", "aliasing"}
"""Warnings of an import that its log cannot show by itself."""


def list_notes(log: Log) -> tuple[str, ...]:
    """Return what is doubtful in a log; of an imported one, also what was told of its file."""
    kept = json.loads(log.metadata.get("import", {}).get("report", "[]"))
    kept = [f for f in kept if f["severity"] == Severity.WARNING and f["kind"] in _OF_THE_FILE]
    return (*(escape_name(f["message"]) for f in kept), *judge_ticks(log))


def _is_log(path: Path) -> bool:
    """Tell whether a file is a log, or is called one: then it is read as one, and refused so."""
    if path.suffix == ".mcap" or not path.is_file():
        return True
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def _import_beside(path: Path, imported: Path, column_map: ImportMap | None) -> tuple[str, ...]:
    """Import a measured file; return how each column was read and what is doubtful."""
    from pamctl.log.importing.measured_table import MapWanted
    from pamctl.log.importing.pipeline import import_log

    try:
        done = import_log(path, imported, column_map)
        if not done.written:
            raise _refuse_import(done, has_map=column_map is not None)
    except pamctl.log.LogError as error:
        named = "" if str(path) in str(error) else f"{path}: "
        way_on = (
            "\nA map says what a column holds: write it to MAP.yaml and add --map MAP.yaml, or "
            f"`pamctl log import {quote(str(path))} OUT.mcap --map MAP.yaml` once"
        )
        if not isinstance(error, MapWanted) or column_map is not None:
            way_on = ""
        if column_map is not None and "there is no column" in str(error):
            way_on = (
                "; --map is for all files of the call: where they name columns otherwise, "
                f"`pamctl log import {quote(str(path))} OUT.mcap --map MAP.yaml` each with its own"
            )
        raise pamctl.log.LogError(f"{named}{error}{way_on}") from error
    read_as = ", ".join(f"{c.name} as {c.read_as}" for c in done.columns if c.read_as)
    unused = ", ".join(f"{c.name} ({c.left_out})" for c in done.columns if c.left_out)
    notes = [f"imported: {read_as}", *([f"not used: {unused}"] if unused else [])]
    notes += [f.message for f in done.findings if f.level == Severity.WARNING]
    if done.map_text:
        notes.append(
            "`pamctl log import FILE OUT.mcap` shows a map that would name what is not used"
        )
    return tuple(map(escape_name, notes))


def _refuse_import(done: ImportSummary, *, has_map: bool) -> pamctl.log.LogError:
    """Return why nothing was imported; with a map where one would mend it."""
    from pamctl.log.importing.measured_table import MapWanted
    from pamctl.log.importing.shown_map import show_map

    wrong = [f for f in done.findings if f.level == Severity.ERROR or f.key == "map"]
    text = "not imported: " + "; ".join(f.message for f in wrong)
    if has_map or not any(f.key == "unit" for f in wrong):
        return pamctl.log.LogError(text)
    return MapWanted(show_map(f"{text}; with --map FILE, such as:", done.map_text.splitlines()))


def _make_record(log: Log, notes: tuple[str, ...]) -> Record:
    measured = pamctl.log.signals(log)
    usable = (measured.phase != Phase.HOMING) & (measured.phase != Phase.STOPPING)
    if measured.valve_v is not None:
        usable &= np.isfinite(measured.valve_v)
    ticks = np.flatnonzero(usable)
    if not len(ticks):
        raise pamctl.log.LogError(f"{log.path} holds nothing but homing")
    whole = slice(int(ticks[0]), int(ticks[-1]) + 1)
    part = measured[whole]
    channels = {
        name: getattr(part, name)
        for name in ("valve_v", "pressure_pa", "position_m", "force_n")
        if getattr(part, name) is not None
    }
    column = log.columns.get("reference_m")  # an imported log may not have it
    reference_m = None if column is None or not np.isfinite(column).any() else column[whole]
    first_s = float(log["t_s"][whole][0])
    experiment = str(log.metadata.get("run", {}).get("experiment") or "")
    story = log.metadata.get("import", {})
    atmosphere = story.get("atmospheric_pressure_pa")
    return Record(
        log.path.stem,
        part.t_s - part.t_s[0],
        **channels,
        reference_m=reference_m,
        acts_after_s=part.acts_after_s,
        held_v=part.held_v,
        notes=notes,
        experiment=experiment,
        is_imported=log.is_imported,
        stated_noise=json.loads(story.get("noise") or "{}"),
        atmosphere_pa=None if atmosphere is None else float(atmosphere),
        moments=tuple(Moment(at_s - first_s, text) for at_s, text in list_moments(log)),
        settings=log.config,
    )
