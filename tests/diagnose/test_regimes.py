"""The table of regimes marks what stands out; noise stands out no more often than stated."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import kstest
from support.made_records import measured, pair

from pamctl.diagnose.fitting.evidence import prepare_evidence
from pamctl.diagnose.fitting.model_fit import recalibrate
from pamctl.diagnose.locate import (
    EVENLY,
    NULL_V,
    RegimeMisfit,
    describe_worst_regimes,
    exceedance,
    find_regimes,
    flag_discoveries,
    locate_misfits,
)
from pamctl.plant.model import PlantSettings

THROMBOLYSIS = (0.0001, 0.0004, 0.0019, 0.0095, 0.0201, 0.0278, 0.0298, 0.0344, 0.0459,
                0.3240, 0.4262, 0.5719, 0.6528, 0.7590, 1.0000)  # fmt: skip
"""Benjamini and Hochberg's own example (1995): four are found, where Bonferroni finds three."""


def test_the_step_up_finds_what_benjamini_and_hochberg_found() -> None:
    assert flag_discoveries(THROMBOLYSIS, 0.05).tolist() == [True] * 4 + [False] * 11


def test_the_step_up_looks_from_the_largest_down() -> None:
    # Alone, each must be below 0.025. Together, both may be up to 0.05.
    assert flag_discoveries([0.04, 0.045], 0.05).all()
    assert not flag_discoveries([0.04, 0.06], 0.05).any()
    assert len(flag_discoveries([], 0.05)) == 0


def test_in_pure_noise_something_is_found_as_often_as_the_rate_says() -> None:
    sets = np.random.default_rng(3).random((4000, 18))
    found = np.mean([flag_discoveries(p, 0.05).any() for p in sets])
    assert found == pytest.approx(0.05, abs=3.0 * np.sqrt(0.05 * 0.95 / 4000))


def test_the_share_of_false_findings_is_at_most_the_rate() -> None:
    random = np.random.default_rng(4)
    false = []
    for _ in range(2000):
        p = random.random(20)
        p[:6] *= 1e-3  # six are true
        found = flag_discoveries(p, 0.05)
        false.append(found[6:].sum() / max(found.sum(), 1))
    # In the mean the rate times the share of the noise, 14 of 20.
    assert np.mean(false) == pytest.approx(0.035, abs=0.008)


def test_noise_exceeds_its_replicas_as_often_as_the_p_value_says() -> None:
    random = np.random.default_rng(5)
    # Mean squares of 400 samples: near lognormal.
    levels = random.chisquare(400, (1500, 13)) / 400
    chances = [exceedance(float(row[0]), row[1:]) for row in levels]
    assert kstest(chances, "uniform").pvalue > 0.01


def test_a_level_too_small_to_matter_never_stands_out() -> None:
    assert exceedance(-0.1, np.array([1.0, 1.1, 0.9])) == 1.0


def regimes_of(*, seed: int = 0, **hidden: float) -> list[RegimeMisfit]:
    """The regimes after recalibration, with nothing named."""
    train, held = [measured("fit", 10 + seed, **hidden)], [measured("judge", 50 + seed, **hidden)]
    return locate_misfits(recalibrate(prepare_evidence(train, held, PlantSettings())))


def test_where_nothing_is_hidden_no_regime_stands_out() -> None:
    found = [regimes_of(seed=seed, stiffness_n_per_m=9500.0 + 60.0 * seed) for seed in range(6)]
    assert not [c for every in found for c in every if c.stands_out]
    assert describe_worst_regimes(found[0], "pressure") == EVENLY


def test_a_dead_band_stands_out_near_null_and_not_in_the_mechanics() -> None:
    found = regimes_of(
        valve_deadband__fill_width_v=0.1, valve_deadband__exhaust_width_v=0.1
    )  # fmt: skip
    out = {(c.block, c.regime) for c in found if c.stands_out}
    assert ("pressure", "valve near null") in out
    assert {block for block, _ in out} == {"pressure"}
    assert "valve near null" in describe_worst_regimes(found, "pressure")


def test_what_follows_a_step_of_the_command_begins_with_the_step() -> None:
    train, held = pair()
    model = recalibrate(prepare_evidence(train, held, PlantSettings()))
    (drive,) = model.evidence.holdout["pressure"]
    after = find_regimes(drive, model)["within 10 ms of a step of the command"]
    steps = np.flatnonzero(np.abs(np.diff(drive.valve_v)) > NULL_V) + 1
    lonely = [k for k in steps if not np.any((steps > k - 30) & (steps < k + 30) & (steps != k))]
    assert lonely
    for k in lonely:
        assert np.flatnonzero(after[k - 15 : k + 15]).tolist() == [*range(15, 25)]


def test_a_regime_has_a_floor_of_its_own() -> None:
    train, held = pair()
    model = recalibrate(prepare_evidence(train, held, PlantSettings()))
    ratios = [c.residual_over_floor for c in locate_misfits(model) if c.block == "mechanics"]
    assert max(ratios) < 1.5
