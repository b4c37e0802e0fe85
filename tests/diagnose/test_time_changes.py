"""Numbers that change with time, where little or much is left of the data."""

from __future__ import annotations

import pytest
from hidden.hostile.situations import HostileCase, all_cases
from hidden.hostile.trial import records_of

from pamctl.diagnose import Record
from pamctl.diagnose.fitting.drives import PRESSURE
from pamctl.diagnose.fitting.evidence import prepare_evidence
from pamctl.diagnose.fitting.model_fit import recalibrate
from pamctl.diagnose.setup.suspects import OF_RECORD
from pamctl.diagnose.setup.time_changes import fit_time_changes
from pamctl.diagnose.setup.weighed_fit import SuspectFit
from pamctl.plant.model import PlantSettings


def _fit_changes(case: HostileCase) -> list[SuspectFit]:
    """Return the fitted changes of the pressure block, the best first."""
    train, holdout = ([Record(r.name, **r.columns()) for r in part] for part in records_of(case))
    evidence = prepare_evidence(train, holdout, PlantSettings())
    base = recalibrate(evidence.select_blocks({PRESSURE}))
    assert base.unexplained == (PRESSURE,)
    return sorted(fit_time_changes(base, {PRESSURE: 0.0}), key=lambda f: f.ratio(PRESSURE))


CASES = {case.id: case for case in all_cases()}


@pytest.mark.long
def test_a_small_drift_near_the_floor_is_fitted() -> None:
    """It leaves 1.2 times the floor: most of that square is noise, which nothing explains."""
    best, *_ = _fit_changes(CASES["valve_gain_within/small/random"])
    assert best.suspect.number == "valve_gain_m2_per_v"
    assert best.suspect.kind == "drift"
    assert best.amount == pytest.approx(-0.02, abs=1e-3)
    assert best.is_good


@pytest.mark.long
def test_a_change_at_half_of_records_of_unlike_length_is_a_share_of_each() -> None:
    best, *_ = _fit_changes(CASES["leak_from_half/small/random"])
    assert best.suspect.kind == "change_at_instant"
    assert best.suspect.variant == OF_RECORD
    assert best.suspect.after_s == pytest.approx(0.5, abs=0.02)
    assert best.amount == pytest.approx(1e-8, rel=0.1)
