"""The scoring gives every kind of document its mark."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest

from hidden.effects import SINGLES
from hidden.examination.cases import (
    PAIRS,
    QUICK,
    Case,
    all_cases,
    blind_cases,
    quick_cases,
    single_cases,
)
from hidden.examination.oracle import HOPELESS
from hidden.examination.scoring import Result, detectable, figures, mark, oracle_of, twins

CASES = {case.id: case for case in all_cases(null_each=1)}


def said(verdict: str, *names: str, sets: tuple[tuple[str, ...], ...] = (), **more: Any) -> Any:
    """Make the document of DESIGN section 7 as far as marks go."""
    return {
        "verdict": verdict,
        "effects": [{"name": name, "parameters": {}} for name in names],
        "ambiguous": [list(group) for group in sets],
        "blind_spots": [{"name": name} for name in more.get("blind", ())],
        "gap": more.get("gap", {}),
        "setup": [{"kind": kind, "number": number} for kind, number in more.get("setup", ())],
    }


SCALED = (("scale", "position_m"),)
SCALED_SET = (("stribeck", "scale of position_m"),)


@pytest.mark.parametrize(
    ("case", "document", "expected"),
    [
        ("null/parameters", said("miscalibrated"), "silent"),
        ("null/nothing", said("partial", "stribeck"), "alarm"),
        ("null/nothing", said("none_known"), "alarm"),
        ("null/nothing", said("bad_data"), "refused"),
        ("single/creep/10", said("named", "creep"), "right"),
        ("single/creep/10", said("named", "creep", "stribeck"), "wrong"),
        ("single/creep/10", said("named", "stribeck"), "wrong"),
        ("single/creep/10", said("partial", "creep"), "right_partial"),
        ("single/creep/10", said("partial", "stribeck"), "misleading"),
        ("single/creep/10", said("partial", "creep", "stribeck"), "misleading"),
        ("single/creep/10", said("none_known"), "honest"),
        ("single/creep/10", said("no_discrepancy"), "missed"),
        ("single/creep/10", said("bad_data"), "refused"),
        (
            "single/valve_spool/3",
            said("ambiguous", "command_delay", sets=(("command_delay", "valve_spool"),)),
            "right_set",
        ),
        (
            "single/valve_spool/3",
            said("ambiguous", "polytropic", sets=(("polytropic", "dead_volume"),)),
            "misleading",
        ),
        ("pair/deadband+creep", said("named", "creep", "valve_deadband"), "right"),
        ("pair/deadband+creep", said("named", "creep"), "right_partial"),
        (
            "pair/deadband+creep",
            said("ambiguous", "creep", "valve_deadband", sets=(("creep", "stribeck"),)),
            "right_set",
        ),
        ("left_out/valve_deadband", said("none_known"), "honest"),
        ("left_out/valve_deadband", said("named", "polytropic"), "wrong"),
        ("left_out/valve_deadband", said("partial", "polytropic"), "misleading"),
        ("unknown/hysteretic_spring", said("partial", "coulomb_friction"), "right_partial"),
        ("unknown/hysteretic_spring", said("named", "coulomb_friction"), "wrong"),
        ("unknown/moving_mass", said("miscalibrated"), "silent"),
        ("single/encoder_scale/10", said("miscalibrated", setup=SCALED), "right"),
        ("left_out/encoder_scale", said("miscalibrated", setup=SCALED), "right"),
        ("left_out/encoder_scale", said("ambiguous", "stribeck", sets=SCALED_SET), "right_set"),
        ("single/creep/10", said("miscalibrated", setup=SCALED), "wrong"),
        ("null/nothing", said("miscalibrated", setup=SCALED), "alarm"),
        ("bad/stuck", said("bad_data"), "right"),
        ("bad/stuck", said("named", "valve_deadband"), "missed"),
        ("blind/valve_deadband", said("miscalibrated"), "silent"),
    ],
)
def test_a_document_gets_the_expected_mark(case: str, document: Any, expected: str) -> None:
    assert mark(CASES[case], document) == expected


def test_effects_that_the_squares_cannot_show_are_not_required() -> None:
    seen = oracle_of("squares")
    for case in blind_cases():
        if case.program == "squares":
            name, size = next(iter(case.effects.items()))
            assert seen[name][str(size)]["alone"] < HOPELESS
        assert detectable(case) is False


def test_the_diagnosis_program_shows_nearly_all_large_effects() -> None:
    large = [case for case in single_cases() if case.id.endswith("/10")]
    assert {next(iter(case.effects)) for case in large} == set(SINGLES)
    assert all(detectable(case) for case in large)


def test_a_spool_and_a_delay_are_near_each_other_and_far_from_creep() -> None:
    rows = oracle_of("standard")["valve_spool"]["3"]
    assert rows["command_delay"] == min(left for rival, left in rows.items() if rival != "alone")
    assert "creep" not in twins(CASES["single/valve_spool/3"])


def test_the_suite_holds_the_requested_cases() -> None:
    count = Counter(case.group for case in all_cases())
    assert count["null"] >= 200
    assert count["single"] == 3 * len(SINGLES) == count["left_out"] * 3
    assert len(PAIRS) == count["pair"] == 8
    assert count["triple"] == 1
    assert [case.id for case in quick_cases()] == list(QUICK)
    keys = [(case.id, case.repeat) for case in all_cases(repeats=2)]
    assert len(keys) == len(set(keys))


def test_a_perfect_examinee_gets_every_figure_that_its_cases_allow() -> None:
    floor = {"nominal": 9.0, "recalibrated": 5.0, "extended": 1.02, "floor": 1.0}
    results = [Result(case, _perfect(case, floor), 1.0) for case in all_cases(null_each=2)]
    assert {r.mark for r in results} <= {"right", "silent", "honest"}
    missed = [line.what for line in figures(results) if not line.reached]
    assert missed == []


def test_an_examinee_that_always_says_stribeck_fails() -> None:
    results = [Result(case, said("named", "stribeck"), 1.0) for case in all_cases(null_each=2)]
    reached = {line.what: line.reached for line in figures(results)}
    assert not reached["right name, detectable and separable singles"]
    assert not reached["false alarm, nothing hidden or parameters only"]
    assert not reached["confirmed wrong name, anywhere"]


def _perfect(case: Case, gap: dict[str, float]) -> Any:
    if case.group == "bad":
        return said("bad_data")
    if not case.effects or case.group == "blind" or detectable(case) is False:
        return said("miscalibrated", blind=tuple(case.effects))
    if case.hidden_names == {"moving_mass"}:
        return said("no_discrepancy")
    if not case.known_names:
        return said("none_known")
    return said("named", *case.known_names, gap={"position_m": gap})
