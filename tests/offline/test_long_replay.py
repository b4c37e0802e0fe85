"""A log whose ticks stay in the file is the same log, and replays with the same result."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pamctl.log import Log, LogError, read
from pamctl.log import columns as log_columns
from pamctl.log.columns import GridRows, Pages
from pamctl.log.reader import read_paged
from pamctl.log.recover import recover_file
from pamctl.offline import replay_source
from pamctl.offline.replay_source import read_replay_source
from pamctl.offline.tick_replay import OTHER_CPU, Replay, replay_log
from pamctl.offline.what_if import replace_law, run_what_if

GOLDEN = Path(__file__).parents[1] / "golden"


@pytest.fixture(autouse=True)
def small_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a log of seconds have many pages and many stretches."""
    monkeypatch.setattr(log_columns, "PAGE_TICKS", 300)
    monkeypatch.setattr(replay_source, "LONGEST_STRETCH", 700)
    monkeypatch.setattr(log_columns, "_KEPT_PAGES", 2)


def open_paged(path: Path) -> Log:
    log = read_paged(path)
    assert isinstance(log.columns, Pages)
    return log


def result_of(found: Replay) -> tuple[object, ...]:
    """Return all of a result but how long it took."""
    return found.begin, found.ticks, found.skipped, found.unasked, found.fields, found.differences


@pytest.mark.parametrize("name", ["qsmc", "missed", "trip-wire"])
def test_a_replay_in_pieces_has_the_same_result(name):
    whole, paged = read(GOLDEN / f"{name}.mcap"), open_paged(GOLDEN / f"{name}.mcap")
    for from_s in (None, 0.6 * float(whole.t[-1])) if whole.keyframes else (None,):
        here = replay_log(whole, from_s=from_s, tolerances=OTHER_CPU)
        there = replay_log(paged, from_s=from_s, tolerances=OTHER_CPU)
        assert result_of(here) == result_of(there)
        assert there.is_equal


def test_a_difference_is_found_in_the_same_tick():
    whole, paged = read(GOLDEN / "qsmc.mcap"), open_paged(GOLDEN / "qsmc.mcap")
    config = {**whole.config, "controller": {**whole.config["controller"], "eta": 0.5}}
    here = replay_log(replace(whole, config=config))
    there = replay_log(replace(paged, config=config))
    assert here.differences
    assert result_of(here) == result_of(there)


def test_a_loss_is_found_in_pieces_too(tmp_path):
    broken, saved = tmp_path / "broken.mcap", tmp_path / "saved.mcap"
    data = bytearray((GOLDEN / "qsmc.mcap").read_bytes())
    data[len(data) // 2 : len(data) // 2 + 3000] = bytes(3000)
    broken.write_bytes(data)
    recover_file(broken, saved)
    here, there = replay_log(read(saved)), replay_log(open_paged(saved))
    assert here.skipped > 0
    assert result_of(here)[:4] == result_of(there)[:4]


def test_a_what_if_in_pieces_has_the_same_commands():
    whole, paged = read(GOLDEN / "qsmc.mcap"), open_paged(GOLDEN / "qsmc.mcap")
    settings = replace_law(read_replay_source(whole).settings, None, ["controller.eta=0"])
    here, there = run_what_if(whole, settings), run_what_if(paged, settings)
    np.testing.assert_array_equal(here.ticks, there.ticks)
    np.testing.assert_array_equal(here.other_v, there.other_v)
    assert here.phases == there.phases


def test_a_file_that_changes_under_the_log_is_refused(tmp_path):
    copy = tmp_path / "copy.mcap"
    copy.write_bytes((GOLDEN / "qsmc.mcap").read_bytes())
    log = open_paged(copy)
    with copy.open("r+b") as file:
        file.seek(copy.stat().st_size // 2)
        file.write(bytes(4000))
    with pytest.raises(LogError, match="was changed while it was read"):
        np.asarray(log["position_m"])


@given(
    st.lists(st.tuples(st.integers(1, 4), st.integers(0, 3)), min_size=1, max_size=40),
    st.integers(1, 7),
    st.integers(0, 5),
)
def test_the_grid_finds_every_tick(steps, piece, begin):
    tick = begin + np.cumsum([step for step, _ in steps])
    missed = np.array([missed for _, missed in steps])
    grid = GridRows()
    for at in range(0, len(tick), piece):
        grid.take(*(column[at : at + piece] for column in (tick, missed, 1e-3 * tick)))
    assert grid.is_rising
    assert grid.count == len(tick)
    assert grid.losses == set((np.flatnonzero(np.diff(tick) - 1 != missed[1:]) + 1).tolist())
    for wanted in range(begin - 1, int(tick[-1]) + 3):
        row = int(np.searchsorted(tick, wanted))
        assert grid.find_from(wanted) == row
        assert grid.find(wanted) == (row if wanted in tick else None)
