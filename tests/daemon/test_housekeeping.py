"""What the daemon does beside its runs: none of it holds up a trip, or ends the daemon."""

from __future__ import annotations

import threading
import time
from pathlib import Path

from support.patience import PATIENCE_S

from pamctl.daemon.announcements import MonitorDesk
from pamctl.daemon.shelf import Latch, Shelf


def test_a_log_that_cannot_be_removed_is_told_and_the_others_still_go(tmp_path: Path) -> None:
    stuck, old, newest = (tmp_path / f"20260101-00000{number}-daemon-x.mcap" for number in range(3))
    stuck.mkdir()  # no file: it cannot be unlinked, whoever asks
    old.touch()
    newest.touch()
    problem = Shelf(tmp_path, keep=1).put_away(newest)
    assert str(stuck) in problem
    assert not old.exists()
    assert newest.exists()


def test_the_first_reason_of_a_fault_stays_until_it_is_acknowledged(tmp_path: Path) -> None:
    latch = Latch(tmp_path / "fault")
    latch.engage("the cause")
    latch.engage("what came of it")
    assert latch.reason == Latch(tmp_path / "fault").reason == "the cause"
    assert latch.release() == "the cause"
    assert Latch(tmp_path / "fault").reason == ""


def test_a_trip_of_the_monitor_does_not_wait_for_a_mark_that_is_held_up() -> None:
    held_up, tripped = threading.Event(), []
    desk = MonitorDesk(
        None, lambda *_, **__: None, lambda _: held_up.wait(PATIENCE_S), tripped.append
    )
    alarm = {
        "kind": "alarm", "block": "mechanics", "since_s": 0.0, "over_floor": 4.0, "rms": 1e-4,
        "activity": "moving",
    }  # fmt: skip
    began_s = time.monotonic()
    desk._take(alarm)
    held_up.set()
    assert len(tripped) == 1
    assert time.monotonic() - began_s < PATIENCE_S / 2
