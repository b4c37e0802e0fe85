"""The folder of a diagnosis: diagnosis.json, plant.yaml, report.html, next-experiment.yaml."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.diagnose.report.extended_plant_file import format_plant_file
from pamctl.diagnose.report.next_experiment import NEXT_EXPERIMENT, format_experiment_file
from pamctl.diagnose.report.page.diagnosis_page import build_diagnosis_page
from pamctl.diagnose.report.rig_at_hand import runs_here
from pamctl.new_file import write_files
from pamctl.report.html_page import Page


def write_diagnosis(
    diagnosis: Diagnosis,
    out: Path,
    logs: Sequence[str],
    records: Sequence[Record],
    *,
    beside: Mapping[str, Any] | None = None,
    story: Callable[[Page], None] | None = None,
    interactive: bool = False,
) -> list[str]:
    """Write the folder, return the names in it; no plant.yaml where the data were refused.

    next-experiment.yaml is there where a program would decide between explanations.

    `logs` are the names of the files behind `records`. The document gets the keys of `beside` too,
    and the page what `story` writes below its head; `interactive` lets its plots be zoomed. Raise
    NewFileError: then nothing is left.
    """
    keys = {**build_diagnosis_document(diagnosis), **(beside or {})}
    document = json.dumps(keys, indent=2, allow_nan=False)
    texts = {out / "diagnosis.json": document + "\n"}
    if not diagnosis.reason:
        texts[out / "plant.yaml"] = format_plant_file(diagnosis, logs)
    if diagnosis.deciding is not None and runs_here(diagnosis):
        text = format_experiment_file(diagnosis.deciding, logs)
        texts[out / f"{NEXT_EXPERIMENT}.yaml"] = text
    texts[out / "report.html"] = build_diagnosis_page(diagnosis, records, story).html(
        interactive=interactive
    )
    write_files(texts)
    return sorted(path.name for path in texts)
