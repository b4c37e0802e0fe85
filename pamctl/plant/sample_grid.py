"""When samples are taken and commands act, and into which steps a drive is cut for that."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pamctl.plant.parameters import (
    PlantParameters,
)
from pamctl.plant.simulated import LONGEST_STEP_S

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Array = NDArray[np.float64]


STEPS_A_TICK = 2
SAME_INSTANT_S = 1e-10
"""Instants closer than this count as one."""


def check_signal(name: str, values: ArrayLike, length: int | None = None) -> Array:
    """Return one finite value a sample, shape (n,); raise ValueError that calls it `name`."""
    signal = np.ascontiguousarray(values, dtype=np.float64)
    if signal.ndim != 1 or not len(signal):
        raise ValueError(f"{name}: one value a sample is needed, not shape {signal.shape}")
    if length is not None and len(signal) != length:
        raise ValueError(f"{name}: {len(signal)} samples, where the command has {length}")
    if not np.isfinite(signal).all():
        raise ValueError(f"{name}: sample {int(np.argmin(np.isfinite(signal)))} is not a number")
    return signal


def _check_intervals(dt_s: ArrayLike, samples: int) -> Array:
    given: Any = np.asarray(dt_s, dtype=np.float64)
    if given.ndim == 0:
        given = np.full(max(samples - 1, 0), given)
    if given.ndim != 1 or len(given) not in (samples - 1, samples):
        raise ValueError(f"dt_s: {given.shape} for {samples} samples; one for each interval")
    intervals = np.ascontiguousarray(given[: samples - 1])
    if not (np.isfinite(intervals) & (intervals > 0.0)).all():
        raise ValueError("dt_s: every interval must be longer than 0 s")
    return intervals


def _check_acts_after(given: ArrayLike | None, samples: int) -> Array | None:
    """Return when commands act after their samples; None where all act at their samples."""
    if given is None:
        return None
    late_s: Any = np.asarray(given, dtype=np.float64)
    if late_s.ndim == 0:
        late_s = np.full(samples, late_s)
    late_s = check_signal("acts_after_s", late_s, samples)
    return late_s if np.any(np.abs(late_s) > SAME_INSTANT_S) else None


class DriveSteps(NamedTuple):
    """The steps of a whole drive."""

    first: NDArray[np.int64]
    """For each sample the index of the first step after it."""
    step_s: Array
    command_v: Array
    """The command that acts at the valve in each step."""
    ends_s: Array
    """Ends of the steps, from the first sample on: one more than steps."""


class SampleGrid(NamedTuple):
    """Samples and the steps between them, made once for many drives."""

    samples_s: Array
    """Times of the samples since the first one."""
    acts_s: Array
    """When each command acts, on the same clock, never falling."""
    held_v: float | None
    """The command that acts until the first one does; None: the first one itself."""
    acting: NDArray[np.int64]
    """For each step the index of the command that acts; -1 until the first one does."""
    first: NDArray[np.int64]
    """For each sample the index of the first step after it."""
    step_s: Array
    ends_s: Array
    """Ends of the steps: one more than steps."""


def build_grid(
    dt_s: ArrayLike | SampleGrid,
    samples: int,
    steps: int = STEPS_A_TICK,
    acts_after_s: ArrayLike | None = None,
    held_v: float | None = None,
) -> SampleGrid:
    """Cut each interval where a command acts, and each part into equal steps.

    An interval of one period gets `steps` steps. A tolerance of a tenth keeps jitter from adding
    one. `acts_after_s` is one number, or one for each sample; None: commands act at their samples.
    Until the first command acts the valve has `held_v`, in which it had settled; by default it has
    the first command, and its spool starts as the state says.
    A grid is returned unchanged. Raises ValueError if arrays do not fit the number of samples, or
    if a grid is given another `acts_after_s`.
    """
    if isinstance(dt_s, SampleGrid):
        if len(dt_s.samples_s) != samples:
            raise ValueError(f"dt_s: a grid of {len(dt_s.samples_s)} samples, where {samples} are")
        if acts_after_s is not None:
            raise ValueError("acts_after_s: a grid has its own; give it to build_grid")
        return dt_s
    intervals = _check_intervals(dt_s, samples)
    longest_s = 1.1 * find_period_s(intervals) / steps if len(intervals) else 1.0
    samples_s = accumulate_times(intervals)
    late_s = _check_acts_after(acts_after_s, samples)
    if late_s is None:
        acts_s, acting, parts_s = samples_s, np.arange(samples - 1), intervals
        begins = np.arange(samples)
    else:
        # A command that was written later replaces one that is still on its way.
        acts_s = np.maximum.accumulate(samples_s + late_s)
        cuts_s = _merge_instants(samples_s, acts_s)
        acting = np.searchsorted(acts_s, cuts_s[:-1] + SAME_INSTANT_S, "right") - 1
        parts_s = np.diff(cuts_s)
        begins = np.searchsorted(cuts_s, samples_s - SAME_INSTANT_S)
    counts = np.maximum(1, np.ceil(parts_s / longest_s - 1e-6)).astype(np.int64)
    step_s = np.repeat(parts_s / counts, counts)
    first = np.concatenate([[0], np.cumsum(counts)])[begins]
    acting = np.repeat(acting, counts)
    is_whole = len(step_s) == len(intervals)  # one step from each sample to the next
    ends_s = samples_s if is_whole else accumulate_times(step_s)
    return SampleGrid(samples_s, acts_s, held_v, acting, first, step_s, ends_s)


def count_steps(period_s: float) -> int:
    """Return the steps of the simulation in a period: none much longer than half a millisecond."""
    return max(STEPS_A_TICK, round(period_s / LONGEST_STEP_S))


def find_period_s(intervals_s: Array) -> float:
    """Return the period of a record: the median interval; less if half of its ticks are missed."""
    usual_s, quick_s = float(np.median(intervals_s)), float(np.quantile(intervals_s, 0.25))
    return quick_s if usual_s > 1.5 * quick_s else usual_s


def build_steps(p: PlantParameters, command_v: Array, grid: SampleGrid) -> DriveSteps:
    """Assign commands to steps; a step is cut where a delayed command arrives within it."""
    delay_s = p.effects.timing.command_delay.delay_s
    if delay_s <= 0.0:
        acting_v = _select_commands(command_v, grid.acting, grid.held_v)
        return DriveSteps(grid.first, grid.step_s, acting_v, grid.ends_s)
    arrivals_s = grid.acts_s + delay_s
    ends_s = _merge_instants(grid.ends_s, arrivals_s)
    arrived = np.searchsorted(arrivals_s, ends_s[:-1] + SAME_INSTANT_S, "right") - 1
    first = np.searchsorted(ends_s, grid.samples_s - SAME_INSTANT_S)
    return DriveSteps(
        first, np.diff(ends_s), _select_commands(command_v, arrived, grid.held_v), ends_s
    )


def _select_commands(command_v: Array, indices: NDArray[np.int64], held_v: float | None) -> Array:
    """Return the command of each step; the indices never fall, and -1 is before the first."""
    waiting = int(np.searchsorted(indices, 0))
    selected_v = command_v[indices]
    selected_v[:waiting] = command_v[0] if held_v is None else held_v
    return selected_v


def _merge_instants(ends_s: Array, more_s: Array) -> Array:
    """Return the instants of both within the span of the first; nearly equal ones count once."""
    inside = (more_s > ends_s[0]) & (more_s < ends_s[-1])
    cuts_s = np.sort(np.concatenate([ends_s, more_s[inside]]), kind="stable")  # of sorted parts
    merged: Array = cuts_s[np.concatenate([[True], np.diff(cuts_s) > SAME_INSTANT_S])]
    return merged


def accumulate_times(dt_s: Array) -> Array:
    """Return the times since the first sample, from the intervals between them."""
    return np.concatenate([[0.0], np.cumsum(dt_s)])
