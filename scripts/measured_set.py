"""A folder with a measurement: its files, how to read them, a plant file, and what is known of it.

- `map.yaml`: column map, as `pamctl log import --map` takes it
- `plant.yaml`: plant file with rough guesses
- `set.yaml`: what is known (`MeasuredSet` has the keys)
- the files, here or in `data` below the folder of measured data
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

PARTS = ("fitted", "chosen", "confirmed")
VARIABLE = "PAMCTL_MEASURED_DATA"


class SetRefused(Exception):
    """A set cannot be used: the text says which file, what, and the fix."""


@dataclass(frozen=True)
class Piece:
    """A stretch of a file: from one share of its rows to another."""

    file: str
    start: float
    end: float


@dataclass(frozen=True)
class MeasuredSet:
    """One set, as its `set.yaml` tells it."""

    name: str
    folder: Path
    data: Path
    about: str
    header: tuple[str, ...]
    """Names of the columns, where the files have none; their cells are then split at blanks."""
    parts: Mapping[str, tuple[Piece, ...]]
    guessed: tuple[str, ...]
    """Numbers of the plant file that are rough: `parameters.mass_kg`."""
    hand_figures: Mapping[str, float]
    """What a fit by hand left of the same rows."""
    expect: Mapping[str, Any]

    @property
    def missing(self) -> list[str]:
        """The files that are not where they should be."""
        files = {piece.file for part in self.parts.values() for piece in part}
        return sorted(name for name in files if not (self.data / name).is_file())


def find_sets(folder: Path, data: Path | None) -> Iterator[MeasuredSet]:
    """Yield the sets below a folder, or the one that the folder is."""
    if not folder.is_dir():
        raise SetRefused(f"{folder} is not a folder")
    found = sorted(folder.glob("*/set.yaml")) or sorted(folder.glob("set.yaml"))
    if not found:
        raise SetRefused(f"{folder} has no set: a set is a folder with a set.yaml")
    for path in found:
        yield read_set(path.parent, data)


def read_set(folder: Path, data: Path | None) -> MeasuredSet:
    """Read a set. Raise SetRefused where a key is missing or unknown."""
    path = folder / "set.yaml"
    read = yaml.safe_load(path.read_text(encoding="utf-8"))
    known = {"about", "data", "header", "parts", "guessed", "hand_figures", "expect"}
    if not isinstance(read, dict) or set(read) - known:
        unknown = sorted(set(read) - known) if isinstance(read, dict) else "no mapping"
        raise SetRefused(f"{path}: unknown {unknown}; a set has {', '.join(sorted(known))}")
    for needed in ("map.yaml", "plant.yaml"):
        if not (folder / needed).is_file():
            raise SetRefused(f"{folder}: there is no {needed}")
    return MeasuredSet(
        name=folder.name,
        folder=folder,
        data=(data or folder) / read["data"] if "data" in read else folder,
        about=str(read.get("about", "")),
        header=tuple(read.get("header", ())),
        parts=_parts_of(path, read.get("parts", {})),
        guessed=tuple(read.get("guessed", ())),
        hand_figures=dict(read.get("hand_figures", {})),
        expect=_expectations_of(path, read.get("expect", {})),
    )


def _parts_of(path: Path, parts: Mapping[str, Any]) -> dict[str, tuple[Piece, ...]]:
    if set(parts) - set(PARTS) or not parts.get("fitted"):
        raise SetRefused(f"{path}: parts must be {', '.join(PARTS)}, and something is fitted")
    return {part: tuple(_piece_of(path, entry) for entry in parts.get(part, ())) for part in PARTS}


def _piece_of(path: Path, entry: Any) -> Piece:
    if isinstance(entry, str):
        return Piece(entry, 0.0, 1.0)
    start, end = entry.get("rows", (0.0, 1.0))
    if "file" not in entry or not 0.0 <= start < end <= 1.0:
        raise SetRefused(f"{path}: a part is a file, or {{file: NAME, rows: [0.0, 0.7]}}")
    return Piece(entry["file"], float(start), float(end))


def _expectations_of(path: Path, expect: Mapping[str, Any]) -> dict[str, Any]:
    known = {"verdicts", "names", "never", "numbers", "gap"}
    if set(expect) - known:
        raise SetRefused(f"{path}: unknown {sorted(set(expect) - known)}; expect has {known}")
    return dict(expect)


def write_pieces(measured: MeasuredSet, into: Path) -> dict[str, list[Path]]:
    """Write each part's files as CSV files with names, and return their paths by part."""
    return {
        part: [_write_piece(measured, piece, part, into) for piece in measured.parts[part]]
        for part in PARTS
    }


