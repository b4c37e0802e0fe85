"""What a perfect model leaves since the columns that drive it are measured: their sensors' noise.

A drawn noise of that size is passed through the fitted model. How large it is, at each time scale,
the columns tell themselves: by third differences of means over so many samples, in the quietest
record. They vanish of a smooth motion, and those of a higher order are then much smaller; where
they are, and from there on, the column moves, and the noise is taken to be as before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import comb, sqrt

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.evidence.constants import COARSE_STEP_S
from pamctl.diagnose.evidence.fit import WeighedModel, Weigher
from pamctl.diagnose.evidence.likelihood import from_haar, levels_of, to_haar
from pamctl.diagnose.evidence.measured_columns import find_resolution

Array = NDArray[np.float64]

ORDER = 3
"""Of the differences: estimate_white_noise takes the same."""
MEDIAN = 0.6745
"""Of the size of a normal variable."""
MOVES = 1.2
"""Times what the next order shows: so much more shows a motion. Noise has the same in all orders. A
wave of f Hz has more in means over less than 0.28 / f s."""
MOST_COLOUR = 4.0
"""Times the noise of the finest scale: at slow ones no more is taken for noise. The coloured noise
of a current sensor left 30 um of a position. Half: 16 um of it are explained. Twice: 34 um."""
CLEARLY = 2.0
"""Times the mean square that a model leaves: a noise that leaves more is none."""
ROUNDED = 1.1
"""Times a mean square: two digits of its root are said."""
FEWEST = 48
"""Differences, or coefficients, of which a size is made."""


def count_input_noise(
    weigher: Weigher, m: WeighedModel, stated: Mapping[str, float] | None = None
) -> None:
    """Count what noise of the inputs this model leaves to the noise of each channel, from now on.

    `stated` are deviations of sensors by channel, SI.
    """
    shown2 = noise2 = find_input_error2(weigher, m, {})
    if {*weigher.train.drivers} & {*(stated or {})}:
        noise2 = find_input_error2(weigher, m, stated or {})
    weigher.further_noise2 = weigher.train.find_start_error2() + noise2
    weigher.slow_noise2 = np.maximum(noise2 - shown2, 0.0)


def find_input_error2(weigher: Weigher, m: WeighedModel, stated: Mapping[str, float]) -> Array:
    """Return the mean square that the noise of what drives a model leaves of each channel.

    It is nowhere more than what the model leaves at that time scale, or clearly more if it was
    stated: a force that really jumps from sample to sample is no noise, as the position follows it.
    """
    drivers = weigher.train.drivers
    if not drivers:
        return np.zeros(len(weigher.train.channels))
    passed = _pass_noise(
        weigher, m, {name: estimate_noise(weigher, name, stated.get(name)) for name in drivers}
    )
    most = _bound(weigher, passed, m.d) * (CLEARLY if {*drivers} & {*stated} else 1.0)
    return weigher.like.mean_squares(passed) * np.minimum(most, 1.0)


def find_enough_noise(
    weigher: Weigher, m: WeighedModel, more2: Array, stated: Mapping[str, float]
) -> dict[str, float]:
    """Return the deviation of a driver's noise that would add so much to each channel, by column.

    `more2` are mean squares. A driver is left out whose noise is stated, or would leave clearly
    more than the model does at some time scale.
    """
    found = {}
    for name in (name for name in weigher.train.drivers if name not in stated):
        sizes = estimate_noise(weigher, name)
        passed = _pass_noise(weigher, m, {name: sizes})
        most = _bound(weigher, passed, m.d)
        times2 = np.minimum(most, 1.0) + more2 / weigher.like.mean_squares(passed)
        if (times2 < CLEARLY * most).all():
            found[name] = float(sizes[0] * np.sqrt(ROUNDED * times2.max()))
    return found


def estimate_noise(weigher: Weigher, name: str, stated: float | None = None) -> Array:
    """Return the deviation of a driver's noise at each Haar level, by all records."""
    parts = (part for part in (weigher.train, weigher.held_out) if part is not None)
    columns = [s.inputs[name] for part in parts for s in part.stretches]
    return estimate_sizes(columns, weigher.train.block, stated)


def _pass_noise(weigher: Weigher, m: WeighedModel, sizes: Mapping[str, Array]) -> Array:
    """Return the Haar coefficients of what a drawn noise of these drivers moves."""
    runs, rng = weigher.train, np.random.default_rng(0)
    added: list[dict[str, Array]] = [{} for _ in runs.stretches]
    for name, of_levels in sizes.items():
        for each, stretch in zip(added, runs.stretches, strict=True):
            each[name] = draw_noise(len(stretch.inputs[name]), of_levels, rng)
    values = {**weigher.base, **m.values}
    moved = runs.with_added(added).simulate(values, COARSE_STEP_S)
    return to_haar(runs.fill_masked(moved - runs.simulate(values, COARSE_STEP_S)))


def _bound(weigher: Weigher, passed: Array, left: Array) -> Array:
    """Return the largest share with which noise stays below what is left, at every time scale.

    Slow scales of few coefficients are one.
    """
    like = weigher.like
    few = np.flatnonzero((like.counts < FEWEST).any(axis=0))
    group = np.minimum(like.level, few.min(initial=like.n_levels))
    squares = (np.where(like.keep, d * d, 0.0).sum(axis=1) for d in (left, passed))
    of_left, of_passed = (np.stack([np.bincount(group, s) for s in rows]) for rows in squares)
    is_any = of_passed > 0.0
    shares = np.where(is_any, of_left / np.where(is_any, of_passed, 1.0), np.inf)
    return np.asarray(shares.min(axis=1))


def estimate_sizes(columns: Sequence[Array], block: int, stated: float | None = None) -> Array:
    """Return the noise's deviation at each Haar level of a block, the finest first.

    A stated deviation is that of the finest level; the others are in proportion.
    """
    found: list[float] = []
    for level in range(int(levels_of(block)[-1])):
        size = _estimate_size(columns, 1 << level)
        if size is None:
            break
        found.append(size)
    step = min(map(find_resolution, columns)) / sqrt(12.0)
    sizes = np.maximum(found or [0.0], step)
    sizes = np.minimum(sizes, MOST_COLOUR * sizes[0])
    if stated is not None:
        sizes = np.maximum(sizes * (stated / sizes[0]), step)
    return np.asarray(sizes)


def _estimate_size(columns: Sequence[Array], many: int) -> float | None:
    """Return the deviation of means over so many samples, as that of white noise of one sample.

    It is None where no record is long enough, or the quietest moves.
    """
    pairs = []
    for column in columns:
        means = column[: len(column) // many * many].reshape(-1, many).mean(axis=1)
        if len(means) >= FEWEST + ORDER + 1:
            pairs.append([_size_by_differences(means, n) for n in (ORDER, ORDER + 1)])
    size, finer = min(pairs, default=[np.nan, np.nan])
    moves = many > 1 and size > MOVES * finer
    return None if moves or not np.isfinite(size) else sqrt(many) * size


def _size_by_differences(means: Array, order: int) -> float:
    typical = np.median(np.abs(np.diff(means, order)))
    return float(typical) / (MEDIAN * sqrt(comb(2 * order, order)))


def draw_noise(count: int, sizes: Array, rng: np.random.Generator) -> Array:
    """Return noise with these deviations at its Haar levels; slower ones have the last."""
    levels = max(count - 1, 1).bit_length()
    of_level = np.append(sizes, np.repeat(sizes[-1], max(levels + 1 - len(sizes), 0)))
    size = 1 << levels
    return from_haar(of_level[levels_of(size)] * rng.standard_normal(size))[:count]
