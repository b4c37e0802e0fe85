"""`scripts/fault_rounds.py` takes hours: it reports as it goes, and can be stopped and resumed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

WELL = {"safe_after_ms": 3.0, "ticks_lost": 0}
ROUNDS = [("sim loop killed", WELL), ("sim loop frozen", {"amiss": "8 V"})]


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "scripts")
    import fault_rounds

    return fault_rounds


def test_what_was_done_before_ctrl_c_is_told_kept_and_not_done_again(
    script, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = tmp_path / "faults.jsonl"
    monkeypatch.setattr("sys.argv", ["fault_rounds.py", "--resume", str(kept)])

    def stopped(count, timing, done):
        yield from ROUNDS
        raise KeyboardInterrupt

    monkeypatch.setattr(script, "rounds", stopped)
    assert script.main() == 130
    said = capsys.readouterr()
    assert "safe after 3.0 ms" in said.err
    assert "AMISS: 8 V" in said.err
    assert json.loads(said.out)["stopped"]
    assert json.loads(said.out)["cases"]["sim loop frozen"]["amiss"] == ["8 V"]

    with kept.open("a") as file:
        file.write('{"timing": "on_dem')  # killed while it wrote
    asked = []
    monkeypatch.setattr(script, "rounds", lambda count, timing, done: asked.append(done) or ())
    assert script.main() == 3
    assert asked == [{"sim loop killed": 1, "sim loop frozen": 1}]
    assert json.loads(capsys.readouterr().out)["cases"]["sim loop killed"]["well"] == 1


def test_rounds_that_are_done_are_left_out(script, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script, "round_of", lambda *_: dict(WELL))
    monkeypatch.setattr(script, "next_start", lambda *_: None)
    all_of_them = [case for case, _ in script.rounds(2, "on_demand", script.Counter())]
    assert len(all_of_them) == 2 * 2 * len(script.PROCESSES) * len(script.SIGNALS)
    done = script.Counter({all_of_them[0]: 2, all_of_them[1]: 1})
    rest = [case for case, _ in script.rounds(2, "on_demand", done)]
    assert len(rest) == len(all_of_them) - 3
    assert all_of_them[0] not in rest
