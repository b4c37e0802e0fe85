"""What was named in one block stays named when a term describes the other."""

from __future__ import annotations

import pytest
from support.made_records import all_but, pair

from pamctl.diagnose import diagnose
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.plant.model import PlantSettings

pytestmark = pytest.mark.long


def test_a_drooping_supply_stays_named_beside_a_term_of_the_mechanics() -> None:
    hidden = {
        "supply_droop__resistance_pa_s_per_kg": 2e7,
        "spring_hysteresis__force_n": 2.5,
        "spring_hysteresis__way_m": 1.5e-3,
    }
    train, held = pair(**hidden)
    few = all_but("supply_droop", "chamber_leak")
    document = build_diagnosis_document(diagnose(train, held, PlantSettings(), without=few))
    (effect,) = document["effects"]
    assert effect["name"] == "supply_droop"
    droop = effect["parameters"]["resistance_pa_s_per_kg"]
    assert droop["value"] == pytest.approx(2e7, rel=0.05)
    assert "supply droop" in document["sentence"]
    (term,) = document["terms"]
    assert (term["location"], term["operator"]) == ("force", "hysteresis")
    assert document["explained"] > 0.9
