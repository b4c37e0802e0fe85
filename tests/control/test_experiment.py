"""Experiments: the references of the shipped files, the motions and waves that they are made of."""

import math
from itertools import groupby

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial
from pydantic import ValidationError
from support.runs import run_settings

from pamctl.control.course import Course, Segment
from pamctl.control.experiment import (
    ProgramSettings,
    SquareSettings,
    Step,
    StepsSettings,
    TrackingSettings,
    plan_experiment,
)
from pamctl.control.waves import Motion, rest_to_rest
from pamctl.settings.config_files import config_dir
from pamctl.signals import Phase, Reference


def shipped(name: str) -> tuple[Segment, ...]:
    return plan_experiment(run_settings(experiment=name).experiment).segments


def outline(course: tuple[Segment, ...]) -> list[tuple[Phase, float, float, float]]:
    return [
        (Phase(s.phase), s.duration_s, round(s.start_m * 1e3, 9), round(s.end_m * 1e3, 9))
        for s in course
    ]


APPROACH = [(Phase.APPROACH, 5.0, 0.0, 6.4), (Phase.APPROACH, 2.0, 6.4, 6.4)]
UP, DOWN = (Phase.TRACK, 5.0, 6.4, 17.2), (Phase.TRACK, 5.0, 17.2, 6.4)


def test_experiment_1_rests_ten_seconds_at_6_4_and_at_17_2_mm():
    low, high = (Phase.REST, 10.0, 6.4, 6.4), (Phase.REST, 10.0, 17.2, 17.2)
    assert outline(shipped("tracking-1")) == APPROACH + [low, UP, high, DOWN] * 2


