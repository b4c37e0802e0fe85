"""A diagnosis that is interrupted keeps what it found, and claims nothing."""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Collection
from pathlib import Path

import numpy as np
import pytest
from support.command_line import start_process
from support.made_records import ask_only, measured, names_of

from pamctl.diagnose import DiagnosisInterrupted, Record, Verdict, diagnose
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.diagnose.report.diagnosis_page import build_diagnosis_page
from pamctl.exit_codes import ExitCode
from pamctl.plant.model import PlantSettings
from pamctl.report.html_page import write_html

ASKED = ("valve_deadband", "chamber_leak", "opening~", "flow~")


def measure() -> Record:
    return measured("fit", valve_deadband__fill_width_v=0.3, chamber_leak__area_m2=2e-8)


def interrupt_at(words: str, times: int, record: Record, asked: Collection[str] = ASKED) -> None:
    """Diagnose a record, with an interrupt where progress says these words."""
    heard = 0

    def hear(line: str) -> None:
        nonlocal heard
        heard += words in line
        if heard == times:
            heard = 100
            raise KeyboardInterrupt

    diagnose([record], [], PlantSettings(), without=ask_only(*asked), progress=hear)
    raise AssertionError("it ended before the interrupt")


def test_the_first_finding_is_kept_and_is_not_called_sure() -> None:
    with pytest.raises(DiagnosisInterrupted) as stopped:
        interrupt_at("explanations asked", 2, measure())
    found = stopped.value.diagnosis
    assert found.verdict is Verdict.INTERRUPTED
    (first,) = found.findings
    assert first.level == "unjudged"
    assert names_of(found) == []
    assert {*found.plant.acting} == {first.name}
    document = build_diagnosis_document(found)
    assert document["effects"] == document["terms"] == document["ambiguous"] == []
    html = write_html(build_diagnosis_page(found, [*found.train]))
    assert "Interrupted; found until then" in html


def test_before_the_first_finding_the_recalibrated_model_is_kept() -> None:
    with pytest.raises(DiagnosisInterrupted) as stopped:
        interrupt_at("explanations asked", 1, measure())
    found = stopped.value.diagnosis
    assert (found.verdict, found.findings) == (Verdict.INTERRUPTED, ())
    assert found.recalibrated


def test_an_interrupt_after_the_verdict_loses_the_next_program_alone() -> None:
    strokes = measured("squares", null_offset__offset_v=0.1)
    alike = ("null_offset", "valve_asymmetry", "valve_deadband")
    with pytest.raises(DiagnosisInterrupted) as stopped:
        interrupt_at("choosing the program", 1, strokes, alike)
    assert stopped.value.diagnosis.verdict is not Verdict.INTERRUPTED


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, ExitCode.SIGINT), (signal.SIGTERM, ExitCode.SIGTERM)]
)
def test_a_signal_writes_the_folder_and_says_so(
    number: signal.Signals, code: ExitCode, tmp_path: Path
) -> None:
    record = measure()
    rows = np.stack([record.t_s, record.valve_v, record.pressure_pa, record.position_m], axis=1)
    csv, out = tmp_path / "run.csv", tmp_path / "out"
    np.savetxt(csv, rows, delimiter=",", header="t_s,valve_v,pressure_pa,position_m", comments="")
    command = [sys.executable, "-m", "pamctl", "diagnose", str(csv), "--out", str(out)]
    verb = start_process(command)
    assert verb.stderr is not None
    said = ""
    while "recalibrated" not in said:
        said = verb.stderr.readline()
        assert said, "the verb ended"
    verb.send_signal(number)
    printed, told = verb.communicate(timeout=120)
    assert verb.returncode == code
    assert "interrupted: writing what was found so far" in told
    assert "Traceback" not in told
    assert printed.startswith("interrupted: Interrupted; found until then")
    assert json.loads((out / "diagnosis.json").read_text())["verdict"] == "interrupted"
    assert {f.name for f in out.iterdir()} == {"diagnosis.json", "plant.yaml", "report.html"}
