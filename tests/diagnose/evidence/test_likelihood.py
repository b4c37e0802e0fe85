"""The transform is orthonormal, and the likelihood is that of Student's t."""

import numpy as np
from scipy.stats import t as student

from pamctl.diagnose.evidence.constants import NU
from pamctl.diagnose.evidence.fit import find_optimism
from pamctl.diagnose.evidence.likelihood import Likelihood, from_haar, levels_of, to_haar


def make_likelihood(blocks: int, size: int = 128, channels: int = 1) -> Likelihood:
    return Likelihood(np.ones((channels, blocks, size), dtype=bool), np.full(channels, 1e-12))


def test_the_transform_is_orthonormal_and_is_undone():
    matrix = to_haar(np.eye(128))
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(128), atol=1e-12)
    np.testing.assert_allclose(from_haar(matrix), np.eye(128), atol=1e-12)


def test_a_constant_is_in_the_mean_alone():
    coefficients = to_haar(np.full(128, 3.0))
    np.testing.assert_allclose(coefficients[:-1], 0.0, atol=1e-12)
    assert coefficients[-1] == np.float64(3.0 * 128**0.5).round(12) or np.isclose(
        coefficients[-1], 3.0 * 128**0.5
    )


def test_the_loss_is_minus_the_log_density_of_student_up_to_its_constant():
    rng = np.random.default_rng(1)
    d = rng.normal(size=(1, 6, 128))
    like = make_likelihood(6)
    scales2 = rng.uniform(0.5, 2.0, (1, 8))
    loss = like(d, np.zeros(1), scales2=scales2)
    scale = np.sqrt(scales2[0][levels_of(128)])
    density = student.logpdf(d[0], NU, scale=scale) - student.logpdf(0.0, NU)
    np.testing.assert_allclose(loss.by_block, -density.sum(axis=1), rtol=1e-9)


def test_the_weights_are_the_slope_of_the_loss_over_the_coefficient():
    rng = np.random.default_rng(2)
    d, like, scales2 = rng.normal(size=(1, 2, 128)), make_likelihood(2), np.ones((1, 8))
    loss = like(d, np.zeros(1), scales2=scales2)
    moved = d.copy()
    moved[0, 1, 5] += 1e-6
    slope = (like(moved, np.zeros(1), scales2=scales2).by_block - loss.by_block).sum() / 1e-6
    np.testing.assert_allclose(slope, (loss.weights * d)[0, 1, 5], rtol=1e-4)


def test_where_scales_follow_the_whole_misfit_each_coefficient_counts_by_that_too():
    rng = np.random.default_rng(4)
    d, like = student.rvs(1.5, size=(1, 16, 128), random_state=rng), make_likelihood(16)
    loss, free = like(d, np.zeros(1)), np.zeros(1)
    slopes = like.find_slopes(d, loss, free)
    assert (slopes > loss.weights).all()
    for at in (abs(d).argmax(), 700):
        moved = d.copy()
        moved.flat[at] += 1e-5
        slope = (like(moved, free).by_block - loss.by_block).sum() / 1e-5
        np.testing.assert_allclose(slope, (slopes * d).flat[at], rtol=0.02)


def test_under_a_floor_that_stays_they_count_by_themselves():
    d, like = np.random.default_rng(5).normal(size=(1, 16, 128)), make_likelihood(16)
    loss = like(d, np.ones(1))
    assert like.find_slopes(d, loss, np.ones(1)) is loss.weights


def test_a_scale_is_the_one_that_makes_the_likelihood_largest():
    rng = np.random.default_rng(3)
    d, like = student.rvs(NU, scale=2.0, size=(1, 64, 128), random_state=rng), make_likelihood(64)
    found = like.find_scales2(d, np.zeros(1))
    best = like(d, np.zeros(1), scales2=found).by_block.sum()
    for factor in (0.8, 1.25):
        other = found.copy()
        other[0, 0] *= factor
        assert like(d, np.zeros(1), scales2=other).by_block.sum() > best
    np.testing.assert_allclose(found[0, 0], 4.0, rtol=0.15)


def test_what_is_masked_costs_nothing_and_weighs_nothing():
    rng = np.random.default_rng(4)
    keep = np.ones((1, 4, 128), dtype=bool)
    keep[0, 2] = False
    like, d = Likelihood(keep, np.full(1, 1e-12)), rng.normal(size=(1, 4, 128))
    wild = d.copy()
    wild[0, 2] = 1e6
    calm, upset = (like(x, np.zeros(1)) for x in (d, wild))
    np.testing.assert_allclose(calm.by_block, upset.by_block)
    assert calm.by_block[2] == 0.0
    assert not calm.weights[0, 2].any()


def test_a_left_out_block_costs_what_a_refit_without_it_says():
    """For a straight line under fixed weights the first order is nearly the whole."""
    rng = np.random.default_rng(5)
    blocks, size = 40, 32
    tangent = rng.normal(size=(3, 1, blocks, size))
    y = rng.normal(size=(1, blocks, size))
    flat, right = tangent.reshape(3, -1), y.ravel()
    x = np.linalg.lstsq(flat.T, -right, rcond=None)[0]
    d = (right + x @ flat).reshape(y.shape)
    optimism = find_optimism(tangent, np.ones_like(d), d)
    for b in range(blocks):
        others = np.delete(tangent, b, axis=2).reshape(3, -1)
        refit = np.linalg.lstsq(others.T, -np.delete(y, b, axis=1).ravel(), rcond=None)[0]
        out = y[0, b] + refit @ tangent[:, 0, b]
        real = 0.5 * float(out @ out - d[0, b] @ d[0, b])
        np.testing.assert_allclose(optimism[b], real, rtol=0.5, atol=0.02)
