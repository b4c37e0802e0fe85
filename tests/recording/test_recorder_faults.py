"""Whichever process dies, and when the disk is full: no row is lost, no file overwritten."""

import errno
import os
import random
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from mcap.opcode import Opcode
from support.made_up import START_MONO_NS, columns, end, meta, put, recording, tick
from support.patience import PATIENCE_S
from support.small_log import require_right_index

from hal.child import child_command
from pamctl.base.errors import Ending, ExitCode
from pamctl.log import info, read
from pamctl.log.check import check_log
from pamctl.log.framing import FileRecord
from pamctl.log.record_walk import find_records
from pamctl.log.recover import recover_file, resume_log
from pamctl.recording import drain, journal
from pamctl.recording.drain import record_run
from pamctl.recording.recorded_run import ProcessRecordedRun
from pamctl.recording.recorder import (
    RecorderError,
    await_recorder,
    finish_orphans,
    record,
    spawn_recorder,
)
from pamctl.recording.ring import RecorderFlag, Ring

LONG_AGO_NS = 1


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return tmp_path / "run.mcap"


@contextmanager
def new_ring(log: Path, rows: int = 16384) -> Iterator[Ring]:
    with Ring.create(log.parent / "pamctl-run.ring", meta(log), rows) as ring:
        yield ring


def put_with_events(ring: Ring, ticks: range) -> None:
    for index in ticks:
        if index % 100 == 0:
            ring.put_event(index, START_MONO_NS, {"event": "mark", "text": "x" * (index % 1300)})
        put(ring, [index])


class Here:
    """The owner of a recording that is made in this process."""

    gone = False

    def wait(self, seconds: float) -> None:
        time.sleep(seconds)


def finish(ring_path: Path) -> int:
    """Let a recorder that nobody owns finish the log, as guardian, loop or next start do."""
    return subprocess.run(child_command("pamctl.recording.recorder", ring_path, "alone")).returncode


def assert_complete(log: Path, ticks: int) -> None:
    """Check that each tick and each event of `put_with_events` is in the log once, unchanged."""
    seen = read(log)
    assert seen["tick"].tolist() == list(range(ticks))
    for index in range(0, ticks, 97):
        assert {name: seen[name][index] for name in seen.columns} == columns(tick(index))
    assert [event["tick"] for event in seen.events] == list(range(0, ticks, 100))
    assert all(len(event["text"]) == event["tick"] % 1300 for event in seen.events)


# The recorder dies.


def test_after_the_recorder_is_killed_the_log_is_complete_to_the_last_tick(log):
    ticks, moment = 6000, random.uniform(0.0, 0.25)
    with new_ring(log) as ring, recording(ring) as process:
        killer = threading.Timer(moment, process.kill)
        killer.start()
        put_with_events(ring, range(ticks))
        killer.join()
        assert process.wait() == -signal.SIGKILL
        assert finish(ring.path) == 0
        assert not ring.path.exists()
        assert not ring.recorder_flags & RecorderFlag.GAPS
    assert check_log(log).ok
    require_right_index(log)
    assert_complete(log, ticks)
    assert list(log.parent.iterdir()) == [log]


def test_of_a_killed_recorders_file_alone_every_whole_chunk_is_recovered(log):
    with new_ring(log) as ring, recording(ring) as process:
        put(ring, range(3000))
        while not ring.tail:
            time.sleep(1e-3)
        put(ring, range(3000, 6000))
        process.kill()
        process.wait()
        in_file = ring.tail  # it moves when a chunk is in the file
    recovery = recover_file(log, log.with_name("saved.mcap"))
    saved = read(log.with_name("saved.mcap"))
    assert len(saved) >= in_file > 0
    assert saved["tick"].tolist() == list(range(len(saved)))
    assert recovery.messages["/pam/tick"] == len(saved)
    assert not recovery.lossless


def test_a_recorder_killed_before_it_had_a_file_costs_nothing(log):
    with new_ring(log) as ring:
        put_with_events(ring, range(500))
        finish(ring.path)
    assert_complete(log, 500)


