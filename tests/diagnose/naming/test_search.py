"""The search: what was fitted for one block before is not fitted again."""

from __future__ import annotations

import pytest
from support.made_records import all_but, pair

from pamctl.diagnose import Record
from pamctl.diagnose.fitting.block_fit import FULL
from pamctl.diagnose.fitting.candidates import list_candidates
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE
from pamctl.diagnose.fitting.evidence import prepare_evidence
from pamctl.diagnose.fitting.model_fit import fit_model, recalibrate
from pamctl.diagnose.naming import search as searching
from pamctl.diagnose.naming.first_level import FirstLevel
from pamctl.diagnose.naming.search import search_effects, simplify_first
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


def test_a_form_that_was_needed_only_before_the_next_effect_came_is_made_simple() -> None:
    """One tank is two tanks of which one is empty, with a tenth of the other's refill time."""
    records = pair(
        chamber_leak__area_m2=1.6e-8,
        supply_droop__resistance_pa_s_per_kg=9e6,
        supply_droop__refill_time_s=0.1,
    )
    evidence = prepare_evidence(*records, PlantSettings()).select_blocks({PRESSURE})
    candidates = list_candidates(evidence, all_but("chamber_leak", "supply_droop"))
    effects = tuple(c for c in candidates if c.form in ("chamber_leak", "two tanks"))
    empty = {
        "chamber_leak.area_m2": 1e-8,
        "supply_droop.resistance_pa_s_per_kg": 8e6,
        "supply_droop.refill_time_s": 1.1,
        "supply_droop.fast_share": 1.0,
    }
    rich = fit_model(recalibrate(evidence), effects, [empty], effort=FULL)
    assert rich.is_complete
    assert rich.effect_values["supply_droop.refill_time_s"] == pytest.approx(1.0, rel=0.05)
    (simple, *_) = simplify_first([rich], candidates)
    assert simple.is_complete
    assert {e.form for e in simple.effects} == {"chamber_leak", "finite tank"}
    assert simple.effect_values["supply_droop.refill_time_s"] == pytest.approx(0.1, rel=0.05)


def test_a_fit_returns_from_numbers_that_a_missing_effect_drove_to_an_end() -> None:
    """Without a position the braid's length hides a slow spool, in a valley of its own."""
    records = pair(valve_spool__time_constant_s=2.15e-3, valve_spool__damping_ratio=0.62)
    blind = [
        [Record(r.name, r.t_s, valve_v=r["valve_v"], pressure_pa=r["pressure_pa"]) for r in part]
        for part in records
    ]
    evidence = prepare_evidence(*blind, PlantSettings())
    base = recalibrate(evidence)
    assert "braid_length_m" in base.at_bound
    (spool,) = FirstLevel(list_candidates(evidence, all_but("valve_spool"))).fit(base)
    assert spool.is_complete
    assert spool.effect_values["valve_spool.time_constant_s"] == pytest.approx(2.15e-3, rel=0.02)
