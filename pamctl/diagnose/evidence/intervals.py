"""How well the numbers of a fitted model are known: intervals from stretches that are left out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from pamctl.diagnose.evidence.constants import NUGGET, STRETCH
from pamctl.diagnose.evidence.fit import Array, WeighedModel, Weigher
from pamctl.plant.terms import KNOTS

Intervals = Mapping[str, tuple[float, float]]
"""Of each number its low and its high end."""
LEAST_LEFT = 1e-3
"""Of a stretch that is left out: what it alone shows stays finite."""
MADE_UP = 0.01
"""Share of an own number's tangent that a curve leaves, below which the curve holds the number."""


def find_intervals(weigher: Weigher, m: WeighedModel) -> dict[str, tuple[float, float]]:
    """Return a 90 % interval of each number: each stretch of blocks left out (a jackknife).

    What a stretch moves is known to first order by its score, under the model's own floor. A
    number is somewhere in its range: that bounds what no sample shows. The error of a sensor's
    step stays the same while a signal rests: each block may be off by it. What is left above
    the noise is a law, which may be alike in each stretch: all noise, the stretches count; all
    law, they are worth one. The knots of a curve are those beside the plant's own number that
    does as well as a part of it: the two together are known, and the number alone is not.
    """
    if not np.array_equal(m.tangent_at, m.x):
        m.tangent = None
    tangent, (channels, n_blocks, block) = weigher.find_tangent(m), m.d.shape
    least2 = weigher.like.least2
    own2 = np.maximum(least2, NUGGET**2 * weigher.like.mean_squares(m.d))
    split = tangent.reshape(len(m.x), channels, n_blocks, block)
    weighed = split * weigher.like(m.d, own2).weights
    by_block = np.einsum("icbk,jcbk->bij", weighed, split)
    scores = np.einsum("icbk,cbk->bi", weighed, m.d)
    steps = (weighed[..., -1] * np.sqrt(block * least2)[:, None]).reshape(len(m.x), -1)
    wide = np.array([(n.high - n.low) / n.scale for n in m.numbers])
    begins = np.arange(0, n_blocks, max(1, min(STRETCH, n_blocks // 4)))
    worth = 1.0 + (len(begins) - 1) * find_law_share(weigher, m)
    times = float(stdtrit(max(len(begins) - 1, 1), 0.95))

    def spread(free: NDArray[np.intp]) -> Array:
        """Return the half widths of these numbers, all others held, in scales."""
        hessian = by_block[:, free][:, :, free].sum(axis=0) + np.diag(12.0 / wide[free] ** 2)
        inverse = np.linalg.inv(hessian)
        pieces = np.add.reduceat(by_block[:, free][:, :, free], begins, axis=0)
        pulls = np.add.reduceat(scores[:, free], begins, axis=0)
        moves = np.linalg.solve(hessian - (1.0 - LEAST_LEFT) * pieces, pulls[..., None])
        variance = worth * (moves[..., 0] ** 2).sum(axis=0)
        variance += ((inverse @ steps[free]) ** 2).sum(axis=1)
        return np.asarray(times * np.sqrt(np.maximum(variance, np.diag(inverse))))

    off = spread(np.arange(len(m.x)))
    for knots, free in _list_curves(m, by_block.sum(axis=0)):
        off[knots] = spread(free)[np.searchsorted(free, knots)]
    off *= [n.scale for n in m.numbers]
    return {
        n.name: (float(v - w), float(v + w)) for n, v, w in zip(m.numbers, m.x, off, strict=True)
    }


def widen_intervals(
    intervals: Intervals, m: WeighedModel, instead: Sequence[WeighedModel]
) -> Intervals:
    """Return intervals that reach to where each number is in models that may be true instead.

    What the data do not tell apart moves the numbers of what is sure: a leak and a valve keep their
    ratio, and both go with the volume of the air, which a mending law may take up.
    """
    wide = {}
    for name, (low, high) in intervals.items():
        values = [m.values[name], *(e.values[name] for e in instead if name in e.values)]
        wide[name] = low + min(values) - values[0], high + max(values) - values[0]
    return wide


def find_law_share(weigher: Weigher, m: WeighedModel) -> float:
    """Return the share of what a model leaves that no noise makes, in the worst channel.

    Here moments count in which a valve switches, which leave much and are few. Slow noise may be
    alike in stretches, too.
    """
    noise2 = weigher.find_noise2(m) - weigher.slow_noise2
    left2 = weigher.like.mean_squares(m.d) / noise2
    return max(1.0 - 1.0 / float(left2.max()), 0.0)


def _list_curves(
    m: WeighedModel, products: Array
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Yield the places of each curve's knots, and those of all numbers that it does not hold too.

    `products` are the weighed products of the tangents, shape (numbers, numbers). A curve holds an
    own number whose tangent its knots make up but for a hundredth.
    """
    places = {n.name: i for i, n in enumerate(m.numbers)}
    named = [places[u.name] for variant in m.picked.values() for u in variant.free]
    for first in (n.name for n in m.numbers if n.name.endswith(".knot_1")):
        knots = np.array([places[f"{first[:-1]}{k}"] for k in range(1, KNOTS + 1)])
        inside = products[np.ix_(knots, knots)] + np.diag(1e-9 * products.diagonal()[knots])
        shares = np.linalg.lstsq(inside, products[knots])[0]  # no sample may show a knot
        made = np.einsum("ik,ki->i", products[:, knots], shares)
        is_free = products.diagonal() - made > MADE_UP * products.diagonal()
        is_free[[*named, *knots]] = True
        yield knots, np.flatnonzero(is_free)
