"""The search: what was fitted for one block before is not fitted again."""

from __future__ import annotations

import pytest
from support.made_records import all_but, pair

from pamctl.diagnose.fitting.candidates import list_candidates
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE
from pamctl.diagnose.fitting.evidence import prepare_evidence
from pamctl.diagnose.fitting.model_fit import recalibrate
from pamctl.diagnose.naming import search as searching
from pamctl.diagnose.naming.search import search_effects
from pamctl.plant.model import PlantSettings


def test_models_of_the_pressure_block_alone_serve_both_blocks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    evidence = prepare_evidence(*pair(valve_asymmetry__exhaust_gain=0.8), PlantSettings())
    candidates = list_candidates(evidence, all_but("valve_curve", "valve_leak"))
    alone = recalibrate(evidence.select_blocks({PRESSURE}))
    known = search_effects(alone, candidates).models
    both = recalibrate(evidence, alone.fits)
    fitted = []
    monkeypatch.setattr(
        searching,
        "run_fit_jobs",
        lambda work, jobs, executor, progress=None: fitted.extend(jobs) or [],
    )
    found = search_effects(both, candidates, known=[m for m in known if len(m.effects) == 1])
    (first, *_) = found.levels
    assert {m.names for m in first} == {("valve_curve",), ("valve_leak",)}
    assert all(len(job.model.effects) == 1 for job in fitted if hasattr(job, "score"))
    for model in first:
        assert model.fit_of(MECHANICS) is both.fit_of(MECHANICS)
        assert model.rms[MECHANICS] == both.rms[MECHANICS]
