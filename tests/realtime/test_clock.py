"""The grid never drifts, never bursts, and counts what it skips."""

import math
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pamctl.realtime.clock import (
    Clock,
    GridClock,
    VirtualClock,
    Wake,
    grid_point_from,
    grid_point_until,
    make_monotonic_sleeper,
)

MS = 1_000_000
linux_only = pytest.mark.skipif(sys.platform != "linux", reason="the real-time loop needs Linux")


class FakeTime:
    """A time that passes when it is read, slept through or worked away; sleeps may end late."""

    def __init__(self, now_ns: int = 12_345_678, read_ns: int = 50) -> None:
        self.time_ns = now_ns
        self.read_ns = read_ns
        self.oversleep_ns = 0
        self.alarms_ns: list[int] = []

    def now_ns(self) -> int:
        self.time_ns += self.read_ns
        return self.time_ns

    def sleep_until(self, alarm_ns: int) -> None:
        self.alarms_ns.append(alarm_ns)
        self.time_ns = max(self.time_ns, alarm_ns) + self.oversleep_ns

    def work(self, duration_ns: int) -> None:
        self.time_ns += duration_ns

    def clock(
        self, period_ns: int = MS, phase_ns: int | None = None, spin_ns: int = 0
    ) -> GridClock:
        return GridClock(
            period_ns, phase_ns, spin_ns, now_ns=self.now_ns, sleep_until=self.sleep_until
        )


@pytest.fixture
def fake() -> FakeTime:
    return FakeTime()


# The arithmetic of the grid.


@given(
    time_ns=st.integers(0, 10**12), point_ns=st.integers(0, 10**12), period_ns=st.integers(1, 10**9)
)
def test_the_grid_points_before_and_after_a_time_enclose_it(time_ns, point_ns, period_ns):
    after_ns = grid_point_from(time_ns, point_ns, period_ns)
    before_ns = grid_point_until(time_ns, point_ns, period_ns)
    assert before_ns <= time_ns <= after_ns
    assert after_ns - before_ns == (0 if time_ns == after_ns else period_ns)
    assert (after_ns - point_ns) % period_ns == 0


durations_ns = st.one_of(st.integers(0, 2 * MS), st.sampled_from([MS - 50, MS, 7 * MS]))


@given(
    start_ns=st.integers(0, 10**15),
    phase_ns=st.integers(0, MS - 1),
    spin_ns=st.integers(0, 20_000),
    disturbances=st.lists(st.tuples(durations_ns, durations_ns), min_size=1, max_size=60),
)
def test_whatever_work_and_sleep_take_every_tick_keeps_to_the_grid(
    start_ns, phase_ns, spin_ns, disturbances
):
    fake = FakeTime(start_ns, read_ns=500)
    clock = fake.clock(MS, phase_ns, spin_ns)
    wakes: list[Wake] = []
    for work_ns, oversleep_ns in disturbances:
        fake.oversleep_ns = oversleep_ns
        asked_ns = fake.time_ns
        wake = clock.wait()
        wakes.append(wake)
        assert asked_ns < wake.deadline_ns, "never a deadline in the past"
        assert 0 <= wake.now_ns - wake.deadline_ns < MS, "never another grid point's tick"
        assert wake.deadline_ns % MS == phase_ns
        assert wake.deadline_ns == wakes[0].deadline_ns + wake.tick * MS
        assert wake.tick == len(wakes) + sum(wake.missed for wake in wakes) - 1
        fake.work(work_ns)
    ticks = [wake.tick for wake in wakes]
    assert ticks == sorted(set(ticks)), "never two ticks on one grid point"
    assert wakes[0].tick == wakes[0].missed == 0


def test_the_default_phase_stays_within_a_short_period_and_off_the_kernel_tick(fake):
    assert fake.clock(MS // 10).wait().deadline_ns % (MS // 10) == 30_000


def test_a_tick_that_ends_exactly_on_its_deadline_is_not_an_overrun():
    fake = FakeTime(read_ns=0)
    clock = fake.clock()
    assert [clock.wait().tick, clock.wait().tick] == [0, 1], "no point twice, however short a tick"
    fake.work(MS)
    assert clock.wait()[0::3] == (2, 0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0,), "period_ns must be positive, got 0"),
        ((MS, MS), r"phase_ns must be >= 0 and below the period \(1000000\), got 1000000"),
        ((MS, -1), "phase_ns must be >= 0"),
        ((MS, 0, MS), "spin_ns must be >= 0 and below the period"),
        ((MS // 10, None, MS // 10), "spin_ns must be >= 0 and below the period"),
    ],
)
def test_a_grid_out_of_bounds_is_refused_with_its_bounds(arguments, message):
    with pytest.raises(ValueError, match=message):
        GridClock(*arguments)