@pytest.mark.parametrize(("name", "half_s"), [("0.25", 2.0), ("2", 0.25)])
def test_a_square_wave_fills_first_then_exhausts_for_equally_long(name, half_s):
    wave = shipped(f"square-{name}")
    assert len(wave) % 2 == 0
    assert {s.phase for s in wave} == {Phase.OPEN_LOOP}
    assert [s.duration_s for s in wave] == [half_s] * len(wave)
    assert [s.valve_v for s in wave] == [5.0, -5.0] * (len(wave) // 2)


def test_steps_are_held_in_order_and_repeated():
    steps = (Step(valve_v=1.0, hold_s=0.5), Step(valve_v=-2.0, hold_s=0.25))
    course = plan_experiment(StepsSettings(kind="steps", steps=steps, repeat=2)).segments
    assert [(s.valve_v, s.duration_s) for s in course] == [(1.0, 0.5), (-2.0, 0.25)] * 2


def test_a_set_point_below_the_vented_muscle_is_refused():
    with pytest.raises(ValidationError, match=r"amplitude_mm 6 exceeds offset_mm 5"):
        TrackingSettings(kind="tracking", offset_mm=5.0, amplitude_mm=6.0)
    lowest = plan_experiment(
        TrackingSettings(kind="tracking", offset_mm=5.0, amplitude_mm=5.0)
    ).segments
    assert min(s.start_m for s in lowest) == 0.0


def walked(course: Course, period_s: float = 1e-3, last_tick: int = 10**6) -> list[Reference]:
    asked = []
    for tick in range(last_tick):
        reference = course.at(tick * period_s)
        if reference is None:
            break
        asked.append(reference)
    return asked


def test_a_shortened_course_ends_at_its_new_end():
    course = Course(shipped("tracking-2"), duration_s=1.5)
    assert course.duration_s == 1.5
    assert len(walked(course)) == 1500
    whole_s = sum(segment.duration_s for segment in shipped("tracking-2"))
    said = f"the duration of 1.5 s ended the experiment of {whole_s:g} s"
    assert course.end_reason == said
    assert Course(shipped("tracking-2"), 1e4).end_reason == "the experiment is complete"


@given(
    st.lists(st.integers(1, 40), min_size=1, max_size=30),
    st.sampled_from([1e-3, 5e-4, 1 / 300.0, 0.1, 1e-2]),
    st.integers(0, 10**6),
)
def test_segments_of_whole_ticks_last_so_many_ticks_each(lengths, period_s, first):
    """Ends are sums of floats and ticks are products: the sums must not win or lose a tick."""
    course = Course([Segment(Phase.OPEN_LOOP, n * period_s, 0, 0, float(i)) for i, n in
                     enumerate(lengths)])  # fmt: skip
    begin_s = first * period_s
    asked = []
    while (reference := course.at((first + len(asked)) * period_s - begin_s)) is not None:
        asked.append(reference.reference_valve_v)
    runs = [(valve_v, len(list(run))) for valve_v, run in groupby(asked)]
    assert runs == [(float(i), n) for i, n in enumerate(lengths)]


@given(st.integers(1, 60), st.sampled_from([1e-3, 5e-4, 1 / 300.0]), st.integers(0, 10**6))
def test_a_course_cut_to_whole_ticks_lasts_so_many_ticks(ticks, period_s, first):
    course = Course([Segment(Phase.OPEN_LOOP, 1.0, 0, 0, 1.0)], duration_s=ticks * period_s)
    begin_s = first * period_s
    lasted = 0
    while course.at((first + lasted) * period_s - begin_s) is not None:
        lasted += 1
    assert lasted == ticks


@pytest.mark.parametrize("frequency_hz", [0.3, 7.0])
def test_a_long_square_wave_keeps_its_frequency(frequency_hz):
    wave = plan_experiment(
        SquareSettings(kind="square", frequency_hz=frequency_hz, cycles=20)
    ).segments
    asked = walked(Course(wave))
    for tick, reference in enumerate(asked):
        halves = tick * 1e-3 * 2 * frequency_hz
        if abs(halves - round(halves)) > 1e-6:  # on the edge either is right
            assert reference.reference_valve_v == (5.0 if math.floor(halves) % 2 == 0 else -5.0)
    assert len(asked) == math.ceil(20 / frequency_hz * 1e3 - 1e-6)


def test_missed_ticks_may_skip_whole_segments_without_losing_the_time():
    course = Course([Segment(Phase.OPEN_LOOP, 0.01, 0, 0, float(i)) for i in range(10)])
    times_s = [0.0, 0.005, 0.0501, 0.0999]
    assert [course.at(t).reference_valve_v for t in times_s] == [0.0, 0.0, 5.0, 9.0]
    assert course.at(0.1) is None


# --- the motion of 7th order ---------------------------------------------------------------------

positions = st.floats(-0.1, 0.1)
durations = st.floats(0.05, 100.0)
shares = st.floats(0.0, 1.0)

# Of degree 7, from 0 to 1, velocity, acceleration and jerk zero at both ends: eight conditions.
CONDITIONS = np.array(
    [
        Polynomial.basis(power).deriv(order)(end) if order else Polynomial.basis(power)(end)
        for end in (0.0, 1.0)
        for order in range(4)
        for power in range(8)
    ]
).reshape(8, 8)
SHAPE = Polynomial(np.round(np.linalg.solve(CONDITIONS, [0, 0, 0, 0, 1, 0, 0, 0]), 6))


@given(positions, positions, durations, shares)
def test_motion_and_derivatives_are_those_of_the_polynomial_that_rests_at_both_ends(
    start, end, duration, share
):
    found = rest_to_rest(start, end, duration, share * duration)
    span = end - start
    for order, value in enumerate(found):
        shape = SHAPE.deriv(order) if order else SHAPE
        expected = (start if order == 0 else 0.0) + span * shape(share) / duration**order
        assert value == pytest.approx(expected, abs=1e-11 / duration**order)


@given(positions, positions, durations, st.floats(0.0, 10.0))
def test_the_position_is_constant_before_and_after_the_motion(start, end, duration, beyond):
    assert rest_to_rest(start, end, duration, -beyond) == Motion(start, 0.0, 0.0, 0.0)
    assert rest_to_rest(start, end, duration, duration + beyond) == Motion(end, 0.0, 0.0, 0.0)


# --- the excitation for a diagnosis --------------------------------------------------------------


def test_the_shipped_file_says_how_long_it_takes():
    lasts_s = sum(
        one.duration_s
        for one in plan_experiment(run_settings(experiment="diagnosis").experiment).segments
    )
    said = (config_dir() / "experiment" / "diagnosis.yaml").read_text()
    assert f"`pamctl diagnose`: {lasts_s:.0f} s," in said


def test_a_falling_chirp_is_refused():
    part = {"wave": "chirp", "low_hz": 50, "high_hz": 2, "amplitude_v": 3, "duration_s": 1}
    with pytest.raises(ValidationError, match="must lie below"):
        ProgramSettings(kind="program", parts=[part])
