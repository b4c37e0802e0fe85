"""One step of a fit: beside a range, and along a valley that bends."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from pamctl.diagnose.evidence.paraboloid import LEAST_DAMPING, Paraboloid
from pamctl.diagnose.evidence.pool import Unknown

FREE = 1e6


def stand(x, residual, tangent, high=FREE) -> Paraboloid:
    """Return the cost about `x`; the first number is not above `high`."""
    ends = [high, *[FREE] * (len(x) - 1)]
    numbers = [Unknown(f"n{k}", 0.0, -FREE, end, 1.0) for k, end in enumerate(ends)]
    return Paraboloid(numbers, x, residual, tangent, np.ones_like(residual))


def test_where_a_number_meets_its_range_the_others_go_on_beside_it():
    tangent = np.array([[1.0, 0.9, 0.2], [0.9, 1.0, -0.1]])
    residual = np.array([-3.0, -1.0, 0.5])
    here = stand(np.zeros(2), residual, tangent, high=0.5)
    best = lsq_linear(tangent.T, -residual, ([-3.0, -3.0], [0.5, 3.0])).x
    assert best[0] == pytest.approx(0.5)
    assert here.step(LEAST_DAMPING) == pytest.approx(best, abs=1e-5)


def test_a_step_along_a_bent_valley_gains_when_it_is_bent():
    """Rosenbrock's valley: along y = x^2 a straight step climbs its wall."""

    def find_residual(x):
        return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])

    x = np.array([-0.5, 0.25])
    residual = find_residual(x)
    here = stand(x, residual, np.array([[-20.0 * x[0], -1.0], [10.0, 0.0]]))
    straight = here.step(LEAST_DAMPING)
    off = find_residual(here.move(straight))
    bent = find_residual(here.move(here.bend(straight, off - residual, LEAST_DAMPING)))
    before, walked, found = ((r**2).sum() for r in (residual, off, bent))
    assert walked > before > 1e3 * found
