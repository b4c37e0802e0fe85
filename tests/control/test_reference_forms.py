"""Forms of a reference have exact derivatives and join without a jump."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from pamctl.control.course import Course, Plan, reference_at
from pamctl.control.experiment import ExperimentSettings, plan_experiment
from pamctl.control.sketch import MOST_SEGMENTS
from pamctl.control.waves import Faded, Sampled, Shape, SpeedChange, Sweep, Tone, Tones, Transition
from pamctl.signals import Phase, Reference

SETTINGS: TypeAdapter[Any] = TypeAdapter(ExperimentSettings)

FORMS: dict[str, dict[str, Any]] = {
    "sine": {"offset": 10, "amplitude": 2, "frequency_hz": 1.5, "cycles": 3},
    "multisine": {
        "offset": 10, "amplitude": 1, "low_hz": 0.3, "high_hz": 5, "period_s": 4, "periods": 2,
    },
    "chirp": {"offset": 10, "amplitude": 1, "start_hz": 0.5, "end_hz": 6, "duration_s": 9},
    "random": {"offset": 10, "amplitude": 2, "high_hz": 2, "duration_s": 5},
    "rounded_square": {
        "offset": 10, "amplitude": 2, "frequency_hz": 0.5, "jerk_per_s3": 3000, "cycles": 3,
    },
    "triangle": {"offset": 10, "amplitude": 2, "frequency_hz": 0.5, "rounding": 0.3, "cycles": 3},
    "ramps": {
        "levels": [4, 12, 11.99, 11.99, 6], "speed_per_s": 5, "jerk_per_s3": 800, "hold_s": 0.5,
        "cycles": 3,
    },
    "staircase": {"levels": [4, 7, 9, 9, 5], "jerk_per_s3": 900, "hold_s": 0.5, "cycles": 3},
    "table": {
        "t_s": [0, 0.5, 1.1, 1.5, 2.5, 4], "values": [3, 4, 6, 5, 5, 3.5], "cycles": 2,
    },
}  # fmt: skip
LENGTHS = {"offset", "amplitude", "levels", "values", "to"}


def state(kind: str, *, valve: bool = False, **changes: Any) -> dict[str, Any]:
    """Return a form as a file has it."""
    unit = "v" if valve else "mm"
    keys = {**FORMS[kind], **changes}
    named = {
        f"{name}_{unit}" if name in LENGTHS else name.replace("_per_s", f"_{unit}_per_s")
        if name in ("speed_per_s", "jerk_per_s3") else name: value
        for name, value in keys.items()
    }  # fmt: skip
    return {"kind": f"valve_{kind}" if valve else kind, **named}


def plan(data: dict[str, Any]) -> Plan:
    return plan_experiment(SETTINGS.validate_python(data))


def assert_derivatives(shape: Shape, t_s: float, step_s: float = 1e-4) -> None:
    """Hold each derivative against differences of the one before it."""
    for order in range(3):
        around = [shape.at(t_s + i * step_s)[order] for i in (-2, -1, 1, 2)]
        slope = (around[0] - 8 * around[1] + 8 * around[2] - around[3]) / (12 * step_s)
        scale = max(abs(value) for value in shape.at(t_s)) + abs(slope)
        assert shape.at(t_s)[order + 1] == pytest.approx(slope, abs=1e-6 * scale)


@pytest.mark.parametrize(
    "shape",
    [
        Tones((Tone(0.002, 12.0, 0.3), Tone(0.001, 25.0, 2.0))),
        Sweep(0.002, 0.5, 6.0, 8.0, True),
        Sweep(0.002, 6.0, 0.5, 8.0, False),
        Sweep(0.002, 2.0, 2.0, 8.0, True),
        SpeedChange(0.003, 0.004, -0.006, 3.0),
        Transition(0.003, 0.006, 3.0),
        Faded(Tones((Tone(0.002, 12.0, 0.3),)), 0.01, 0.7, 0.0, 1.0, 2.0),
        Faded(Sweep(0.002, 0.5, 6.0, 8.0, True), 0.01, 5.0, 1.0, 0.0, 2.5),
        Sampled((0.0, 0.5, 1.1, 1.5, 2.5, 3.0), (0.003, 0.004, 0.006, 0.005, 0.005, 0.0035)),
    ],
    ids=lambda shape: type(shape).__name__,
)
@pytest.mark.parametrize("t_s", [0.31, 0.87, 1.34, 1.83])
def test_each_derivative_is_the_slope_of_the_one_before(shape, t_s):
    assert_derivatives(shape, t_s)


def test_a_sine_has_the_derivatives_of_a_sine():
    course = plan(state("sine"))
    full = next(s for s in course.segments if s.phase == Phase.TRACK)
    w = math.tau * 1.5
    for t_s in (0.0, 0.1, 0.35, 1.7):
        found = reference_at(full, t_s)
        assert found.reference_m == pytest.approx(0.010 + 0.002 * math.sin(w * t_s), abs=1e-12)
        assert found.reference_velocity_m_per_s == pytest.approx(0.002 * w * math.cos(w * t_s))
        assert found.reference_acceleration_m_per_s2 == pytest.approx(
            -0.002 * w**2 * math.sin(w * t_s), abs=1e-12
        )
        assert found.reference_jerk_m_per_s3 == pytest.approx(-0.002 * w**3 * math.cos(w * t_s))
    assert full.duration_s == pytest.approx(3 / 1.5)


@pytest.mark.parametrize("spacing", ["linear", "logarithmic"])
def test_a_chirp_begins_and_ends_at_its_frequencies(spacing):
    wave = Sweep(1.0, 0.5, 6.0, 8.0, spacing == "logarithmic")
    # At phase 0 the speed is amplitude x w.
    assert wave.at(0.0).velocity_m_per_s == pytest.approx(math.tau * 0.5)
    end = wave.at(8.0)
    w = math.hypot(end.velocity_m_per_s, math.tau * 6.0 * end.position_m)
    assert w == pytest.approx(math.tau * 6.0)
    middle_hz = math.sqrt(0.5 * 6.0) if spacing == "logarithmic" else 3.25
    middle = wave.at(4.0)
    speed = math.hypot(middle.velocity_m_per_s, math.tau * middle_hz * middle.position_m)
    assert speed == pytest.approx(math.tau * middle_hz)


@pytest.mark.parametrize("kind", FORMS)
def test_a_form_joins_its_parts_without_a_jump_up_to_the_jerk(kind):
    course = plan(state(kind))
    assert course.segments[0].start_m == 0.0
    for before, after in pairwise(course.segments):
        end, begin = reference_at(before, before.duration_s), reference_at(after, 0.0)
        scales = (1e-9, 1e-8, 1e-6, 1e-4)
        for name, tolerance in zip(Reference._fields[1:5], scales, strict=True):
            assert getattr(begin, name) == pytest.approx(getattr(end, name), abs=tolerance), name
    last = course.segments[-1]
    rest = reference_at(last, last.duration_s)
    assert rest[2:5] == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize("kind", FORMS)
def test_a_form_of_the_valve_has_the_values_of_the_form_of_the_muscle(kind):
    small = {
        key: [0.1 * v for v in value] if isinstance(value, list) else 0.1 * value
        for key, value in FORMS[kind].items()
        if key in LENGTHS or key in ("speed_per_s", "jerk_per_s3")
    }
    valve, muscle = plan(state(kind, valve=True, **small)), plan(state(kind, **small))
    shaped = [s for s in muscle.segments if s.phase != Phase.APPROACH or s.shape is not None]
    jumps = kind in ("ramps", "staircase", "table")  # the valve needs no way back to the begin
    if not jumps:
        assert len(valve.segments) == len(shaped)
    for ours, theirs in zip(valve.segments[:3], shaped[:3], strict=True):
        t_s = 0.37 * ours.duration_s
        found = reference_at(ours, t_s)
        assert found.phase == Phase.OPEN_LOOP
        assert math.isnan(found.reference_m)
        assert found.reference_valve_v == pytest.approx(
            1e3 * reference_at(theirs, t_s).reference_m, abs=1e-9
        )


def test_a_step_reaches_exactly_its_jerk():
    course = plan(state("staircase", levels=[4, 7], jerk_per_s3=900, hold_s=1, cycles=1))
    step = next(s for s in course.segments if s.phase == Phase.TRACK)
    shares = np.linspace(0, 1, 2001)
    jerk = [abs(reference_at(step, r * step.duration_s).reference_jerk_m_per_s3) for r in shares]
    assert max(jerk) == pytest.approx(0.9, rel=1e-6)


def test_ramps_keep_to_their_speed_and_jerk_and_a_short_one_never_reaches_the_speed():
    course = plan(state("ramps", levels=[4, 12, 11.99], cycles=1))
    moving = [s for s in course.segments if isinstance(s.shape, SpeedChange)]
    assert len(moving) == 5  # two corners and a line; two corners
    for segment in moving:
        for r in np.linspace(0, 1, 201):
            found = reference_at(segment, r * segment.duration_s)
            assert abs(found.reference_velocity_m_per_s) <= 0.005 * (1 + 1e-9)
            assert abs(found.reference_jerk_m_per_s3) <= 0.8 * (1 + 1e-9)
    assert reference_at(moving[-1], moving[-1].duration_s).reference_m == pytest.approx(0.01199)


def test_a_triangle_reaches_its_amplitude_and_keeps_its_period():
    course = plan(state("triangle", cycles=4, trigger="camera"))
    walked = sample(course)
    moving = [r.reference_m for r in walked if r.phase == Phase.TRACK]
    assert max(moving) == pytest.approx(0.012, abs=1e-8)
    assert min(moving) == pytest.approx(0.008, abs=1e-8)
    times_s = [cue.at_s for cue in course.cues]
    assert np.diff(times_s) == pytest.approx(2.0)
    for cue in course.cues[1:]:  # a period begins in the middle of the lower corner
        assert at(course, cue.at_s).reference_m == pytest.approx(0.008, abs=1e-8)
        assert at(course, cue.at_s).reference_velocity_m_per_s == pytest.approx(0.0, abs=1e-8)


def test_a_multisine_repeats_itself_and_reaches_its_peak():
    course = plan(state("multisine", amplitude=1.5))
    wave = next(s for s in course.segments if s.phase == Phase.TRACK)
    values = np.array([reference_at(wave, i * 1e-3).reference_m for i in range(8000)])
    assert values[:4000] == pytest.approx(values[4000:], abs=1e-12)
    assert np.abs(values - 0.010).max() == pytest.approx(0.0015, rel=0.02)
    power = np.abs(np.fft.rfft(values[:4000] - values[:4000].mean())) ** 2
    within = power[1:21].sum()  # 0.25 to 5 Hz in steps of 1/4 Hz
    assert within == pytest.approx(power.sum(), rel=1e-9)


def test_random_motion_stays_in_its_band_and_follows_its_seed():
    first, again, other = (
        np.array([r.reference_m for r in sample(plan(state("random", seed=seed, duration_s=20)))])
        for seed in (1, 1, 2)
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    full = first[8000:28000] - 0.010
    assert np.abs(full).max() == pytest.approx(0.002, rel=0.02)
    power = np.abs(np.fft.rfft(full * np.hanning(len(full)))) ** 2
    assert power[: round(2.2 * 20)].sum() > 0.999 * power.sum()


@given(st.lists(st.tuples(st.floats(0.01, 2.0), st.floats(0, 20)), min_size=2, max_size=12))
def test_a_table_goes_through_its_points_with_continuous_jerk(steps):
    t_s = np.cumsum([0.0, *(s for s, _ in steps[1:])])
    values = [v for _, v in steps]
    curve = Sampled(tuple(t_s.tolist()), tuple(values))
    for knot, (time_s, value) in enumerate(zip(t_s.tolist(), values, strict=True)):
        assert curve.at(time_s).position_m == pytest.approx(value, abs=5e-9)
        if 0 < knot < len(values) - 1:
            left, right = curve.at(math.nextafter(time_s, -1.0)), curve.at(time_s)
            for a, b in zip(left, right, strict=True):
                assert a == pytest.approx(b, rel=1e-5, abs=1e-5 * (1 + max(map(abs, right))))
    assert curve.at(0.0)[1:] == (0.0, 0.0, 0.0)


def test_a_table_of_a_smooth_motion_follows_it_and_its_derivatives():
    t_s = [0.01 * i for i in range(501)]

    def smooth(t: float) -> tuple[float, float, float, float]:
        return Faded(Tones((Tone(2.0, 6.0, 0.0),)), 5.0, 0.0, 0.0, 1.0, 5.0).at(t)

    curve = Sampled(t_s, [smooth(t)[0] for t in t_s])
    for t in (1.0042, 2.5, 3.777):
        for found, wanted, within in zip(
            curve.at(t), smooth(t), (1e-6, 1e-4, 1e-2, 1.0), strict=True
        ):
            assert found == pytest.approx(wanted, abs=within)


# --- sequences ---------------------------------------------------------------------------------

SEQUENCE = {
    "kind": "sequence",
    "parts": [
        {"kind": "mark", "text": "begin"},
        state("sine", trigger="camera"),
        {"kind": "pause", "duration_s": 0.5},
        {
            "kind": "repeat",
            "times": 4,
            "parts": [
                {"kind": "move", "to_mm": 12, "duration_s": 1},
                {"kind": "gains", "set": {"lambda_per_s": 20}},
                {"kind": "mark", "text": "up"},
                {"kind": "move", "to_mm": 10, "duration_s": 1},
            ],
        },
        state("triangle"),
    ],
}


def test_a_sequence_joins_its_parts_and_repeats_them():
    course = plan(SEQUENCE)
    marks = [cue.mark for cue in course.cues if cue.gains is None]
    assert marks == ["begin", "camera 1", "camera 2", "camera 3", *["up"] * 4]
    ups_s = [cue.at_s for cue in course.cues if cue.mark == "up"]
    assert np.diff(ups_s) == pytest.approx(2.0)
    assert all(at(course, t_s).reference_m == pytest.approx(0.012) for t_s in ups_s)
    assert sum(cue.gains is not None for cue in course.cues) == 4
    walked = sample(course)
    speeds = np.array([r.reference_velocity_m_per_s for r in walked])
    positions = np.array([r.reference_m for r in walked])
    assert np.abs(np.diff(positions)).max() <= np.abs(speeds).max() * 1e-3 * (1 + 1e-9)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ({"kind": "sequence", "parts": [{"kind": "mark", "text": "a"}]}, "no part moves anything"),
        (
            {"kind": "sequence", "parts": [state("sine"), state("sine", valve=True)]},
            "make two experiments of them",
        ),
        (state("rounded_square", jerk_per_s3=10), "longer than half a period of 1 s"),
        (state("multisine", period_s=0.1), "make the period longer"),
        (state("multisine", low_hz=9), "low_hz 9 must lie below high_hz 5"),
        (state("chirp", fade_s=5), "leaves nothing of duration_s 9"),
        (state("table", t_s=[0, 1, 1, 2, 3, 4]), "point 3 is at 1 s after 1 s"),
        (state("table", t_s=[0, 1]), "2 times, but 6 values"),
        (state("table", t_s=[], values=[]), "two points at least"),
    ],
)
def test_a_form_that_cannot_be_is_refused(data, said):
    with pytest.raises(ValidationError, match=said):
        SETTINGS.validate_python(data)


def test_repeats_of_repeats_have_an_end():
    inner: dict[str, Any] = {"kind": "move", "to_mm": 1, "duration_s": 1}
    for _ in range(3):
        inner = {"kind": "repeat", "times": 1000, "parts": [inner]}
    with pytest.raises(ValueError, match=str(MOST_SEGMENTS)):
        plan({"kind": "sequence", "parts": [inner]})


def test_cues_come_once_and_in_their_order():
    course = plan(SEQUENCE)
    walked = Course(course.segments, None, course.cues)
    taken = []
    for tick in range(round(course.duration_s * 1e3)):
        while (cue := walked.take_cue(tick * 1e-3)) is not None:
            assert tick * 1e-3 - 1e-3 < cue.at_s <= tick * 1e-3 + 1e-9
            taken.append(cue)
    assert tuple(taken) == course.cues


def sample(course: Plan) -> list[Reference]:
    """Return the references of a course, a tick of 1 ms apart."""
    walked = Course(course.segments)
    count = round(course.duration_s * 1e3)
    found = [walked.at(tick * 1e-3) for tick in range(count)]
    return [reference for reference in found if reference is not None]


def at(course: Plan, t_s: float) -> Reference:
    """Return the reference of a course at one time."""
    found = Course(course.segments).at(t_s)
    assert found is not None
    return found
