"""`scripts/fault_rounds.py` takes hours: it reports as it goes, and can be stopped and resumed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from standin.standin import require_compiler
from support.patience import BUSY_PC, PATIENCE_S

from pamctl.log.reader import read

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

    def stopped(count, done, hits, names, drawn):
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
        file.write('{"case": "sim lo')  # killed while it wrote
    asked = []
    monkeypatch.setattr(script, "rounds", lambda count, done, *_: asked.append(done) or ())
    assert script.main() == 3
    assert asked == [{"sim loop killed": 1, "sim loop frozen": 1}]
    assert json.loads(capsys.readouterr().out)["cases"]["sim loop killed"]["well"] == 1


# --- real processes -------------------------------------------------------------------------

HARDEST = [
    # Nobody but the front is left to see it.
    ("nidaq", ("guardian", "frozen"), ("loop", "frozen")),
    # Nobody is left who knows the ring but a guardian, or a loop: they start a finisher.
    ("daemon", ("front", "killed"), ("recorder", "frozen")),
    # The loop ends because its guardian is gone, and the front dies just after it.
    ("sim", ("guardian", "killed"), ("recorder", "killed"), ("front", "killed")),
]


@pytest.mark.long
@pytest.mark.parametrize("case", HARDEST, ids=lambda case: " ".join(sum(case[1:], case[:1])))
def test_a_real_run_keeps_its_promises_whichever_processes_are_hit(
    script, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, case: tuple[Any, ...]
) -> None:
    require_compiler()
    name, *faults = case
    monkeypatch.setattr(script, "PATIENCE_S", PATIENCE_S)
    monkeypatch.setattr(script, "OPTIONS", [*script.OPTIONS, *BUSY_PC])
    with script.benches(tmp_path) as rigs:
        bench = next(rig for rig in rigs if rig.name == name)
        found = script.round_of(bench, faults, tmp_path / "run.mcap")
    assert found["ticks_lost"] == 0
    if case == HARDEST[0]:
        told = [event["event"] for event in read(tmp_path / "run.mcap").events]
        assert told.count("front_takeover") == 1
