"""Rows are visible before the head that counts them, on every machine on which a ring is made."""

import platform
import sys
import threading

import pytest
from support.made_up import columns, meta, put, tick

from pamctl.recording import ring
from pamctl.recording.ring import MemoryOrderError, Ring, RingError, choose_barrier

ROWS = 64
linux_only = pytest.mark.skipif(sys.platform != "linux", reason="only Linux has membarrier")


@linux_only
def test_only_x86_goes_without_a_barrier():
    in_order = choose_barrier("x86_64")
    assert in_order is choose_barrier("AMD64") is choose_barrier("i686")
    if platform.machine() == "x86_64":
        # The number of x86 stands in for the other machine's: this kernel knows no other.
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(ring._MEMBARRIER, "aarch64", ring._MEMBARRIER["x86_64"])
            assert choose_barrier("aarch64") is not in_order


def test_a_machine_without_a_known_barrier_is_refused_by_name(tmp_path, monkeypatch):
    monkeypatch.setattr(platform, "machine", lambda: "alpha")
    with pytest.raises(RingError, match="no barrier between processes is known for alpha"):
        Ring.create(tmp_path / "a.ring", meta(tmp_path / "a.mcap"), ROWS)
    assert not list(tmp_path.glob("*.ring"))


def test_a_big_endian_machine_is_refused():
    with pytest.raises(MemoryOrderError, match="little-endian"):
        choose_barrier("s390x", "big")


@linux_only
def test_a_kernel_that_refuses_the_barrier_is_said_so(monkeypatch):
    monkeypatch.setitem(ring._MEMBARRIER, "aarch64", 100_000)  # no such system call
    with pytest.raises(MemoryOrderError, match="aarch64 reorders stores, and membarrier failed: "):
        choose_barrier("aarch64")


@pytest.fixture
def barriers(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """This machine as one that reorders: the kernel's real barrier, by this machine's number."""
    own = ring._MEMBARRIER.get(platform.machine())
    if sys.platform != "linux" or own is None:
        pytest.skip("needs membarrier")
    monkeypatch.setitem(ring._MEMBARRIER, "weakly-ordered", own)
    barrier = choose_barrier("weakly-ordered")
    called: list[str] = []

    def count() -> None:
        barrier()
        called.append("barrier")

    monkeypatch.setattr(ring, "barrier_of_this_machine", lambda: count)
    return called


def test_readers_call_the_barrier_and_the_loop_never_does(tmp_path, barriers):
    with Ring.create(tmp_path / "a.ring", meta(tmp_path / "a.mcap"), ROWS) as loop:
        put(loop, range(40))
        assert not barriers, "a system call in every tick"
        with Ring.attach(loop.path) as reader:
            batch = reader.drain(ROWS)
            assert len(barriers) == 2, "before the head, and between head and rows"
            reader.commit(batch.end_row)
            assert len(barriers) == 3, "between the copy and the tail"
            assert reader.latest_tick() == columns(tick(39))
            assert len(barriers) == 5, "around the copy"


def test_a_ring_with_barriers_gives_every_row_once(tmp_path, barriers):
    with Ring.create(tmp_path / "a.ring", meta(tmp_path / "a.mcap"), ROWS) as loop:
        producer = threading.Thread(target=put, args=(loop, range(2000)))
        with Ring.attach(loop.path) as reader:
            producer.start()
            taken: list[int] = []
            while len(taken) < 2000:
                batch = reader.drain(ROWS)
                taken += [entry.tick for entry in batch.entries()]
                reader.commit(batch.end_row)
            producer.join()
    assert taken == list(range(2000))
    assert barriers
