"""The ring: rows come out as they were put, complete, once, and after any death."""

import json
import math
import os
import random
import signal
import stat
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.made_up import START_MONO_NS, columns, meta, put, tick
from support.runs import pack_row

from pamctl.recording.ring import RecorderFlag, Ring, RingError, RingFull
from pamctl.recording.rows import PAYLOAD_BYTES, RowKind, tick_struct
from pamctl.signals import TICK_FIELDS

ROWS = 64


@pytest.fixture
def ring(tmp_path: Path) -> Iterator[Ring]:
    with Ring.create(tmp_path / "pamctl-test.ring", meta(tmp_path / "a.mcap"), ROWS) as ring:
        yield ring


def taken_ticks(ring: Ring) -> list[int]:
    batch = ring.drain(ROWS)
    ring.commit(batch.end_row)
    return [entry.tick for entry in batch.entries() if entry.kind == RowKind.TICK]


def test_a_tick_comes_out_of_the_ring_as_it_went_in(ring):
    ring.put_row(pack_row(tick(3)))
    (entry,) = ring.drain(ROWS).entries()
    unpacked = tick_struct(TICK_FIELDS).unpack(entry.payload)
    assert entry.kind == RowKind.TICK
    assert entry.tick == 3
    assert entry.t_ns == START_MONO_NS + 3_000_000
    assert list(unpacked) == list(columns(tick(3)).values())


def test_rows_are_taken_once_and_in_order_however_often_the_ring_wraps(ring):
    taken = []
    for first in range(0, 1000, 40):
        put(ring, range(first, first + 40))
        taken += taken_ticks(ring)
    assert taken == list(range(1000))


def test_rows_that_are_not_committed_are_drained_again(ring):
    put(ring, range(10))
    assert ring.drain(4) == ring.drain(4)
    ring.commit(4)
    assert [entry.tick for entry in ring.drain(3).entries()] == [4, 5, 6]


def test_a_full_ring_says_so_and_keeps_every_row_it_has(ring):
    put(ring, range(ROWS))
    with pytest.raises(RingFull, match="behind or gone"):
        ring.put_row(pack_row(tick(ROWS)))
    assert taken_ticks(ring) == list(range(ROWS))
    ring.put_row(pack_row(tick(ROWS)))
    assert taken_ticks(ring) == [ROWS]


@pytest.mark.parametrize("size", [0, 1, PAYLOAD_BYTES - 20, PAYLOAD_BYTES, 5000, 10_000])
@pytest.mark.parametrize("before", [0, ROWS - 1, ROWS - 5])
def test_an_event_of_any_length_comes_out_whole_even_across_the_wrap(ring, size, before):
    put(ring, range(before))
    ring.commit(before)
    ring.put_event(7, 8, {"event": "x" * size})
    ring.put_row(pack_row(tick(9)))
    (event,) = ring.drain(1).entries()
    assert (event.kind, event.tick, event.t_ns, event.row) == (RowKind.EVENT, 7, 8, before)
    assert json.loads(event.payload) == {"event": "x" * size}
    assert [entry.kind for entry in ring.drain(ROWS).entries()] == [RowKind.EVENT, RowKind.TICK]


def test_an_event_longer_than_half_the_ring_is_refused_and_leaves_no_trace(ring):
    with pytest.raises(RingError, match="exceed half the ring"):
        ring.put_event(0, 0, {"event": "x" * ROWS * PAYLOAD_BYTES})
    assert ring.pending == 0


def test_an_event_with_numbers_that_json_does_not_have_is_valid_json(ring):
    ring.put_event(0, 0, {"event": "trip", "values": [math.nan, math.inf, -math.inf, 1.5]})
    (event,) = ring.drain(1).entries()
    assert json.loads(event.payload)["values"] == ["nan", "inf", "-inf", 1.5]


def test_a_ring_is_made_once_and_for_this_user_only(ring):
    with pytest.raises(RingError, match="it exists"):
        Ring.create(ring.path, ring.meta)
    assert stat.S_IMODE(ring.path.stat().st_mode) == 0o600


