"""`plant.yaml`: the model to go on with, for run, tune, compare and a next diagnosis."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.report.finding_words import list_numbers
from pamctl.diagnose.report.open_findings import list_faults
from pamctl.diagnose.report.verdict_words import sentence
from pamctl.settings.yaml12 import dump_yaml


def format_plant_file(diagnosis: Diagnosis, logs: Sequence[str]) -> str:
    """Write the diagnosis's plant as YAML, its origin and intervals as comments."""
    data: dict[str, Any] = diagnosis.plant.model_dump(
        mode="json", round_trip=True, exclude_none=True
    )
    return "".join(f"# {line}\n" for line in _head_lines(diagnosis, logs)) + dump_yaml(data)


def _head_lines(diagnosis: Diagnosis, logs: Sequence[str]) -> Iterator[str]:
    yield f"Written by `pamctl diagnose` from {', '.join(logs)}."
    yield f"Verdict: {diagnosis.verdict.value}. {sentence(diagnosis)}"
    for fault in list_faults(diagnosis):
        yield f"Set-up: {fault.text}. To mend it: {fault.how_to_mend}."
    numbers = [*diagnosis.recalibrated, *(n for f in diagnosis.findings for n in list_numbers(f))]
    if numbers:
        yield "Fitted, with 90 % intervals:"
    for n in numbers:
        yield f"  {n.name} {n.value:.6g}, {n.low:.6g} to {n.high:.6g} {n.unit}".rstrip()