def test_a_front_whose_loop_has_had_the_log_finished_still_says_that_its_recorder_died(log):
    with new_ring(log) as ring:
        run = ProcessRecordedRun("run", ring)
        await_recorder(ring, run.recorder)
        put_with_events(ring, range(300))
        run.recorder.kill()
        run.recorder.wait()
        ring.loop_done = 1
        finish(ring.path)  # the recorder of the loop comes before the front looks
        report = run.finish(Ending(ExitCode.OK, ""))
    assert report.log_is_whole
    assert report.ending.code == ExitCode.UNEXPECTED
    assert report.note.endswith(f"died with -9; the log was finished from the ring: {log}")
    assert_complete(log, 300)


def test_a_log_that_is_finished_twice_has_nothing_twice(log):
    with new_ring(log) as ring, recording(ring) as process:
        put_with_events(ring, range(600))
        time.sleep(0.2)
        process.kill()
        process.wait()
        ring.tail = 0  # as if the recorder had died before it moved the tail
        finish(ring.path)
    assert_complete(log, 600)


def test_whoever_finishes_the_log_may_die_too(log):
    chance = random.Random(1)
    with new_ring(log) as ring, recording(ring) as process:
        put_with_events(ring, range(3000))
        process.kill()
        process.wait()
        for _ in range(3):
            next_one = spawn_recorder(ring.path)
            while not ring.path.exists() or ring.recorder_pid != next_one.pid:
                time.sleep(1e-3)
            time.sleep(chance.uniform(0, 0.4))
            next_one.kill()
            end(next_one)
        if ring.path.exists():
            finish(ring.path)
    assert_complete(log, 3000)
    assert list(log.parent.iterdir()) == [log]


DIE_AT_THE_EXCHANGE = """
import os, signal, sys
from pathlib import Path
from pamctl.recording import recorder
exchange = Path.replace
def replace(draft, target):
    if sys.argv[2] == "after":
        exchange(draft, target)
    os.kill(os.getpid(), signal.SIGKILL)
Path.replace = replace
recorder.main([sys.argv[1], "alone"])
"""


def test_dying_on_either_side_of_the_exchange_of_a_damaged_file_leaves_one_log(log):
    with new_ring(log) as ring, recording(ring) as process:
        for begin in range(0, 3000, 300):  # no faster than it writes: chunks stay short
            put_with_events(ring, range(begin, begin + 300))
            while ring.pending > 250:
                time.sleep(1e-3)
        process.kill()
        process.wait()
        _, damaged, *_ = (r for r in walk_log(log) if r.opcode == Opcode.CHUNK)
        with log.open("r+b") as file:  # a bad sector, say
            file.seek((damaged.start + damaged.end) // 2)
            file.write(b"bad sector")
        for death in ("before", "before", "after"):
            command = [sys.executable, "-c", DIE_AT_THE_EXCHANGE, ring.path, death]
            done = subprocess.run(command, stdin=subprocess.DEVNULL)
            assert done.returncode == -signal.SIGKILL
        finish(ring.path)
        assert ring.recorder_flags & RecorderFlag.GAPS
    ticks = read(log)["tick"]
    assert (ticks[0], ticks[-1]) == (0, 2999)
    assert np.all(np.diff(ticks) > 0)
    assert 0 < 3000 - len(ticks) < 2100
    assert list(log.parent.iterdir()) == [log]


def walk_log(log: Path) -> list[FileRecord]:
    """Return the records of a log that is not finished."""
    found = find_records(memoryview(log.read_bytes()))
    return [record for record in found if isinstance(record, FileRecord)]


@pytest.mark.parametrize("finished", [False, True])
def test_a_log_that_is_cut_anywhere_is_taken_up_behind_its_last_whole_chunk(log, finished):
    whole = Path(__file__).parents[1] / "golden" / "qsmc.mcap"
    records = walk_log(whole)
    data = whole.read_bytes()
    first = next(record.end for record in records if record.opcode == Opcode.CHUNK)
    ends = [record.end for record in records if record.end > first]
    cuts = [len(data)] if finished else [first, *ends[:20], *(end - 3 for end in ends[:20])]
    before = read(whole)
    for cut in sorted(cuts):
        log.write_bytes(data[:cut])
        with log.open("r+b") as stream:
            resumed = resume_log(log, stream)
            resumed.writer.metadata("note", {"text": "added"})
            resumed.writer.finish()
        after = read(log)
        assert len(after) == np.searchsorted(before["tick"], resumed.last_tick, side="right")
        for name in ("tick", "position_m", "valve_v"):
            assert np.array_equal(after[name], before[name][: len(after)])
        report = check_log(log)
        assert report.ok, (cut, report.findings)
        require_right_index(log)
    assert len(after) == len(before)


# Other processes die, or signals arrive.


def test_the_recorder_goes_on_without_its_owner_as_long_as_the_loop_does(log):
    with new_ring(log) as ring, recording(ring) as process:
        assert process.stdin is not None
        process.stdin.close()
        for first in range(0, 1500, 100):
            put_with_events(ring, range(first, first + 100))
            time.sleep(0.1)
        assert process.poll() is None
        ring.loop_done = 1
        assert process.wait(PATIENCE_S) == 0
    assert_complete(log, 1500)


def test_the_recorder_finishes_the_log_of_a_loop_that_died_with_its_owner(log):
    with new_ring(log) as ring, recording(ring) as process:
        assert process.stdin is not None
        put_with_events(ring, range(300))
        process.stdin.close()
        assert process.wait(PATIENCE_S) == 0
        assert ring.recorder_flags == RecorderFlag.READY | RecorderFlag.FINISHED
        assert not ring.path.exists()
    assert_complete(log, 300)


def test_the_recorder_ignores_the_signals_that_end_everyone_else(log):
    with new_ring(log) as ring, recording(ring) as process:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGINT):
            process.send_signal(number)
        put_with_events(ring, range(1000))
        time.sleep(0.1)
        ring.loop_done = 1
        assert end(process) == (0, "")
    assert_complete(log, 1000)