# The real clock. No test here is a statement about how fast a machine is.


@linux_only
def test_the_real_grid_keeps_its_mean_rate():
    clock: Clock = GridClock(2 * MS, spin_ns=50_000)
    first, *wakes = [clock.wait() for _ in range(150)]
    for wake in wakes:
        assert wake.deadline_ns == first.deadline_ns + wake.tick * 2 * MS
        assert 0 <= wake.now_ns - wake.deadline_ns < 2 * MS, "what is later is another tick"
    assert wakes[-1].tick == 149 + sum(wake.missed for wake in wakes)


@linux_only
def test_the_wall_offset_turns_monotonic_into_unix_time():
    clock = GridClock(MS)
    unix_ns = clock.now_ns() + clock.wall_offset_ns()
    assert math.isclose(unix_ns, time.time_ns(), rel_tol=0.0, abs_tol=1e9)


@linux_only
def test_an_impossible_sleep_is_an_error_and_not_a_busy_loop():
    with pytest.raises(OSError, match="clock_nanosleep: Invalid argument"):
        make_monotonic_sleeper()(-1)


@contextmanager
def interrupted(
    handler: Callable[[int, FrameType | None], None], after_s: float, every_s: float = 0.0
) -> Iterator[None]:
    """SIGALRM, handled, once or again and again."""
    before = signal.signal(signal.SIGALRM, handler)
    signal.setitimer(signal.ITIMER_REAL, after_s, every_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@linux_only
def test_signals_are_handled_within_the_wait_and_do_not_bring_the_tick_forward():
    handled_ns: list[int] = []
    clock = GridClock(300 * MS, spin_ns=0)
    clock.wait()
    with interrupted(lambda *_: handled_ns.append(time.monotonic_ns()), 0.010, 0.005):
        wake = clock.wait()
    in_time = [time_ns for time_ns in handled_ns if time_ns < wake.deadline_ns]
    assert len(in_time) >= 2, "the wait is taken up again after every signal"
    assert wake.now_ns >= wake.deadline_ns


@linux_only
def test_an_interrupted_sleep_is_slept_to_its_end():
    alarm_ns = time.monotonic_ns() + 50 * MS
    with interrupted(lambda *_: None, 0.005, 0.005):
        make_monotonic_sleeper()(alarm_ns)
    assert time.monotonic_ns() >= alarm_ns


@linux_only
def test_a_handler_that_raises_ends_the_wait_and_leaves_the_grid_valid():
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    clock = GridClock(300 * MS, spin_ns=0)
    first = clock.wait()
    with interrupted(interrupt, 0.005), pytest.raises(KeyboardInterrupt):
        clock.wait()
    wake = clock.wait()
    assert wake.tick == wake.missed + 1
    assert wake.deadline_ns == first.deadline_ns + wake.tick * 300 * MS


# No clock at all.


def test_a_virtual_clock_without_a_period_is_refused():
    with pytest.raises(ValueError, match="period_ns must be positive, got -1"):
        VirtualClock(-1)


# The rehearsal.


def test_a_rehearsal_runs_in_every_spin_and_moves_no_tick(fake):
    clock = fake.clock(spin_ns=100_000)
    ran_at_ns: list[int] = []

    def rehearse() -> None:
        ran_at_ns.append(fake.time_ns)
        fake.work(20_000)

    wakes = [clock.wait(rehearse) for _ in range(50)]
    assert len(ran_at_ns) == 49  # the first wait has nothing to rehearse
    assert [wake.tick for wake in wakes] == list(range(50))
    for wake, at_ns in zip(wakes[1:], ran_at_ns, strict=True):
        assert at_ns < wake.deadline_ns <= wake.now_ns <= wake.deadline_ns + 2 * fake.read_ns


def test_a_rehearsal_that_would_not_end_in_time_is_left_out_until_it_is_short(fake):
    clock = fake.clock(spin_ns=100_000)
    long_ns, ran = 400_000, []

    def rehearse() -> None:
        ran.append(fake.time_ns)
        fake.work(long_ns)

    late_ns = []
    for _ in range(20):
        wake = clock.wait(rehearse)
        late_ns.append(wake.now_ns - wake.deadline_ns)
    assert len(ran) == 1  # one was late; none of the next
    assert max(late_ns[2:]) <= 2 * fake.read_ns
    long_ns = 10_000
    for _ in range(200):
        clock.wait(rehearse)
    assert len(ran) > 50