def test_a_ring_that_cannot_be_made_leaves_nothing_behind(tmp_path):
    with pytest.raises(RingError, match="cannot make the ring"):
        Ring.create(tmp_path / "missing" / "a.ring", meta(tmp_path / "a.mcap"))
    with pytest.raises(RingError, match="cannot make the ring"):
        Ring.create(tmp_path / "a.ring", meta(tmp_path / "a.mcap"), rows=1 << 50)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", [b"", b"x" * 10, b"x" * 9000])
def test_a_file_that_is_no_ring_is_refused(tmp_path, content):
    (tmp_path / "a.ring").write_bytes(content)
    with pytest.raises(RingError):
        Ring.attach(tmp_path / "a.ring")


def test_a_ring_of_another_layout_is_refused_with_what_to_do(ring):
    with ring.path.open("r+b") as file:
        os.pwrite(file.fileno(), b"\x63", 8)
    with pytest.raises(RingError, match=r"layout 99.*version that made it"):
        Ring.attach(ring.path)


def test_another_process_sees_the_same_meta_rows_and_words(ring):
    ring.worst_late_ns = 123
    put(ring, range(5))
    with Ring.attach(ring.path) as other:
        assert other.meta == ring.meta
        assert other.worst_late_ns == 123
        assert taken_ticks(other) == list(range(5))
        other.raise_flag(RecorderFlag.READY)
        other.raise_flag(RecorderFlag.DISK_FULL)
    assert ring.recorder_flags == RecorderFlag.READY | RecorderFlag.DISK_FULL
    assert ring.pending == 0


def test_the_latest_tick_is_seen_without_being_taken(ring):
    assert ring.latest_tick() is None
    put(ring, range(5))
    ring.put_event(5, 0, {"event": "x" * 2000})
    assert ring.latest_tick() == columns(tick(4))
    taken_ticks(ring)
    assert ring.latest_tick() == columns(tick(4))


def test_the_latest_tick_is_never_torn_while_the_loop_writes(ring):
    done = threading.Event()

    def consume() -> None:
        while not done.is_set():
            taken_ticks(ring)

    with Ring.attach(ring.path) as front:
        producer = threading.Thread(target=put, args=(ring, range(2000)))
        consumer = threading.Thread(target=consume)
        producer.start()
        consumer.start()
        while producer.is_alive():
            seen = front.latest_tick()
            assert seen is None or seen == columns(tick(int(seen["tick"])))
        done.set()
        producer.join()
        consumer.join()


PRODUCER = """
import sys
sys.path[:0] = sys.argv[2:]
from support.made_up import put
from pamctl.recording.ring import Ring
with Ring.attach(sys.argv[1]) as ring:
    ring.hold()
    print("ready", flush=True)
    put(ring, range(1_000_000), patience_s=60)
"""


def test_a_loop_killed_at_any_moment_leaves_only_whole_rows(ring):
    tests = Path(__file__).parents[1]
    process = subprocess.Popen(
        [sys.executable, "-c", PRODUCER, ring.path, tests, tests.parent], stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    process.stdout.readline()
    taken, after = [], random.randrange(200, 2000)
    while len(taken) < after:
        taken += taken_ticks(ring)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    for entry in ring.drain(ROWS).entries():
        assert tick_struct(TICK_FIELDS).unpack(entry.payload) == tuple(
            columns(tick(entry.tick)).values()
        )
    taken += taken_ticks(ring)
    assert taken == list(range(len(taken)))


def is_orphan(path):
    with Ring.attach(path) as ring:
        return ring.claim()


def test_a_ring_is_an_orphan_only_after_all_who_held_it_are_gone(tmp_path):
    path = tmp_path / "a.ring"
    creator = Ring.create(path, meta(tmp_path / "a.mcap"), ROWS)
    assert not is_orphan(path)
    with Ring.attach(path) as recorder:
        recorder.hold()
        creator.close()
        assert not is_orphan(path)
    assert is_orphan(path)


def test_the_ring_does_not_bring_slow_imports_into_the_loop():
    code = "import sys, pamctl.recording.ring; print(*sys.modules)"
    loaded = subprocess.check_output([sys.executable, "-c", code], text=True).split()
    assert not {"numpy", "mcap", "google", "zstandard"} & set(loaded)