def test_the_recorder_beats_while_a_slow_disk_takes_the_last_rows(log, monkeypatch):
    beats: list[int] = []
    write_back = os.fsync

    def write_back_slowly(fd: int) -> None:
        beats.append(ring.recorder_beats)
        time.sleep(0.5)
        beats.append(ring.recorder_beats)
        write_back(fd)

    monkeypatch.setattr(os, "fsync", write_back_slowly)
    with new_ring(log) as ring:
        put_with_events(ring, range(300))
        ring.loop_done = 1
        assert record_run(ring, Here())
    assert beats[1] >= beats[0] + 3
    assert_complete(log, 300)
    assert "recovery" not in read(log).metadata


def test_a_recorder_that_is_behind_loses_nothing_of_a_loop_that_waits_for_it(log):
    with new_ring(log, rows=64) as ring, recording(ring) as process:
        put(ring, range(1500))
        ring.loop_done = 1
        assert end(process) == (0, "")
    assert read(log)["tick"].tolist() == list(range(1500))


# The log cannot be written.


def refused(ring: Ring) -> str:
    process = spawn_recorder(ring.path)
    with pytest.raises(RecorderError) as refusal:
        await_recorder(ring, process)
    assert end(process)[0] == 1
    assert ring.recorder_flags & RecorderFlag.FAILED
    return str(refusal.value)


@pytest.mark.parametrize("has_failed", [True, False])
def test_a_loop_that_waits_gives_a_failed_recorder_up_at_once_and_a_silent_one_soon(
    log, monkeypatch, has_failed
):
    monkeypatch.setattr(journal, "SILENT_RECORDER_S", 0.01)
    looks: list[None] = []

    def has_room() -> bool:
        looks.append(None)
        assert len(looks) < 5000, "it waits for ever"
        return False

    with Ring.create(log.with_suffix(".ring"), meta(log), 256) as ring:
        journal.wait_for_recorder(ring)
        if has_failed:
            ring.raise_flag(RecorderFlag.FAILED)
        assert ring.await_room is not None
        ring.await_room(has_room)
    assert (len(looks) == 1) is has_failed


