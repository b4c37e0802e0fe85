"""`pamctl diagnose` as a method of the benchmark."""

from __future__ import annotations

from typing import Any

from hidden.benchmark.records_folder import Task
from pamctl.diagnose import Record, diagnose
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.plant.model import PlantSettings


def diagnose_task(task: Task) -> dict[str, Any]:
    """Return the document of a diagnosis, which is a verdict."""
    train, held_out = (
        [Record(name=f"{role}-{number}", **columns) for number, columns in enumerate(part, 1)]
        for role, part in (("train", task.train), ("held-out", task.held_out))
    )
    start = PlantSettings.model_validate(task.card["start_model"])
    found = diagnose(train, held_out, start, without=task.card["names_not_to_use"])
    return build_diagnosis_document(found)
