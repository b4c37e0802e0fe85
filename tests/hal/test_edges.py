"""The edges of a card's clock, estimated from the times at which reads return."""

import random
from itertools import pairwise
from statistics import stdev

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.nidaq.nidaq_rig import EdgeGrid
from hal.rig import Edge
from pamctl.realtime.clock import GridClock, SampleClock, Wake

MS = 1_000_000
PROMPT_NS = 20_000
"""What the quickest wake-up takes."""


def returns(
    periods: list[int], delays_ns: list[int], drift_ppm: float = 0.0
) -> tuple[list[int], list[float]]:
    """When reads return, and when their edges were: `periods` apart, each `delays_ns` later."""
    edge, seen, true_ns = 0, [], []
    for elapsed, delay_ns in zip(periods, delays_ns, strict=True):
        edge += elapsed
        true_ns.append(1e9 + edge * MS * (1.0 + drift_ppm * 1e-6))
        seen.append(round(true_ns[-1]) + PROMPT_NS + delay_ns)
    return seen, true_ns


@given(
    st.lists(
        st.tuples(st.sampled_from([1, 1, 1, 1, 2, 3, 40]), st.integers(0, 850_000)), max_size=80
    ),
    st.floats(-100, 100),
)
def test_every_missed_edge_is_counted_however_late_the_reads_return(steps, drift_ppm):
    periods, delays_ns = [1, *(p for p, _ in steps)], [0, *(d for _, d in steps)]
    seen, _ = returns(periods, delays_ns, drift_ppm)
    grid = EdgeGrid(MS)
    assert [grid.place(now_ns).elapsed for now_ns in seen] == periods


@given(st.lists(st.integers(0, 10**12), min_size=1, max_size=50, unique=True))
def test_samples_are_in_order_and_never_from_the_future_whatever_the_times(times_ns):
    grid = EdgeGrid(MS)
    edges = [grid.place(now_ns) for now_ns in sorted(times_ns)]
    assert all(edge.t_ns <= edge.now_ns and edge.elapsed >= 1 for edge in edges)
    assert all(a.t_ns < b.t_ns for a, b in pairwise(edges))


@pytest.mark.parametrize("drift_ppm", [-80.0, 80.0])
def test_the_grid_follows_the_clock_of_the_card_for_ten_minutes(drift_ppm):
    """Two crystals differ by 48 ms in ten minutes: index and time follow the card's clock."""
    chance, grid, count = random.Random(1), EdgeGrid(MS), 0
    for tick in range(1, 600_000, 9):
        delay_ns = PROMPT_NS + min(round(chance.expovariate(1e-5)), 800_000)
        true_ns = 10**9 + round(tick * MS * (1 + drift_ppm * 1e-6))
        edge = grid.place(true_ns + delay_ns)
        count += edge.elapsed
    assert count == tick
    assert abs(edge.t_ns - true_ns) < 150_000


def test_a_late_wake_up_is_computed_from_the_time_of_the_sample():
    grid = EdgeGrid(MS)
    grid.place(5 * MS)
    edge = grid.place(6 * MS + 400_000)
    assert edge == Edge(6 * MS + 100, 6 * MS + 400_000, 1)
    assert grid.place(7 * MS) == Edge(7 * MS, 7 * MS, 1)  # pulled back, and on it goes


def test_the_jitter_of_wake_ups_does_not_reach_the_measured_dt():
    chance, grid = random.Random(2), EdgeGrid(MS)
    seen, _ = returns([1] * 2000, [round(chance.expovariate(1 / 50_000)) for _ in range(2000)])
    times_ns = [grid.place(now_ns).t_ns for now_ns in seen]

    def jitter_ns(times_ns: list[int]) -> float:
        return stdev(b - a for a, b in pairwise(times_ns[200:]))

    assert jitter_ns(times_ns) < 0.05 * jitter_ns(seen)


def test_the_rigs_edges_become_the_ticks_of_its_clock():
    grid, times = EdgeGrid(MS), iter([10 * MS, 11 * MS + 30_000, 14 * MS])
    clock = SampleClock(GridClock(MS), lambda: grid.place(next(times)))
    assert clock.wait() == Wake(0, 10 * MS, 10 * MS, 0)
    assert clock.wait() == Wake(1, 11 * MS + 100, 11 * MS + 30_000, 0)
    assert clock.wait() == Wake(4, 14 * MS, 14 * MS, 2)
    assert clock.period_ns == MS
