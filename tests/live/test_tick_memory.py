"""The memory of ticks behind the page, and the trigger that searches them."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.made_up import columns, meta, put, tick

from pamctl.live.page_orders import PageRefusal
from pamctl.live.scope import Scope, find_crossing
from pamctl.live.tick_memory import TickMemory, TickShelf
from pamctl.recording.ring import Ring

ROWS = 256
TICK_BYTES = 300


@pytest.fixture
def ring(tmp_path: Path) -> Iterator[Ring]:
    with Ring.create(tmp_path / "pamctl-test.ring", meta(tmp_path / "a.mcap"), ROWS) as ring:
        yield ring


def follow(memory: TickMemory, ring: Ring) -> None:
    ring.commit(ring.head)  # as the recorder does
    memory.follow(str(ring.path), ring.meta.log_path)


def ticks_of(memory: TickMemory) -> list[int]:
    return [int(at) for at in memory.read_columns(["tick"], 0, 1 << 40)["tick"]]


def test_every_tick_is_taken_once_with_all_its_columns_however_often_the_ring_wraps(ring):
    memory = TickMemory()
    for first in range(0, 1000, 100):
        put(ring, range(first, first + 100))
        ring.put_event(first, 0, {"event": "mark", "text": "x" * 900})  # longer than a row
        follow(memory, ring)
    assert ticks_of(memory) == list(range(1000))
    assert [event["tick"] for event in memory.events()] == list(range(0, 1000, 100))
    for name, value in columns(tick(777)).items():
        kept = memory.read_columns([name], 777, 777)[name]
        assert np.array_equal(kept, [value], equal_nan=True), name
    assert memory.state().unseen == 0
    memory.close()


def test_rows_that_were_overwritten_before_they_were_read_are_counted(ring):
    memory = TickMemory()
    put(ring, range(10))
    follow(memory, ring)
    for first in range(10, 410, 100):
        put(ring, range(first, first + 100))
        ring.commit(ring.head)
    follow(memory, ring)
    assert ticks_of(memory) == [*range(10), *range(410 - ROWS // 2, 410)]
    assert memory.state().unseen == 400 - ROWS // 2
    memory.close()


def test_the_oldest_ticks_are_dropped_and_a_run_that_has_ended_is_kept(ring):
    memory = TickMemory(most_bytes=250 * TICK_BYTES)
    for first in range(0, 1000, 100):
        put(ring, range(first, first + 100))
        follow(memory, ring)
    put(ring, range(1000, 1010))
    ring.unlink()
    memory.follow(None, None)  # the run is over: its last rows are taken
    state = memory.state()
    assert state.last_tick == 1009
    assert 700 <= state.first_tick <= 900
    assert not state.is_complete


def test_any_stretch_of_a_shelf_that_went_round_is_what_a_growing_array_gives():
    generator = np.random.default_rng(7)
    row = np.dtype([("tick", "<i8"), ("x", "<f8"), ("on", "?")])
    for _ in range(100):
        room = int(generator.integers(1, 60))
        shelf, everything, last = TickShelf(row, room * row.itemsize), np.empty(0, row), 0
        for count in generator.integers(0, 90, size=5):
            ticks = np.zeros(count, row)
            ticks["tick"] = last + np.cumsum(generator.integers(1, 4, count))  # some are missing
            ticks["x"] = generator.normal(size=count)
            last = max(last, int(ticks["tick"].max(initial=0)))
            everything = np.concatenate([everything, ticks])
            assert shelf.put(ticks) == (len(everything) <= room)
            kept = everything[-room:]
            first, end = sorted(map(int, generator.integers(-5, last + 9, 2)))
            every = int(generator.integers(1, 6))
            wanted = kept[(kept["tick"] >= first) & (kept["tick"] <= end)][::every]
            given = shelf.read_columns(["tick", "x", "on"], first, end, every)
            for name, values in given.items():
                assert np.array_equal(values, wanted[name])


def test_a_ring_that_another_user_holds_is_a_reason_and_no_error(ring, monkeypatch):
    def refuse(*_: object, **__: object) -> int:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("pamctl.recording.ring.os.open", refuse)
    memory = TickMemory()
    memory.follow(str(ring.path), ring.meta.log_path)
    assert "the user of the daemon" in memory.state().problem


def test_a_search_goes_on_where_the_last_one_ended(ring):
    memory = TickMemory()
    scope = Scope(memory)
    put(ring, range(100))
    follow(memory, ring)
    asked = {"log": "a.mcap", "field": "tick", "level": 150.0, "slope": "rising"}
    first = scope.trigger(**asked)
    assert (first["tick"], first["searched"]) == (None, 99)
    put(ring, range(100, 200))
    follow(memory, ring)
    second = scope.trigger(**asked, after=first["searched"], armed=first["armed"])
    assert second["tick"] == 150
    memory.close()


@pytest.mark.parametrize(
    ("path", "query", "status"),
    [
        ("/scope/nothing", {}, 404),
        ("/scope/ticks", {}, 400),
        ("/scope/ticks", {"log": "a.mcap", "first": "0", "last": "9", "fields": "nope"}, 400),
        ("/scope/ticks", {"log": "a.mcap", "first": "0", "last": "9" * 400, "fields": "tick"}, 400),
        ("/scope/ticks", {"log": "../a.mcap", "first": "0", "last": "9", "fields": "tick"}, 404),
        ("/scope/ticks", {"log": "b.mcap", "first": "0", "last": "9", "fields": "tick"}, 404),
        ("/scope/cut", {"log": "a.mcap", "first": "0", "last": "9"}, 409),
        ("/scope/cut", {"log": "/etc/passwd", "first": "0", "last": "9"}, 404),
        ("/scope/trigger", {"log": "a.mcap", "field": "tick", "level": "inf", "slope": "up"}, 400),
    ],
)
def test_a_question_that_cannot_be_answered_is_refused(ring, tmp_path, path, query, status):
    memory = TickMemory()
    scope = Scope(memory)
    scope.folder = tmp_path
    (tmp_path / "a.mcap").touch()  # the recorder has begun it
    put(ring, range(10))
    follow(memory, ring)
    with pytest.raises(PageRefusal) as refusal:
        scope.answer(path, query)
    assert refusal.value.status == status
    memory.close()


@pytest.mark.parametrize("slope", ["rising", "falling", "either"])
def test_a_search_in_pieces_finds_what_a_walk_over_the_samples_finds(slope):
    generator = np.random.default_rng(7)
    for _ in range(200):
        values = np.cumsum(generator.normal(size=60))
        values[generator.random(60) < 0.1] = np.nan
        level, hysteresis = generator.normal(), abs(generator.normal()) * 0.5
        wanted = walk(values, level, slope, hysteresis)
        armed, found, start = None, None, 0
        for piece in np.array_split(values, generator.integers(1, 8)):
            crossing = find_crossing(piece, level, slope, hysteresis, armed)
            armed = crossing.armed
            if crossing.at is not None:
                found = start + crossing.at
                break
            start += len(piece)
        assert found == wanted


def walk(values: np.ndarray, level: float, slope: str, hysteresis: float) -> int | None:
    was_below = was_above = False
    for index, value in enumerate(values):
        if was_below and value >= level and slope != "falling":
            return index
        if was_above and value <= level and slope != "rising":
            return index
        was_below = was_below or value < level - hysteresis
        was_above = was_above or value > level + hysteresis
    return None