def test_a_log_is_never_written_over_a_file(log):
    log.write_bytes(b"precious")
    with new_ring(log) as ring:
        put_with_events(ring, range(10))
        assert "run.mcap exists, and a log is never overwritten" in refused(ring)
        finish(ring.path)
    assert log.read_bytes() == b"precious"
    assert_complete(log.with_name("run-recovered.mcap"), 10)


def test_a_directory_that_is_missing_or_none_is_named(log):
    log.write_bytes(b"")
    for path in (log.parent / "missing" / "run.mcap", log / "run.mcap"):
        with Ring.create(log.parent / "pamctl-a.ring", meta(path), 64) as ring:
            assert f"cannot create the log {path}" in refused(ring)
            ring.unlink()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_directory_that_may_not_be_written_is_named(log):
    log.parent.joinpath("closed").mkdir(mode=0o555)
    path = log.parent / "closed" / "run.mcap"
    with Ring.create(log.parent / "pamctl-a.ring", meta(path), 64) as ring:
        assert "Permission denied" in refused(ring)


def test_a_disk_that_fails_is_not_called_full(log, monkeypatch):
    def allocate(fd: int, start: int, size: int) -> None:
        if start:  # after the run began
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(drain, "STEP_BYTES", 0)
    monkeypatch.setattr(drain, "_fallocate", allocate)
    with new_ring(log) as ring:
        put_with_events(ring, range(6000))
        ring.loop_done = 1
        said = record(ring, Here())
        assert said.startswith("writing the log failed: Input/output error; ")
        assert said.endswith(f" rows kept in {ring.path}")
        assert ring.recorder_flags == RecorderFlag.READY | RecorderFlag.FAILED
        assert finish(ring.path) == 0
    assert_complete(log, 6000)


# The disk is full.


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    if os.geteuid() != 0:
        pytest.skip("mounting a small disk needs root")
    mount = tmp_path / "disk"
    mount.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=8m", "none", mount]
    if subprocess.run(command, capture_output=True).returncode != 0:
        pytest.skip("mounting is not permitted here")
    yield mount
    subprocess.run(["umount", mount], check=True)


def put_until_told_to_stop(ring: Ring) -> int:
    """Put ticks like a loop that stops safe on a full disk; return how many."""
    ticks = 0
    while not ring.recorder_flags & RecorderFlag.DISK_FULL:
        put(ring, range(ticks, ticks + 100))
        ticks += 100
        assert ticks < 100_000
    # Stopping takes a while.
    put(ring, range(ticks, ticks + 1000))
    ring.loop_done = 1
    return ticks + 1000


def test_on_a_full_disk_the_log_is_whole_to_the_last_tick_of_the_stop(small_disk, tmp_path):
    log = small_disk / "run.mcap"
    with Ring.create(tmp_path / "pamctl-a.ring", meta(log), 2048) as ring, recording(ring) as rec:
        ticks = put_until_told_to_stop(ring)
        code, said = end(rec)
    assert code == 3
    assert f"the log's disk is full: {log} ends early" in said
    assert read(log)["tick"].tolist() == list(range(ticks))
    assert info(log)["complete"]
    assert log.stat().st_blocks * 512 < log.stat().st_size + (64 << 10), "the reserve is given back"


def test_on_a_disk_without_room_for_the_reserve_no_run_starts(small_disk, tmp_path):
    log = small_disk / "run.mcap"
    (small_disk / "hog").write_bytes(bytes(7 << 20))
    with Ring.create(tmp_path / "pamctl-a.ring", meta(log), 2048) as ring:
        process = spawn_recorder(ring.path)
        with pytest.raises(RecorderError, match=r"no room for a log at .*No space left"):
            await_recorder(ring, process)
        assert end(process)[0] == 3
        assert ring.recorder_flags == RecorderFlag.FAILED | RecorderFlag.DISK_FULL
    assert not log.exists()


def test_at_the_limit_of_a_files_size_the_log_is_whole_too(log):
    with new_ring(log, rows=512) as ring, recording(ring) as process:
        limit = 6 << 20
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (limit, limit))
        ticks = put_until_told_to_stop(ring)
        assert end(process)[0] == 3
    assert read(log)["tick"].tolist() == list(range(ticks))


