"""The suite's runner: it draws, stops, goes on, and ends cases that do not end."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import hostile_suite
import pytest

from hidden.hostile.situations import HostileCase

MISCALIBRATED: dict[str, Any] = {
    "document": {"verdict": "miscalibrated", "effects": [], "ambiguous": []},
    "seconds": 1.0,
}


def run_suite(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *options: str
) -> str:
    monkeypatch.setattr(sys, "argv", ["hostile_suite.py", *options])
    hostile_suite.main()
    return capsys.readouterr().out


def test_a_sample_is_the_same_for_the_same_seed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    first, again, other = (
        run_suite(monkeypatch, capsys, "--limit", "12", "--seed", seed, "--list").split()
        for seed in ("1", "1", "2")
    )
    assert len(set(first)) == 12
    assert first == again
    assert first != other


def test_cases_are_chosen_by_name_size_and_excitation(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--only", "null_up", "--size", "large", "--excitation", "open", "--list")
    assert run_suite(monkeypatch, capsys, *options).split() == ["null_up/large/open"]


def test_a_stopped_examination_goes_on_and_a_case_without_end_is_ended(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    examined: list[str] = []

    def examine(case: HostileCase) -> dict[str, Any]:
        examined.append(case.id)
        if case.excitation == "random":
            while True:
                pass
        if case.excitation == "closed" and examined.count(case.id) == 1:
            raise ValueError("a crash")
        return MISCALIBRATED

    monkeypatch.setattr(hostile_suite, "examine", examine)
    stored = tmp_path / "results.jsonl"
    options = ("--only", "nothing/small", "--resume", str(stored), "--cpu-limit-s", "0.2")
    first = json.loads(run_suite(monkeypatch, capsys, *options))
    assert first["without_answer"] == {
        "nothing/small/closed": "CRASH ValueError: a crash",
        "nothing/small/random": "no answer within 0.2 s",
    }
    assert first["summary"]["all"]["cases"] == 1
    second = json.loads(run_suite(monkeypatch, capsys, *options))
    assert examined[3:] == ["nothing/small/closed"], "only what crashed is run again"
    assert second["cases"]["nothing/small/open"]["mark"] == "silent"
    assert second["summary"]["all"]["cases"] == 2
