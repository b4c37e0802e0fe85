"""The suite of hidden rigs, what its excitations can show, and `pamctl diagnose` on a few."""

from dataclasses import replace
from typing import Any

import pytest
from support.made_records import to_records

from hidden.effects import SINGLES
from hidden.examination.cases import Case, blind_cases, damaged_cases, single_cases
from hidden.examination.oracle import HOPELESS, SURE, oracle_of
from pamctl.diagnose import diagnose
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document

REFUSED = [replace(c, program="brief") for c in damaged_cases() if c.group == "bad"]


def examine(case: Case) -> dict[str, Any]:
    """Return the document of a case."""
    return build_diagnosis_document(diagnose(*to_records(case.records()), case.start_plant()))


@pytest.mark.parametrize("case", REFUSED, ids=lambda case: case.id)
def test_misleading_data_are_refused_with_the_reason(case: Case) -> None:
    document = examine(case)
    assert document["verdict"] == "bad_data"
    assert document["reason"]
    assert document["effects"] == []


def test_effects_that_the_squares_cannot_show_are_not_required() -> None:
    seen = oracle_of("squares")
    for case in blind_cases():
        if case.program == "squares":
            name, size = next(iter(case.effects.items()))
            assert seen[name][str(size)]["alone"] < HOPELESS


def test_the_diagnosis_program_shows_all_large_effects() -> None:
    large = [case for case in single_cases() if case.id.endswith("/10")]
    assert [next(iter(case.effects)) for case in large] == [*SINGLES]
    assert all(oracle_of("standard")[name]["10"]["alone"] >= SURE for name in SINGLES)