def test_when_even_the_reserve_is_lost_the_rows_stay_in_the_ring(log):
    with new_ring(log) as ring, recording(ring) as process:
        put_with_events(ring, range(2000))
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (100_000, 100_000))
        put_with_events(ring, range(2000, 5000))
        code, said = end(process)
        assert code == 3
        assert "File too large" in said
        assert f"rows kept in {ring.path}" in said
        assert ring.recorder_flags & RecorderFlag.FAILED
        finish(ring.path)
    assert_complete(log, 5000)


# All processes die at once.


def orphan(directory: Path, name: str, log: Path, ticks: int) -> Path:
    """Leave a ring behind, as a run whose processes were all killed."""
    path = directory / f"pamctl-{name}.ring"
    with Ring.create(path, meta(log), 4096) as ring, recording(ring) as process:
        put_with_events(ring, range(ticks))
        process.kill()
        process.wait()
        ring.loop_beat_ns = LONG_AGO_NS
    return path


def test_the_next_start_finishes_the_logs_of_runs_that_were_killed_as_a_whole(tmp_path):
    for name in "ab":
        orphan(tmp_path, name, tmp_path / f"{name}.mcap", 700)
    found = finish_orphans(tmp_path, quiet=True)
    assert [(o.ring.name, o.problem) for o in found] == [
        ("pamctl-a.ring", ""),
        ("pamctl-b.ring", ""),
    ]
    assert list(tmp_path.glob("*.ring")) == []
    for name in "ab":
        assert_complete(tmp_path / f"{name}.mcap", 700)


def test_a_ring_that_someone_holds_is_left_alone(tmp_path):
    with Ring.create(tmp_path / "pamctl-a.ring", meta(tmp_path / "a.mcap"), 64) as ring:
        ring.loop_beat_ns = LONG_AGO_NS
        assert finish_orphans(tmp_path, quiet=True) == []
        assert ring.path.exists()


def test_a_ring_whose_loop_still_lives_is_left_alone(tmp_path):
    with Ring.create(tmp_path / "pamctl-a.ring", meta(tmp_path / "a.mcap"), 64) as ring:
        pass
    assert finish_orphans(tmp_path, quiet=True) == []
    assert ring.path.exists()


def test_a_ring_that_goes_while_the_others_are_looked_at_is_no_problem(tmp_path, monkeypatch):
    ended = tmp_path / "pamctl-a.ring"  # of a run that ended after the directory was read
    there = orphan(tmp_path, "b", tmp_path / "b.mcap", 300)
    monkeypatch.setattr(Path, "glob", lambda *_: [ended, there])
    (found,) = finish_orphans(tmp_path, quiet=True)
    assert (found.ring, found.problem) == (there, "")


def test_a_bad_ring_is_reported_and_does_not_keep_the_others_from_being_saved(tmp_path):
    (tmp_path / "pamctl-a.ring").write_bytes(b"\0" * 10_000)
    orphan(tmp_path, "c", tmp_path / "c.mcap", 300)
    bad, good = finish_orphans(tmp_path, quiet=True)
    assert "not a ring" in bad.problem
    assert good.problem == ""
    assert_complete(tmp_path / "c.mcap", 300)


def test_a_log_that_cannot_be_finished_stays_where_it_is_with_its_ring(tmp_path):
    (tmp_path / "logs").mkdir()
    path = orphan(tmp_path, "a", tmp_path / "logs" / "a.mcap", 300)
    (tmp_path / "logs").rename(tmp_path / "moved")
    (found,) = finish_orphans(tmp_path, quiet=True)
    assert f"{tmp_path / 'logs'} is gone; create it again" in found.problem
    assert found.problem.endswith(f"or remove the ring to give up the log: rm {path}")
    assert path.exists()
    (tmp_path / "moved").rename(tmp_path / "logs")
    (found,) = finish_orphans(tmp_path, quiet=True)
    assert found.problem == ""
    assert_complete(tmp_path / "logs" / "a.mcap", 300)
