"""What ends a run from outside: the loop's view of signals, guardian, recorder and front."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from threading import Timer

import pytest
from support.made_up import meta, put

from pamctl.processes.loop_supervisor import LoopSupervisor
from pamctl.realtime.clock import LoopSettings
from pamctl.recording.ring import RecorderFlag, Ring


@pytest.fixture
def ring(tmp_path: Path) -> Iterator[Ring]:
    with Ring.create(tmp_path / "test.ring", meta(tmp_path / "run.mcap"), 256) as made:
        yield made


def make_supervisor(
    ring: Ring, front_fd: int | None = None, *, patient: bool = False
) -> LoopSupervisor:
    return LoopSupervisor(
        ring, front_fd, LoopSettings(ring_rows=256, stop_ramp_s=0.01), patient=patient
    )


def ask_for_stop(supervisor: LoopSupervisor, ms: int) -> tuple[str, bool] | None:
    """Ask at 1 kHz for so long; return the reason to stop, and whether at once."""
    for tick in range(ms):
        at_once = supervisor.wants_abort()
        wanted = supervisor.find_stop(tick)
        if wanted is not None:
            return wanted.reason, at_once
    return None


def test_a_guardian_that_stands_still_is_found_within_the_heartbeat_and_ends_the_run_at_once(ring):
    supervisor = make_supervisor(ring)
    for _ in range(100):
        ring.guardian_beats += 1
        assert ask_for_stop(supervisor, 8) is None
    assert ask_for_stop(supervisor, 40) is None
    assert ask_for_stop(supervisor, 24) == ("the guardian gives no sign of life", True)


def test_where_there_is_no_clock_there_is_no_guardian_to_miss(ring):
    assert ask_for_stop(make_supervisor(ring, patient=True), 2000) is None


def test_during_a_smooth_stop_a_death_still_ends_the_run_at_once(ring):
    supervisor = make_supervisor(ring)
    supervisor._on_signal(signal.SIGINT, None)
    assert ask_for_stop(supervisor, 8) == ("stopped by SIGINT", False)
    ring.guardian_lost = 1
    assert any(supervisor.wants_abort() for _ in range(8))


def await_recorder(supervisor: LoopSupervisor, ring: Ring) -> str | None:
    """Wait as the loop does before the rig is open; return why in vain."""
    ending = supervisor.await_start(
        "recorder", lambda: bool(ring.recorder_flags), lambda: bool(ring.guardian_lost)
    )
    return ending and ending.reason


def test_a_partner_that_starts_late_is_waited_for(ring):
    late = Timer(0.2, ring.raise_flag, [RecorderFlag.READY])
    late.start()
    assert await_recorder(make_supervisor(ring), ring) is None
    late.join()


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        ("partner lost", "the recorder did not start"),
        ("Ctrl-C", "stopped by SIGINT"),
        ("front dead", "the commanding process is gone"),
    ],
)
def test_waiting_for_a_partner_ends_when_it_is_in_vain(ring, what, reason):
    ours, theirs = os.pipe()
    supervisor = make_supervisor(ring, ours)
    match what:
        case "partner lost":
            ring.guardian_lost = 1
        case "Ctrl-C":
            supervisor._on_signal(signal.SIGINT, None)
        case "front dead":
            os.close(theirs)
    assert await_recorder(supervisor, ring) == reason
    os.close(ours)
    if what != "front dead":
        os.close(theirs)


def test_a_full_disk_leaves_time_for_a_smooth_stop(ring):
    supervisor = make_supervisor(ring)
    ring.raise_flag(RecorderFlag.FAILED | RecorderFlag.DISK_FULL)
    assert ask_for_stop(supervisor, 8) == ("the log's disk is full", False)


def test_a_recorder_that_is_too_far_behind_leaves_room_for_a_smooth_stop(ring):
    supervisor = make_supervisor(ring)
    room = LoopSettings(ring_rows=256, stop_ramp_s=0.01).stop_rows
    assert 10 <= room < ring.rows
    for rows, reason in ((ring.rows - room, None), (1, "the recorder is too far behind")):
        put(ring, range(rows))
        ring.guardian_beats += 1
        asked = ask_for_stop(supervisor, 8)
        assert asked == (reason and (reason, False))


def test_a_stop_may_last_longer_than_the_ticks_kept_between_runs(ring, tmp_path):
    """How far behind a recorder may be is a matter of its run's ring."""
    pace = LoopSettings(stop_ramp_s=5.0)
    supervisor = LoopSupervisor(ring, None, pace)
    with Ring.create(tmp_path / "run.ring", meta(tmp_path / "b.mcap"), pace.ring_rows) as run:
        for recorded in (None, run):
            supervisor.watch_recording(recorded)
            ring.guardian_beats += 1
            assert ask_for_stop(supervisor, 40) is None
