"""The list of what can be wrong with a record: each fault is planted, and found where it is."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pamctl.log.record_problems import find_frozen, find_record_problems, find_sensor_step
from pamctl.log.row_problems import RecordColumn, RecordProblem, find_gaps

T_S = np.arange(6000) * 1e-3
Change = Callable[[Any], Any]


def make_columns(seed: int = 1, encoder_m: float = 3e-6, **changes: Change) -> list[RecordColumn]:
    """Return a command, a noisy pressure, and a position in steps of an encoder, with a rest."""
    chance = np.random.default_rng(seed)
    motion = np.where(T_S < 1.0, 0.0, 1.0 - np.cos(3.0 * (T_S - 1.0)))
    columns = {
        "valve_v": np.where((T_S > 1.0) & (np.sin(3.0 * (T_S - 1.0)) > 0.0), 1.5, -1.5),
        "pressure_pa": 1e5 + 1e5 * motion + 300.0 * chance.standard_normal(len(T_S)),
        "position_m": np.rint(0.01 * motion / encoder_m) * encoder_m,
    }
    for name, change in changes.items():
        columns[name] = change(columns[name].copy())
    units = {"valve_v": "V", "pressure_pa": "Pa", "position_m": "m"}
    return [
        RecordColumn(name, units[name], values, is_sensor=name != "valve_v")
        for name, values in columns.items()
    ]


def find(t_s: Any = T_S, **changes: Change) -> list[RecordProblem]:
    return find_record_problems(t_s, make_columns(**changes))


def put(start: int, stop: int, value: float | None = None) -> Change:
    """Return a change that puts a value, or the first of the stretch, into all its rows."""

    def change(values: Any) -> Any:
        values[start:stop] = values[start] if value is None else value
        return values

    return change


def freeze_twice(values: Any) -> Any:
    """Freeze a short stretch, and most of the record: its noise is that of the rest."""
    return put(1100, 5500)(put(500, 530)(values))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000), st.sampled_from([1e-7, 3e-6, 5e-5]), st.floats(1e-5, 1.0))
def test_a_sound_record_has_no_problem(seed, encoder_m, period_s):
    assert find_record_problems(T_S / 1e-3 * period_s, make_columns(seed, encoder_m)) == []


@pytest.mark.parametrize(
    ("name", "change", "kind", "stretches"),
    [
        ("pressure_pa", put(3000, 6000 - 1000), "frozen", ((3000, 5000),)),
        ("pressure_pa", put(2500, 2530), "frozen", ((2500, 2530),)),
        ("pressure_pa", freeze_twice, "frozen", ((500, 530), (1100, 5500))),
        ("position_m", put(2500, 3500), "frozen", ((2500, 3500),)),
        ("pressure_pa", put(10, 20, np.nan), "missing", ((10, 20),)),
        ("valve_v", put(10, 20, np.nan), "missing", ((10, 20),)),
        ("pressure_pa", put(10, 11, -np.inf), "infinite", ((10, 11),)),
        ("position_m", put(0, 6000, np.nan), "empty", ((0, 6000),)),
        ("pressure_pa", put(0, 6000), "constant", ((0, 6000),)),
        ("pressure_pa", put(3000, 3001, 0.0), "spikes", ((3000, 3001),)),
        ("pressure_pa", put(3000, 3006, 0.0), "spikes", ((3000, 3006),)),
        ("position_m", put(2500, 2502, 0.05), "spikes", ((2500, 2502),)),
    ],
)
def test_a_fault_of_a_column_is_found_in_its_rows_and_seconds(name, change, kind, stretches):
    (problem,) = find(**{name: change})
    assert (problem.kind, problem.column, problem.stretches) == (kind, name, stretches)
    assert (problem.from_s, problem.to_s) == (T_S[stretches[0][0]], T_S[stretches[-1][1] - 1])
    assert problem.share == pytest.approx(sum(b - a for a, b in stretches) / len(T_S))
    assert problem.is_fatal == (kind == "empty")


def test_a_sensor_whose_noise_is_cut_at_its_lowest_is_clipped_with_what_comes_through_between():
    def cut(values: Any) -> Any:
        return np.maximum(values, 1e5 + 500.0)

    (problem,) = find(pressure_pa=cut)
    assert (problem.kind, problem.column) == ("clipped", "pressure_pa")
    assert problem.share > 0.1


def test_a_position_that_is_cut_in_one_motion_is_clipped_in_all_that_end_there():
    def cut(values: Any) -> Any:
        return np.minimum(values, 0.012)

    (problem,) = find(position_m=cut)
    assert problem.kind == "clipped"
    assert problem.share == pytest.approx(np.mean(cut(make_columns()[2].values) == 0.012), abs=0.01)


def test_a_pressure_beyond_the_range_of_its_sensor_is_clipped():
    (problem,) = find(pressure_pa=lambda values: np.minimum(values, 2.7e5))
    assert problem.kind == "clipped"
    assert "270000 Pa" in problem.text
    inside = np.concatenate([np.arange(*stretch) for stretch in problem.stretches])
    assert (make_columns()[1].values[inside] >= 2.7e5).mean() > 0.98


def make_axis(seed: int, step_m: float = 1e-6) -> list[RecordColumn]:
    """Return the force and the encoder of a mass whose dry friction holds it again and again."""
    chance = np.random.default_rng(seed)
    force_n = 30.0 * np.sin(6.0 * T_S) * np.sin(0.9 * T_S + 1.0) + chance.normal(0.0, 0.5, 6000)
    x, v, places_m = 0.0, 0.0, np.zeros(len(T_S))
    for k, push_n in enumerate(force_n):
        rests = abs(v) < 1e-4 and abs(push_n) < 14.0
        speed = 0.0 if rests else v + 1e-3 / 6.0 * (push_n - 18.0 * v - 14.0 * np.sign(v or push_n))
        v = 0.0 if rests or v * speed < 0.0 else speed
        x += 1e-3 * v
        places_m[k] = np.rint(x / step_m) * step_m
    return [RecordColumn("position_m", "m", places_m), RecordColumn("force_n", "N", force_n)]


@pytest.mark.parametrize("seed", range(4))
def test_a_position_that_friction_holds_is_neither_frozen_nor_clipped(seed):
    columns = make_axis(seed)
    equal = np.diff(columns[0].values) == 0.0
    assert sum(equal[k : k + 60].all() for k in range(len(equal) - 60)) > 100
    assert find_record_problems(T_S, columns) == []


@pytest.mark.parametrize("seed", range(6))
def test_noise_of_half_a_step_may_hide_for_long_at_rest_in_the_middle_of_a_step(seed):
    chance, step_m = np.random.default_rng(seed), 1e-5
    at = np.arange(12_000) % 3000
    motion_m = np.where(at < 900, 0.0, 0.02 * np.sin(np.pi * (at - 900) / 2100) ** 2)
    values = np.rint((motion_m + chance.normal(0.0, 5e-6, len(at))) / step_m) * step_m
    position = RecordColumn("position_m", "m", values)
    assert find_record_problems(1e-3 * np.arange(len(at)), [position]) == []


@pytest.mark.parametrize("start", [1500, 3300, 4200])
def test_an_encoder_that_sticks_and_jumps_is_frozen_beside_rests_by_friction(start):
    position, force = make_axis(1)
    position.values[start : start + 400] = position.values[start]
    (problem,) = find_record_problems(T_S, [position, force])
    assert (problem.kind, problem.column) == ("frozen", "position_m")
    assert problem.stretches[-1][1] == start + 400
    assert find_frozen(T_S, position.values)[start + 1 : start + 400].all()


@pytest.mark.parametrize("every", [2, 5, 10])
def test_a_column_of_fewer_samples_than_rows_is_told_with_its_own_rate(every):
    def hold(values: Any) -> Any:
        return np.repeat(values[::every], every)

    def interpolate(values: Any) -> Any:
        return np.interp(T_S, T_S[::every], values[::every])

    for how, change in (("held", hold), ("interpolated", interpolate)):
        (problem,) = find(pressure_pa=change)
        assert problem.kind == "resampled"
        assert f"at {1000 / every:.3g} Hz and {how}" in problem.text


@pytest.mark.parametrize(
    ("t_s", "kind", "first", "told"),
    [
        (T_S[::-1], "reversed", 0, "turn the order of the rows round"),
        (np.r_[T_S[:3000], T_S[:3000]], "duplicated", 3000, "the record is there twice"),
        (np.repeat(T_S[:3000], 2), "duplicated", 1, "repeats the previous row's"),
        (np.where(T_S < 2.0, T_S, T_S - 0.5), "backwards", 2000, "by up to 0.499 s"),
        (np.where(np.arange(6000) == 7, np.nan, T_S), "missing", 7, "missing or not finite"),
    ],
)
def test_a_time_that_is_no_order_is_fatal_and_no_sensor_is_judged_by_it(t_s, kind, first, told):
    (problem,) = find(t_s)
    assert (problem.kind, problem.column, problem.is_fatal) == (kind, "t_s", True)
    assert problem.stretches[0][0] == first
    assert told in problem.text


def test_a_pause_and_scattered_stamps_are_told_and_not_fatal():
    (gap,) = find(np.where(T_S < 2.0, T_S, T_S + 600.0))
    assert (gap.kind, gap.stretches, gap.is_fatal) == ("gap", ((2000, 2001),), False)
    assert "600.001 s" in gap.text
    scattered = T_S + np.random.default_rng(1).uniform(0.0, 3e-4, len(T_S))
    assert [problem.kind for problem in find(scattered)] == ["jitter"]
    jitter_s = 3.5e-4 * np.random.default_rng(2).uniform(-1.0, 1.0, len(T_S))
    assert not find_gaps(T_S + jitter_s).any()
    assert np.flatnonzero(find_gaps(np.where(T_S < 2.0, T_S, T_S + 1e-3) + jitter_s)) == [1999]


@pytest.mark.parametrize("rows", [0, 1])
def test_a_record_without_two_rows_is_none(rows):
    columns = [column._replace(values=column.values[:rows]) for column in make_columns()]
    (problem,) = find_record_problems(T_S[:rows], columns)
    assert (problem.kind, problem.column, problem.is_fatal) == ("short", "t_s", True)


def test_a_channel_that_was_stored_twice_is_told():
    columns = make_columns()
    columns[2] = columns[1]._replace(name="position_m")
    (problem,) = find_record_problems(T_S, columns)
    assert (problem.kind, problem.column) == ("duplicated", "position_m")


@given(st.integers(1, 50), st.floats(1e-9, 1e3), st.floats(-10.0, 10.0))
def test_the_step_of_a_converter_is_found(spread, step, offset):
    levels = np.random.default_rng(spread).integers(-spread, spread + 1, 500)
    values = levels * step + offset * step
    assert find_sensor_step(values) == pytest.approx(step, rel=1e-4)


@pytest.mark.parametrize(("start", "stop"), [(0, 100), (1000, 1100), (1900, 2000)])
def test_a_frozen_stretch_is_found_wherever_it_lies(start, stop):
    chance, t_s = np.random.default_rng(6), np.arange(2000) * 1e-3
    values = np.cumsum(chance.normal(size=2000)) + chance.normal(size=2000)
    assert not find_frozen(t_s, values).any()
    values[start:stop] = values[start]
    assert np.flatnonzero(find_frozen(t_s, values)).tolist() == list(range(start, stop))
