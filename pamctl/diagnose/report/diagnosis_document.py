"""`diagnosis.json`, schema 1: the diagnosis for programs. Keys are added, never changed."""

from __future__ import annotations

from typing import Any

from pamctl.diagnose.diagnosis import Diagnosis, find_largest_remainder
from pamctl.diagnose.fitting.floor import doubt_floor
from pamctl.diagnose.fitting.integrator import SMALL
from pamctl.diagnose.naming.rivals import Standing
from pamctl.diagnose.naming.unseen import list_unseen
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.report.next_experiment import (
    choose_next_experiment,
    list_blind_spots,
)
from pamctl.diagnose.report.phrases import list_equal_sets, numbers_of
from pamctl.diagnose.report.term_phrases import list_lead_entries, list_term_entries
from pamctl.diagnose.report.verdict_words import sentence
from pamctl.diagnose.setup.symmetries import list_equal_numbers
from pamctl.plant.catalogue import CATALOGUE

SCHEMA = 1


def build_diagnosis_document(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the document as plain values."""
    if diagnosis.verdict is Verdict.BAD_DATA:
        return {
            "schema": SCHEMA,
            "verdict": diagnosis.verdict.value,
            "reason": diagnosis.reason,
            "sentence": sentence(diagnosis),
            "setup": [finding.as_dict() for finding in diagnosis.setup],
            "effects": [],
            "terms": [],
            "ambiguous": [],
            "recalibrated": {},
            "blind_spots": [],
            "next_experiment": None,
            "forecasts": [],
            "gap": {},
            "unexplained": None,
            "accepted": [],
            "noise": {},
        }
    block, ratio, regimes = find_largest_remainder(diagnosis)
    return {
        "schema": SCHEMA,
        "verdict": diagnosis.verdict.value,
        "sentence": sentence(diagnosis),
        "setup": [finding.as_dict() for finding in diagnosis.setup],
        "equal_numbers": [
            [*names]
            for names in list_equal_numbers(diagnosis.nominal)
            if {*names} & {n.name for n in diagnosis.recalibrated}
        ],
        "effects": [_effect_entry(diagnosis, s) for s in diagnosis.standings],
        "terms": list_term_entries(diagnosis),
        "leads": list_lead_entries(diagnosis),
        "ambiguous": list_equal_sets(diagnosis),
        "recalibrated": {n.name: n.as_dict() for n in diagnosis.recalibrated},
        "blind_spots": list_blind_spots(diagnosis),
        "next_experiment": choose_next_experiment(diagnosis),
        "forecasts": [judged.as_dict() for judged in diagnosis.forecasts],
        "gap": {name: gap.as_dict() for name, gap in (diagnosis.gap or {}).items()},
        "explained": diagnosis.explained,
        "explained_by_block": dict(diagnosis.explained_by_block),
        "confirmed_on": diagnosis.confirmed_on.as_dict() if diagnosis.confirmed_on else None,
        "residual_signs": [sign.as_dict() for sign in diagnosis.signs],
        "at_bound": [*diagnosis.at_bound],
        "not_shown": [*list_unseen(diagnosis.model)] if diagnosis.model else [],
        "unexplained": {"block": block, "residual_over_floor": ratio, "where": regimes},
        "limits": _list_limits(diagnosis),
        "judge": _list_judges(diagnosis),
        "accepted": [doubt.as_dict() for doubt in diagnosis.accepted],
        "noise": {name: about.as_dict(name) for name, about in diagnosis.noise.items()},
        "integrator": {
            block: {"change_over_floor": change, "is_small": change <= SMALL}
            for block, change in diagnosis.substep_changes.items()
        },
        "correction": diagnosis.remainder.as_dict() if diagnosis.remainder else None,
        "regimes": [
            {
                "block": c.block,
                "regime": c.regime,
                "share": c.share,
                "residual_over_floor": c.residual_over_floor,
                "p_value": c.p_value,
                "stands_out": c.stands_out,
            }
            for c in diagnosis.misfits
        ],
    }


def _list_limits(diagnosis: Diagnosis) -> dict[str, dict[str, Any]]:
    """Return the limit of each block, what sets it, and whether it may be wrong."""
    floors = diagnosis.model.floors if diagnosis.model else {}
    return {
        block: {
            "limit_over_floor": f.limit / f.mean,
            "decided_by": f.decided_by,
            "is_estimate": f.is_estimate,
            "doubt": doubt_floor(block, diagnosis.model.ratio(block) if diagnosis.model else 0.0),
        }
        for block, f in floors.items()
    }


def _list_judges(diagnosis: Diagnosis) -> dict[str, dict[str, Any]]:
    """Return how each block was judged: free run, windows or equation, with the horizon."""
    judges = diagnosis.model.evidence.judge if diagnosis.model else {}
    return {block: judge.as_dict() for block, judge in judges.items()}


def _effect_entry(diagnosis: Diagnosis, standing: Standing) -> dict[str, Any]:
    name = standing.effect.name
    return {
        "name": name,
        "block": CATALOGUE[name].block,
        "form": standing.effect.form,
        "parameters": {n.name.split(".")[1]: n.as_dict() for n in numbers_of(diagnosis, name)},
        "rivals": [
            {"name": r.name, "residual_over_floor": r.residual_over_floor} for r in standing.rivals
        ],
        "confidence": standing.confidence,
    }