def _write_piece(measured: MeasuredSet, piece: Piece, part: str, into: Path) -> Path:
    source = measured.data / piece.file
    target = into / f"{source.stem}-{part}{source.suffix}"
    if not measured.header and (piece.start, piece.end) == (0.0, 1.0):
        target.write_bytes(source.read_bytes())  # a MAT file, or a CSV file that is ready
        return target
    lines = [line for line in source.read_text(encoding="utf-8-sig").splitlines() if line.strip()]
    if measured.header:
        names, rows = ",".join(measured.header), [",".join(line.split()) for line in lines]
    else:
        names, rows = lines[0], lines[1:]
    kept = rows[round(piece.start * len(rows)) : round(piece.end * len(rows))]
    target.write_text("\n".join([names, *kept]) + "\n")
    return target


def scale_guesses(plant: Mapping[str, Any], guessed: tuple[str, ...], factor: float) -> Any:
    """Return the plant file with its guessed numbers times `factor`."""
    scaled = yaml.safe_load(yaml.safe_dump(dict(plant)))
    for place in guessed:
        *above, last = place.split(".")
        room = scaled
        for key in above:
            room = room.get(key, {}) if isinstance(room, dict) else {}
        if not isinstance(room, dict) or not isinstance(room.get(last), int | float):
            raise SetRefused(f"plant.yaml: there is no number {place} to scale")
        room[last] = room[last] * factor
    return scaled


def names_said(document: Mapping[str, Any]) -> set[str]:
    """Return what a diagnosis names: effects, their parameters, terms and set-up findings."""
    said = set()
    for effect in document.get("effects", ()):
        said.add(effect["name"])
        said |= {f"{effect['name']}.{name}" for name in effect.get("parameters", {})}
    for term in document.get("terms") or ():
        said.add(f"{term['location']} {term['operator']} {term['driver']}")
    for finding in document.get("setup") or ():
        said.add(f"{finding['kind']}.{finding['number']}")
    return said


def number_said(document: Mapping[str, Any], place: str) -> float | None:
    """Return a fitted number by `effect.parameter`, or by the name of a recalibrated one."""
    effect, dot, parameter = place.partition(".")
    if not dot:
        found = document.get("recalibrated", {}).get(place)
        return None if found is None else float(found["value"])
    for entry in document.get("effects", ()):
        if entry["name"] == effect and parameter in entry["parameters"]:
            return float(entry["parameters"][parameter]["value"])
    return None


def find_failures(measured: MeasuredSet, document: Mapping[str, Any]) -> list[str]:
    """Return which expectations a document does not meet, in words."""
    expect, said = measured.expect, names_said(document)
    failed = []
    if document["verdict"] not in expect.get("verdicts", [document["verdict"]]):
        failed.append(f"verdict {document['verdict']}, not one of {expect['verdicts']}")
    for pattern in expect.get("names", ()):
        if not any(re.fullmatch(pattern, name) for name in said):
            failed.append(f"nothing like {pattern} is named")
    for pattern in expect.get("never", ()):
        wrong = sorted(name for name in said if re.fullmatch(pattern, name))
        failed += [f"{name} is named" for name in wrong]
    for place, known in expect.get("numbers", {}).items():
        value = number_said(document, place)
        if value is None or abs(value - known["value"]) > known["within"] * abs(known["value"]):
            failed.append(f"{place} is {value}, not {known['value']} within {known['within']:.0%}")
    return failed + _find_gap_failures(expect.get("gap"), document)


def _find_gap_failures(asked: Mapping[str, Any] | None, document: Mapping[str, Any]) -> list[str]:
    if asked is None:
        return []
    gap = document.get("gap", {}).get(asked["channel"])
    if gap is None:
        return [f"the document has no gap of {asked['channel']}"]
    if gap["extended"] <= asked["at_most"]:
        return []
    return [f"held-out {asked['channel']} {gap['extended']:.3g}; limit: {asked['at_most']:.3g}"]
