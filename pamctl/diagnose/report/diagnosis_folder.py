"""The folder of a diagnosis: diagnosis.json, plant.yaml and report.html."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.diagnose.report.extended_plant_file import format_plant_file
from pamctl.diagnose.report.page.diagnosis_page import build_diagnosis_page
from pamctl.new_file import write_files


def write_diagnosis(
    diagnosis: Diagnosis,
    out: Path,
    logs: Sequence[str],
    records: Sequence[Record],
    *,
    interactive: bool = False,
) -> list[str]:
    """Write the folder, return the names in it; no plant.yaml where the data were refused.

    `logs` are the names of the files behind `records`. `interactive` adds a script to the page.
    Raise NewFileError: then nothing is left.
    """
    document = json.dumps(build_diagnosis_document(diagnosis), indent=2, allow_nan=False)
    texts = {out / "diagnosis.json": document + "\n"}
    if not diagnosis.reason:
        texts[out / "plant.yaml"] = format_plant_file(diagnosis, logs)
    texts[out / "report.html"] = build_diagnosis_page(diagnosis, records).html(
        interactive=interactive
    )
    write_files(texts)
    return sorted(path.name for path in texts)
