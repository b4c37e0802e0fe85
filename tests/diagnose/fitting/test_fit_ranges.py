"""Recalibration from far guesses, and ranges that end where a plant file's own limits do."""

from __future__ import annotations

import numpy as np
import pytest
from support.free_mass import axis, pushed_mass
from support.made_records import pair

from pamctl.descent import Descent, DescentEnd
from pamctl.diagnose.fitting import block_fit
from pamctl.diagnose.fitting.block_fit import FULL, QUICK, Fit, fit_numbers, limit_to_plant, rms
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE, stack_residuals
from pamctl.diagnose.fitting.evidence import prepare_evidence
from pamctl.diagnose.fitting.far_starts import is_far, search_starts
from pamctl.diagnose.fitting.model_fit import recalibrate
from pamctl.diagnose.fitting.numbers import FreeNumber, with_values
from pamctl.diagnose.measured.record import Array
from pamctl.plant.model import PlantSettings

PAPER = PlantSettings()
GAIN = "valve_gain_m2_per_v"
STIFF, DAMPING = "stiffness_n_per_m", "damping_n_s_per_m"


def widely(name: str, value: float, factor: float = 30.0) -> FreeNumber:
    return FreeNumber(name, value / factor, value * factor, 0.01 * value)


@pytest.mark.parametrize("off", [0.3, 3.0])
def test_a_number_that_spans_decades_is_found_from_three_times_off(off: float) -> None:
    drives = prepare_evidence(*pair(), PAPER).train[PRESSURE]
    guess = off * PAPER.parameters.valve_gain_m2_per_v
    found = fit_numbers(drives, with_values(PAPER, {GAIN: guess}), [widely(GAIN, guess)])
    assert found.values[GAIN] == pytest.approx(PAPER.parameters.valve_gain_m2_per_v, rel=0.01)
    assert found.at_bound == ()


def test_stiffness_and_damping_of_a_muscle_are_found_from_three_times_off() -> None:
    drives = prepare_evidence(*pair(), PAPER).train[MECHANICS]
    p = PAPER.parameters
    guess = {STIFF: 3.0 * p.stiffness_n_per_m, DAMPING: 0.33 * p.damping_n_s_per_m}
    free = [widely(name, value) for name, value in guess.items()]
    found = fit_numbers(drives, with_values(PAPER, guess), free)
    assert found.values[STIFF] == pytest.approx(p.stiffness_n_per_m, rel=0.02)
    assert found.values[DAMPING] == pytest.approx(p.damping_n_s_per_m, rel=0.05)


def test_the_bounds_of_a_wide_range_are_near_by_ratio() -> None:
    """A tenth of a guess is no bound of a range that goes to a thousandth."""
    free = (FreeNumber(DAMPING, 0.57, 5.7e5, 5.7),)
    inside = Fit(with_values(PAPER, {DAMPING: 57.0}), free, (), np.zeros(0))
    at_end = Fit(with_values(PAPER, {DAMPING: 0.5701}), free, (), np.zeros(0))
    assert inside.at_bound == ()
    assert at_end.at_bound == (DAMPING,)


def test_a_fit_goes_on_while_it_gains_and_stops_where_it_does_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Rounds of evaluations that halve the cost are repeated; one that gains nothing is the last"""
    costs = iter([1000.0, 500.0, 250.0, 249.5, 0.0])

    def descend_some(
        residual_at: object, jacobian_at: object, start: Array, *bounds: Array, **options: object
    ) -> Descent:
        return Descent(start, next(costs), DescentEnd.EVALUATIONS)

    monkeypatch.setattr(block_fit, "descend", descend_some)
    monkeypatch.setattr(block_fit, "coarsen", lambda drives, *plants, **free: drives)
    drives = prepare_evidence(*pair(), PAPER).train[PRESSURE]
    fit_numbers(drives, PAPER, [widely(GAIN, 1e-6)], FULL)
    assert next(costs) == 0.0
    costs = iter([1000.0, 500.0])
    fit_numbers(drives, PAPER, [widely(GAIN, 1e-6)], QUICK)
    assert next(costs) == 500.0


def test_ranges_end_at_the_limits_of_a_plant_file() -> None:
    """A dry friction of 35 N, and a braid that is hardly longer than the rest length."""
    near = with_values(PAPER, {"braid_length_m": 0.2012})
    free = [
        FreeNumber("braid_length_m", 0.1992, 0.2032, 2e-4),
        FreeNumber("coulomb_friction.force_n", -5.0, 1e9, 0.1),
        FreeNumber(STIFF, 5e3, 2e4, 100.0),
    ]
    braid, dry, spring = limit_to_plant(free, near)
    assert braid.low == pytest.approx(0.200, abs=1e-9)
    assert braid.high == 0.2032
    assert dry.low == pytest.approx(0.0, abs=1e-9)
    assert spring == free[2]
    for number in (braid, dry):
        for end in (number.low, number.high):
            with_values(near, {number.name: end})


def test_a_muscle_whose_braid_is_hardly_longer_than_its_rest_length_is_fitted() -> None:
    near = with_values(PAPER, {"braid_length_m": 0.2012})
    model = recalibrate(prepare_evidence(*pair(), near))
    assert all(np.isfinite(model.rms[block]) for block in model.evidence.blocks)


def test_a_direct_plant_with_much_dry_friction_is_fitted() -> None:
    start = axis(coulomb_friction={"force_n": 35.0})
    model = recalibrate(prepare_evidence([pushed_mass(1)], [pushed_mass(2)], start))
    values = model.fit_of(MECHANICS).values
    assert values["coulomb_friction.force_n"] == pytest.approx(20.39, rel=0.03)


def test_a_fit_in_a_wrong_valley_is_repeated_from_other_starts() -> None:
    """Stiffness ten times too high: the fit may move the damping only, so it ends far off."""
    drives = prepare_evidence(*pair(), PAPER).train[MECHANICS]
    p = PAPER.parameters
    free = tuple(widely(n, getattr(p, n)) for n in (STIFF, DAMPING))
    wrong = with_values(PAPER, {STIFF: 10.0 * p.stiffness_n_per_m, DAMPING: 57.0})
    ended = Fit(wrong, free, drives, stack_residuals(drives, wrong))
    assert is_far(ended)
    found = search_starts(ended)
    assert found.values[STIFF] == pytest.approx(p.stiffness_n_per_m, rel=0.02)
    assert rms(found.residual) < 0.05 * rms(ended.residual)
    assert not is_far(found)
    assert search_starts(found) is found
