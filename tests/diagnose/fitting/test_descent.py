"""The descent for few numbers and many samples, beside scipy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from pamctl.descent import DescentEnd, descend
from pamctl.diagnose.measured.record import Array

KNEE = 0.3


class Bent:
    """y = A v + sin(B v), with some numbers cut off by their bounds and outliers in y."""

    def __init__(self, seed: int) -> None:
        random = np.random.default_rng(seed)
        size = int(random.integers(1, 6))
        self.straight = random.normal(size=(400, size))
        self.bent = 0.3 * random.normal(size=(400, size))
        truth = random.normal(size=size)
        self.shown = self.model(truth) + 0.1 * random.standard_t(2, 400)
        self.low, self.high = np.full(size, -1.0), np.full(size, 1.2)
        self.start = random.uniform(-1.0, 1.2, size)
        if seed % 3 == 0:
            self.start[0] = -1.0  # at its bound

    def model(self, v: Array) -> Array:
        return np.asarray(self.straight @ v + np.sin(self.bent @ v))

    def residual(self, v: Array) -> Array:
        return np.asarray(self.model(v) - self.shown)

    def jacobian(self, v: Array) -> Array:
        return np.asarray(self.straight + np.cos(self.bent @ v)[:, None] * self.bent)


@pytest.mark.parametrize("evaluations", [2, 5, 15])
@pytest.mark.parametrize("seed", range(20))
def test_it_takes_the_steps_of_scipys_dogbox(seed: int, evaluations: int) -> None:
    problem = Bent(seed)
    theirs = least_squares(
        problem.residual,
        problem.start,
        problem.jacobian,
        bounds=(problem.low, problem.high),
        method="dogbox",
        loss="soft_l1",
        f_scale=KNEE,
        ftol=1e-6,
        xtol=1e-6,
        gtol=1e-10,
        max_nfev=evaluations,
    )
    ours = descend(
        problem.residual,
        problem.jacobian,
        problem.start,
        problem.low,
        problem.high,
        knee=KNEE,
        tolerance=1e-6,
        evaluations=evaluations,
    )
    np.testing.assert_allclose(ours.vector, theirs.x, atol=1e-9)
    assert ours.cost == pytest.approx(theirs.cost, rel=1e-9)
    assert (ours.ending is DescentEnd.EVALUATIONS) == (theirs.status == 0)


def test_it_asks_for_no_derivatives_where_it_ends() -> None:
    problem, asked = Bent(1), []

    def jacobian(v: Array) -> Array:
        asked.append(v)
        return problem.jacobian(v)

    found = descend(
        problem.residual, jacobian, problem.start, problem.low, problem.high,
        knee=KNEE, tolerance=1e-6, evaluations=15,
    )  # fmt: skip
    assert found.ending is DescentEnd.LEVEL
    assert not any(np.array_equal(v, found.vector) for v in asked)


def test_a_number_without_effect_stays_where_it_is() -> None:
    shown = np.linspace(0.0, 1.0, 50)
    slope = np.column_stack([np.ones(50), np.zeros(50)])
    found = descend(
        lambda v: slope @ v - shown,
        lambda v: slope,
        np.array([0.0, 0.25]),
        np.full(2, -5.0),
        np.full(2, 5.0),
        knee=10.0,
        tolerance=1e-9,
        evaluations=9,
    )
    assert found.vector == pytest.approx([0.5, 0.25], abs=1e-3)
