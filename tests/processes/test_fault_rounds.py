"""`scripts/fault_rounds.py` takes hours: it reports as it goes, and can be stopped and resumed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from standin.standin import require_compiler
from support.patience import BUSY_PC, PATIENCE_S

from pamctl.log.reader import read

Fault = tuple[str, str]
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


def test_rounds_that_are_done_are_left_out(script, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script, "round_of", lambda *_: dict(WELL))
    monkeypatch.setattr(script, "full_disk_round", lambda *_: dict(WELL))
    monkeypatch.setattr(script, "next_start", lambda *_: None)
    all_of_them = [case for case, _ in script.rounds(2, script.Counter())]
    signals = len(script.PROCESSES) * len(script.SIGNALS)
    assert len(all_of_them) == 2 * (5 * signals + 4), "and a full disk where there is no daemon"
    done = script.Counter({all_of_them[0]: 2, all_of_them[1]: 1})
    rest = [case for case, _ in script.rounds(2, done)]
    assert len(rest) == len(all_of_them) - 3
    assert all_of_them[0] not in rest
    drawn = [case for case, _ in script.rounds(1, script.Counter(), drawn=7)]
    assert len({*drawn}) == 7
    assert {*drawn} < {*all_of_them}


def test_pairs_are_all_ordered_pairs_of_two_processes(script) -> None:
    pairs = script.list_faults(2)
    assert len(pairs) == len({*pairs}) == 4 * 3 * 2 * 2
    assert all(one[0] != other[0] for one, other in pairs)
    assert (("loop", "frozen"), ("guardian", "killed")) in pairs


def test_triples_leave_a_process_alive_that_can_make_the_valve_safe(script) -> None:
    triples = script.list_faults(3)
    assert len(triples) == len({*triples}) == 3 * 6 * 8
    hit = [{process for process, _ in faults} for faults in triples]
    assert all(len(processes & {"front", "loop", "guardian"}) == 2 for processes in hit)


def test_the_table_has_a_row_for_each_choice_of_processes(script) -> None:
    found = {
        "sim loop killed, front frozen": [WELL, {"amiss": "8 V"}, {"starved": "no CPU"}],
        "sim front killed, loop killed": [{"safe_after_ms": 80.4, "ticks_lost": 0}],
        "daemon loop killed, guardian killed": [WELL],
    }
    assert script.format_cases(found).splitlines()[2:] == [
        "| front, loop | 2 of 3, 80 ms |  |",
        "| guardian, loop |  | 1 of 1, 3 ms |",
    ]


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
