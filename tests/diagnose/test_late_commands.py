"""Commands that were read back late: the rows that repeat say how late."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden.excitations import brief
from hidden.rig import hidden_rig
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.setup.late_commands import find_delay_s
from pamctl.diagnose.setup.suspects import find_shown_rows, put_back_commands

from pamctl.diagnose import Record, diagnose
from pamctl.diagnose.measured.record import Array
from pamctl.plant.model import PlantSettings

ROWS = 3000


def _jittered_ticks(random: np.random.Generator, jitter_s: float = 20e-6) -> Array:
    return np.arange(ROWS, dtype=np.float64) * 1e-3 + random.exponential(jitter_s, ROWS)


def _read_back(t_s: Array, given_v: Array, late_s: float) -> Array:
    """Return what a log shows that asks the valve for its command of `late_s` ago."""
    now = np.array([np.flatnonzero(t_s <= t - late_s + 1e-9)[-1:].sum() for t in t_s], dtype=int)
    return np.asarray(given_v[now])


@pytest.mark.parametrize("late_s", [1e-3, 3.004e-3, -2e-3])
def test_the_rows_that_repeat_tell_the_delay(late_s: float) -> None:
    random = np.random.default_rng(5)
    t_s = _jittered_ticks(random)
    given_v = np.asarray(np.cumsum(random.normal(size=ROWS)), dtype=np.float64)
    shown_v = _read_back(t_s, given_v, late_s)
    assert find_delay_s([(t_s, shown_v)]) == pytest.approx(late_s, abs=3e-6)
    restored = put_back_commands(shown_v, t_s, late_s)
    was_shown = np.unique(find_shown_rows(t_s, late_s))
    assert len(was_shown) < 0.9 * ROWS
    assert np.array_equal(restored[was_shown], given_v[was_shown])
    assert np.sum((restored - given_v) ** 2) < 0.7 * np.sum((shown_v - given_v) ** 2)


def test_nothing_is_said_where_the_times_do_not_tell_why_rows_repeat() -> None:
    random = np.random.default_rng(6)
    t_s = _jittered_ticks(random)
    given_v = np.asarray(np.cumsum(random.normal(size=ROWS)), dtype=np.float64)
    assert find_delay_s([(t_s, given_v)]) is None  # nothing repeats
    assert find_delay_s([(t_s, given_v[np.arange(ROWS) // 2 * 2])]) is None  # every second does
    other = np.maximum(np.arange(ROWS) - random.integers(0, 2, ROWS), 0)
    assert find_delay_s([(t_s, given_v[other])]) is None  # at random
    regular_s = np.arange(ROWS) * 1e-3
    assert find_delay_s([(regular_s, _read_back(t_s, given_v, 1e-3))]) is None
    square_v = np.where(t_s % 1.0 < 0.5, 5.0, -5.0)
    assert find_delay_s([(t_s, _read_back(t_s, square_v, 1e-3))]) is None


def test_records_with_lost_commands_are_refused_with_the_delay() -> None:
    rig = hidden_rig({}, seed=8)

    def log_late(run: Record) -> Record:
        return replace(run, valve_v=_read_back(run.t_s, run["valve_v"], 1e-3))

    train, holdout = (
        [
            log_late(Record(f"{e.name}-{i}{k}", **rig.run(e).record.columns()))
            for i, e in enumerate(p)
        ]
        for k, p in enumerate(brief(3))
    )
    found = diagnose(train, holdout, PlantSettings())
    (finding,) = found.setup
    assert found.verdict is Verdict.BAD_DATA
    assert (finding.kind, finding.number) == ("skew", "valve_v")
    assert finding.value == pytest.approx(1e-3, abs=3e-6)
    assert "some commands stand in two rows, and others in none" in found.reason
