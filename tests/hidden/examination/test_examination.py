"""`pamctl diagnose` on a few hidden rigs; `scripts/hidden_suite.py` asks for all of them."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hidden.examination.cases import Case, damaged_cases, quick_cases
from hidden.examination.examine import examine
from hidden.examination.scoring import Result

ROOT = Path(__file__).resolve().parents[3]
BRIEF = {case.id: case for case in quick_cases()}
REFUSED = [replace(c, program="brief") for c in damaged_cases() if c.group == "bad"]


@pytest.mark.long
def test_a_hidden_effect_is_named_and_its_gap_closed() -> None:
    case = BRIEF["single/valve_deadband/3"]
    result = Result(case, **examine(case))
    assert result.mark == "right"
    assert result.closed is not None
    assert result.closed > 0.95
    assert result.document["setup"] == [], "a right set-up is not blamed"


@pytest.mark.parametrize("case", REFUSED, ids=lambda case: case.id)
def test_misleading_data_are_refused_with_the_reason(case: Case) -> None:
    document = examine(case)["document"]
    assert document["verdict"] == "bad_data"
    assert document["reason"]
    assert document["effects"] == []


def test_an_interrupted_examination_is_resumed(tmp_path: Path) -> None:
    suite = runpy.run_path(str(ROOT / "scripts" / "hidden_suite.py"))
    results = tmp_path / "results.jsonl"
    first, second = REFUSED[:2]

    def run_suite(*cases: Case) -> dict[str, Any]:
        tasks = {suite["key"](case): case for case in cases}
        found: dict[str, Any] = suite["run_resumable"](
            tasks, suite["examine_case"], results, workers=1
        )
        return found

    run_suite(first)
    done = results.read_text()
    with results.open("a") as file:
        file.write(done[: len(done) // 2] + "\n")  # what a kill leaves of a line
    found = run_suite(first, second)
    assert {value["document"]["verdict"] for value in found.values()} == {"bad_data"}
    assert results.read_text().startswith(done)
    assert len(results.read_text().splitlines()) == 3, "the first case was not run again"
