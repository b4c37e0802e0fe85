"""A folder of records that any method can read, and the truth in a file apart.

    FOLDER/benchmark.json          version, suite, program, seed, ids, and the names one may say
    FOLDER/ID/card.json            the data card of a case
    FOLDER/ID/train-1.csv ...      records to fit
    FOLDER/ID/held-out-1.csv ...   records to judge by; a method may use them to choose, too

The truth file is for the scorer. Who looks into it, or makes the rigs again from the seed, fools
himself only: a judge takes a seed of his own.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hidden.benchmark.benchmark_suite import VERSION, Suite
from hidden.benchmark.failure import BenchmarkError
from hidden.examination.cases import Case
from hidden.examination.examine import records_of, rig_of, start_plant
from hidden.rig import Record
from hidden.sensors import ADC_STEP_PA, ENCODER_STEP_M

Array = NDArray[np.float64]

COLUMNS = {
    "t_s": "time of the reading, s, rounded to 1e-6",
    "valve_v": "command of the valve, V, -5 to 5, held until the next; positive fills",
    "pressure_pa": f"absolute pressure of the muscle, Pa, in steps of {ADC_STEP_PA:g}, with noise",
    "position_m": f"contraction, m, in steps of {ENCODER_STEP_M:g} from the encoder's zero",
    "force_n": "force that pulls the carriage, N, with noise",
}


@dataclass(frozen=True)
class Task:
    """A case as a method gets it. A record is a mapping from column to values, shape (n,)."""

    id: str
    card: dict[str, Any]
    train: list[dict[str, Array]]
    held_out: list[dict[str, Array]]


def write_records(suite: Suite, folder: Path, truth: Path) -> Iterator[str]:
    """Write the records and the truth of a suite; yield the id of each case that is written."""
    if folder.exists() and any(folder.iterdir()):
        raise BenchmarkError(f"{folder}: is not empty; give a new folder")
    if truth.exists():
        raise BenchmarkError(f"{truth}: exists already; give a new file")
    if folder.resolve() in truth.resolve().parents:
        raise BenchmarkError(f"{truth}: lies in the folder of the records; keep the truth apart")
    truth.parent.mkdir(parents=True, exist_ok=True)
    folder.mkdir(parents=True, exist_ok=True)
    cases = suite.list_cases()
    for id, case in cases.items():
        _write_case(folder / id, id, case)
        yield id
    about = {**suite.describe(), "cases": [*cases], "names": _list_names()}
    _write_json(folder / "benchmark.json", about)
    _write_json(truth, {**suite.describe(), "truth": {id: _tell(c) for id, c in cases.items()}})


def _write_case(folder: Path, id: str, case: Case) -> None:
    folder.mkdir()
    files = []
    for role, records in zip(("train", "held-out"), records_of(case), strict=True):
        for number, record in enumerate(records, 1):
            path = folder / f"{role}-{number}.csv"
            record.write_csv(path)
            files.append(_describe_file(path, role, record))
    columns = {name for file in files for name in file["columns"]}
    start = start_plant(case).model_dump(mode="json", include={"actuator", "parameters"})
    card = {
        "schema": 1,
        "id": id,
        "rig": "pneumatic muscle on a proportional valve"
        if case.actuator == "muscle"
        else "carriage between springs, pulled by a measured force",
        "rate_hz": 1000,
        "columns": {name: text for name, text in COLUMNS.items() if name in columns},
        "files": files,
        "start_model": start,
        "start_model_note": "its numbers may be some per cent off",
        "names_not_to_use": list(case.removed),
        "rest": "every record begins vented and at rest",
    }
    _write_json(folder / "card.json", card)


def _describe_file(path: Path, role: str, record: Record) -> dict[str, Any]:
    return {
        "file": path.name,
        "role": role,
        "excitation": record.name,
        "columns": [*record.columns()],
        "rows": len(record.t_s),
        "seconds": round(float(record.t_s[-1] - record.t_s[0]), 3),
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
    }


def _list_names() -> dict[str, Any]:
    """Return the effects that a verdict may name, with their equations and numbers."""
    from pamctl.plant.catalogue import CATALOGUE

    return {
        name: {
            "sign": effect.signature,
            "equation": effect.equation,
            "blocks": [*effect.seen_by],
            "parameters": {p.name: p.unit for p in effect.parameters if not p.choices},
        }
        for name, effect in CATALOGUE.items()
        if effect.is_searched
    }


def _tell(case: Case) -> dict[str, Any]:
    rig = rig_of(case)
    told = {field.name: getattr(case, field.name) for field in fields(case)}
    sensors = {"pressure_noise_pa": rig.sensors.pressure_noise_pa}
    return {**told, "seed": case.seed, "truth": rig.truth._asdict(), "sensors": sensors}


def read_truth(path: Path) -> dict[str, Case]:
    """Return the cases of a truth file by id; raise `BenchmarkError` where it is none."""
    told = read_json(path)
    if told.get("version") != VERSION or "truth" not in told:
        raise BenchmarkError(
            f"{path}: is no truth of version {VERSION} (found {told.get('version')}); "
            "write the records again"
        )
    names = {field.name for field in fields(Case)}
    cases = {}
    for id, one in told["truth"].items():
        known = {name: value for name, value in one.items() if name in names}
        sizes = {n: tuple(s) if isinstance(s, list) else s for n, s in known["effects"].items()}
        tuples = {name: tuple(known[name]) for name in ("lacks", "removed")}
        cases[id] = Case(**{**known, **tuples, "effects": sizes})
    return cases


def list_ids(folder: Path) -> list[str]:
    """Return the ids of the cases of a folder of records."""
    about = read_json(folder / "benchmark.json")
    if about.get("version") != VERSION:
        raise BenchmarkError(
            f"{folder}: holds version {about.get('version')}, this is {VERSION}; "
            "write the records again"
        )
    return list(about["cases"])


def read_task(folder: Path, id: str) -> Task:
    """Read a case; raise `BenchmarkError` where a file is not the one that was written."""
    card = read_json(folder / id / "card.json")
    parts: dict[str, list[dict[str, Array]]] = {"train": [], "held-out": []}
    for file in card["files"]:
        path = folder / id / file["file"]
        content = path.read_bytes() if path.exists() else b""
        if hashlib.sha256(content).hexdigest() != file["sha256"]:
            raise BenchmarkError(f"{path}: is missing or was changed; write the records again")
        rows = np.loadtxt(content.decode().splitlines()[1:], delimiter=",", ndmin=2)
        columns = dict(zip(file["columns"], rows.T, strict=True))
        parts[file["role"]].append({name: np.ascontiguousarray(c) for name, c in columns.items()})
    return Task(id, card, parts["train"], parts["held-out"])


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object; raise `BenchmarkError` where there is none."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise BenchmarkError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise BenchmarkError(f"{path}: is no JSON: {error}") from None
    if not isinstance(found, dict):
        raise BenchmarkError(f"{path}: holds no JSON object")
    return found


def _write_json(path: Path, document: dict[str, Any]) -> None:
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
