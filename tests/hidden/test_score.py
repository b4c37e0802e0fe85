"""The runner and its lists: whoever knows the truth is right, and a stopped run goes on."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest
import score_diagnosis

from hidden import score_list
from hidden.changes import CHANGES
from hidden.rungs import Said, mark
from hidden.score_list import Handed, ScoredCase, draw_hostile, draw_list, draw_nulls, draw_suite

CASES = [
    *(c for c in [*draw_list(1), *draw_list(2)] if c.group != "dirty"),
    *draw_nulls(1), *draw_hostile(1), *draw_suite(0),
]  # fmt: skip


def know_all(case: ScoredCase) -> Said:
    if case.group == "bad":
        return Said(refusal="a column is clipped")
    names = {min(c.names) for c in case.causes if c.rung != "none" and c.names}
    places = {min(c.where) for c in case.causes if c.rung != "none" and not c.names}
    noise = frozenset(name for name in names if name.startswith("noise."))
    return Said(frozenset(names) - noise, places=frozenset(places), noise=noise)


def test_whoever_knows_the_truth_is_right_everywhere() -> None:
    for case in CASES:
        said = know_all(case)
        verdict, false = mark(case.causes, said, case.ignored)
        verdict = case.correct_verdict(verdict, said)
        assert verdict.startswith(("right", "silent")), (case.key, verdict, false)


def test_whoever_always_says_the_same_is_wrong_nearly_everywhere() -> None:
    said = Said(frozenset({"stribeck"}))
    wrong = sum(mark(c.causes, said, c.ignored)[0] == "wrong name" for c in CASES)
    assert wrong > 0.95 * len(CASES)


def test_silence_is_right_only_where_nothing_must_be_said() -> None:
    for case in CASES:
        asked = any(cause.rung != "none" for cause in case.causes)
        assert mark(case.causes, Said())[0] == ("missed" if asked else "silent"), case.key


def nothing(records: Handed, plant: object) -> Said:
    assert records[0]
    assert plant
    return Said()


def endless(records: Handed, plant: object) -> Said:
    while True:
        pass


def run(monkeypatch: pytest.MonkeyPatch, results: Path, core: str) -> None:
    options = ["--only", "null/parameters", "--jobs", "1", "--cpu-limit-s", "0.2"]
    monkeypatch.setattr(
        sys, "argv",
        ["score_diagnosis.py", *options, "--core", f"hidden.test_score:{core}",
         "--results", str(results)],
    )  # fmt: skip
    score_diagnosis.main()


def test_cores_stand_side_by_side_and_nothing_is_run_twice(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    results = tmp_path / "results.jsonl"
    for core in ("nothing", "endless", "nothing"):
        run(monkeypatch, results, core)
        with results.open("a") as file:
            file.write('{"key": "what a kill lea\n')
    table = capsys.readouterr().out
    assert len(results.read_text().splitlines()) == 2 + 3
    row = next(line for line in table.splitlines()[::-1] if line.startswith("| null/parameters"))
    assert "**silent**" in row
    assert "**no answer**" in row


def test_the_same_records_in_other_words_are_the_same_physics() -> None:
    case = next(c for c in score_list.draw_list(1) if c.key.startswith("null/"))
    handed, plant = case.make()
    plain = handed[0][1]
    halves = CHANGES["cut"](handed, plant, 2.0)[0][0]
    assert len(halves) == 2 * len(handed[0])
    assert sum(len(r.t_s) for r in halves) == sum(len(r.t_s) for r in handed[0])
    slow = CHANGES["half_rate"](handed, plant, 0.0)[0][0][1]
    assert slow.t_s[-1] == pytest.approx(plain.t_s[-1], abs=3e-3)
    assert len(slow.t_s) == (len(plain.t_s) + 1) // 2
    doubled = CHANGES["guess"](handed, plant, 2.0)[1]
    assert doubled["parameters"]["mass_kg"] == 2.0 * plant["parameters"]["mass_kg"]
    imported = CHANGES["units"](([plain], []), plant, 0.0)[0][0][0]
    for name, column in replace(plain, t_s=plain.t_s - plain.t_s[0]).columns().items():
        read = imported.columns()[name]
        assert read == pytest.approx(column, rel=1e-6, abs=1e-7), name


def test_a_name_that_is_taken_out_is_not_asked_but_its_place_is() -> None:
    case = next(c for c in CASES if c.key.startswith("left_out/cubic_stiffness"))
    assert case.without == ("cubic_stiffness",)
    (cause,) = case.causes
    assert "cubic_stiffness" not in cause.names
    at_place = Said(places=frozenset({("force", "curve")}))
    assert mark([cause], at_place)[0].startswith("right")
    assert mark([cause], Said(frozenset({"stribeck"})))[0] == "wrong name"
