"""Intervals hold the truth about as often as stated, and include the integrator's error."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from support.made_records import measured, pair

from pamctl.diagnose.fitting.candidates import list_candidates
from pamctl.diagnose.fitting.evidence import prepare_evidence
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.integrator import SMALL, compare_substeps
from pamctl.diagnose.fitting.intervals import FittedNumber, estimate_intervals
from pamctl.diagnose.fitting.model_fit import fit_model, recalibrate
from pamctl.diagnose.report.phrases import describe_substeps
from pamctl.plant.flat import PAPER
from pamctl.plant.model import PlantSettings

STICKY = {"stribeck.rise": 0.3, "stribeck.speed_m_per_s": 0.0075}
"""Friction that falls so steeply with speed that the muscle moves in jumps."""


@cache
def sticky() -> Model:
    """The true structure fitted to a rig with steep friction, simulated in much finer steps."""
    train, held = pair(**{name.replace(".", "__"): value for name, value in STICKY.items()})
    evidence = prepare_evidence(train, held, PlantSettings())
    form = next(
        c for c in list_candidates(evidence) if (c.name, c.form) == ("stribeck", "Gaussian")
    )
    return fit_model(recalibrate(evidence), (form,), [STICKY])


def of(model: Model) -> dict[str, FittedNumber]:
    """Return the fitted numbers by name."""
    return {number.name: number for number in estimate_intervals(model)}


def test_intervals_of_calibrated_numbers_hold_the_truth_about_as_often_as_stated() -> None:
    inside = []
    for seed in range(6):
        off = {"stiffness_n_per_m": 9400.0 + 90.0 * seed, "damping_n_s_per_m": 560.0}
        train, held = [measured("fit", 20 + seed, **off)], [measured("judge", 70 + seed, **off)]
        found = of(recalibrate(prepare_evidence(train, held, PlantSettings())))
        inside += [found[n].low <= (PAPER | off)[n] <= found[n].high for n in found]
    assert len(inside) == 36
    assert np.mean(inside) > 0.75  # 90 %, less two standard errors of six rigs


def test_an_interval_counts_the_scatter_of_few_replicas() -> None:
    train, held = pair()
    model = recalibrate(prepare_evidence(train, held, PlantSettings()))
    fitted, floor = model.fit_of("pressure"), model.floors["pressure"]
    place = [f.name for f in fitted.free].index("tank_pressure_pa")
    number = of(model)["tank_pressure_pa"]
    half = 0.5 * (number.high - number.low) / fitted.free[place].scale
    assert len(floor.shifts) == 12
    # Student's t of 11 degrees at 95 % is 1.796; of a next draw, not of the mean.
    assert half >= 1.796 * np.sqrt(13 / 12) * floor.shifts[:, place].std(ddof=1)


def test_half_the_sub_step_hardly_changes_the_papers_muscle() -> None:
    train, held = pair()
    found = compare_substeps(recalibrate(prepare_evidence(train, held, PlantSettings())))
    assert set(found) == {"pressure", "mechanics"}
    assert max(found.values()) < SMALL
    assert describe_substeps(found) == ""


def test_an_integrator_too_coarse_for_steep_friction_is_reported() -> None:
    found = compare_substeps(sticky())
    assert found["mechanics"] > SMALL
    said = describe_substeps(found)
    assert "mechanics by" in said
    assert "pressure" not in said


@pytest.mark.parametrize("name", STICKY)
def test_intervals_include_the_error_of_a_coarse_integrator(name: str) -> None:
    number = of(sticky())[name]
    assert number.low <= STICKY[name] <= number.high
    assert number.high - number.low < 0.25 * STICKY[name]
