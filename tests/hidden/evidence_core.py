"""`pamctl.diagnose.evidence` before the list of `scripts/score_diagnosis.py`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hidden.rungs import Said, Where
from hidden.score_list import Handed
from pamctl.diagnose.evidence import weigh_evidence
from pamctl.diagnose.evidence.ladder import Finding
from pamctl.diagnose.evidence.pool import Hypothesis
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.model import PlantSettings

PLACES = {"air": "chamber", "pull": "force"}
KINDS = {"lag": "lag", "memory": "memory"}
NUMBERS = {
    "valve": "valve_v", "supply": "supply", "air": "volume", "friction": "friction",
    "pull": "stiffness", "pressure_sensor": "pressure_pa", "encoder": "position_m",
}  # fmt: skip


def where_at(place: str, kind: str) -> Where:
    """Return a place and a kind in the words of the list."""
    in_time = "time" in kind or kind == "onset"
    return PLACES.get(place, place), KINDS.get(kind, "time" if in_time else "curve")


def word_of(h: Hypothesis) -> str:
    """Return the name of an effect or a fault, or that of a finding of the same place and kind."""
    if h.setup is not None:
        return ".".join(h.setup)
    if h.family in CATALOGUE:
        return h.family
    found = {"lag": "skew", "time": "drift"}.get(where_at(h.place, h.kind)[1], "curve")
    return f"{found}.{NUMBERS[h.place]}"


def diagnose_case(records: Handed, plant: Mapping[str, Any]) -> Said:
    """Return what the evidence says of a case."""
    train, held_out = records
    verdict = weigh_evidence(train, held_out, PlantSettings.model_validate(plant))
    names, sets, places, numbers = set(), [], set(), {}
    for rung in verdict.findings:
        word = word_of(rung.hypothesis)
        if rung.level == "name":
            names.add(word)
            numbers |= {n.name: (n.value, n.low, n.high) for n in rung.numbers}
        elif rung.level == "kind":
            places.add(where_at(rung.hypothesis.place, rung.hypothesis.kind))
        elif rung.level == "place":
            places.add((PLACES.get(rung.hypothesis.place, rung.hypothesis.place), ""))
        elif rung.level == "set":
            sets.append(_make_set(rung, word))
    return Said(frozenset(names), tuple(sets), frozenset(places), numbers)


def _make_set(rung: Finding, word: str) -> frozenset[str]:
    return frozenset({word, *(word_of(r) for r in rung.rivals)})
