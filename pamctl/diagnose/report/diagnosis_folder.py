"""The folder of a diagnosis: diagnosis.json, plant.yaml and report.html."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.diagnose.report.diagnosis_page import build_diagnosis_page
from pamctl.diagnose.report.extended_plant_file import format_plant_file


def write_diagnosis(
    diagnosis: Diagnosis, out: Path, logs: Sequence[str], records: Sequence[Record]
) -> None:
    """Write the folder; there is no plant.yaml where the data were refused.

    `logs` are the names of the files behind `records`.
    """
    out.mkdir(parents=True, exist_ok=True)
    document = json.dumps(build_diagnosis_document(diagnosis), indent=2, allow_nan=False)
    (out / "diagnosis.json").write_text(document + "\n")
    if not diagnosis.reason:
        (out / "plant.yaml").write_text(format_plant_file(diagnosis, logs))
    page = build_diagnosis_page(diagnosis, records).html()
    (out / "report.html").write_text(page, encoding="utf-8")
