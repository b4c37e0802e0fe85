"""The questions that the records leave open, and the experiment that would answer more."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from pamctl.diagnose.deciding.deciding_program import DecidingProgram
from pamctl.diagnose.deciding.separation import Separation
from pamctl.diagnose.diagnosis import Diagnosis, Verdict
from pamctl.diagnose.experiments import find_separating_experiment, find_showing_experiment
from pamctl.diagnose.report.finding_words import spell_names
from pamctl.diagnose.report.open_findings import list_ambiguous
from pamctl.diagnose.report.rig_at_hand import advise_experiment, runs_here
from pamctl.plant.catalogue import CATALOGUE
from pamctl.settings.yaml12 import dump_yaml

NEXT_EXPERIMENT = "next-experiment"
"""The name of the program that was chosen; its file is beside the page."""
NEARLY_SEEN = 3.0
"""An effect visible from this many smallest sizes on needs no other experiment."""


def list_blind_spots(diagnosis: Diagnosis) -> list[dict[str, object]]:
    """Return the effects that these records could not have shown."""
    audit = diagnosis.audit
    return [spot.as_dict() for spot in audit.blind_spots] if audit else []


def choose_next_experiment(diagnosis: Diagnosis) -> dict[str, Any] | None:
    """Return the experiment that would answer more, if there is one.

    `do` is the command that runs it, or says what to record on a rig that pamctl does not run.
    """
    if diagnosis.deciding is not None and runs_here(diagnosis):
        run = advise_experiment(diagnosis, f"{NEXT_EXPERIMENT}.yaml")
        return {**_describe_program(diagnosis.deciding), "do": run}
    experiment = _choose_experiment(diagnosis)
    if experiment is None:
        return None
    return {**experiment, "do": advise_experiment(diagnosis, str(experiment["name"]))}


def _choose_experiment(diagnosis: Diagnosis) -> dict[str, Any] | None:
    for members in list_ambiguous(diagnosis):
        effects = [name for name in members if name in CATALOGUE]
        if len(effects) > 1:
            return find_separating_experiment(effects)
    said = {f.level for f in diagnosis.findings}
    if diagnosis.verdict is Verdict.NONE_KNOWN or said & {"kind", "place", "set"}:
        return {
            "name": "diagnosis",
            "separates": [],
            "why": "a full program asks every law at every speed and pressure",
        }
    spots = [s for s in diagnosis.audit.blind_spots if s.experiment] if diagnosis.audit else []
    hidden = max(spots, key=lambda s: s.sizes, default=None)
    return find_showing_experiment(hidden.name) if hidden and hidden.sizes > NEARLY_SEEN else None


def _describe_program(chosen: DecidingProgram) -> dict[str, Any]:
    """Return the entry of a program that was chosen by simulation."""
    forecast, experiment = chosen.forecast, chosen.to_experiment()
    experiment.pop("forecast", None)
    return {
        "name": NEXT_EXPERIMENT,
        "separates": [*chosen.explanations],
        "why": explain_choice(chosen),
        "promises": chosen.promises,
        "expected": forecast["pairs"],
        "needs": {
            "duration_s": round(chosen.duration_s, 3),
            "pressure_kpa": forecast["pressure_kpa"],
            "low_mm": forecast["low_mm"],
            "high_mm": forecast["high_mm"],
            "limits_from": chosen.limits_from,
        },
        "drawn": chosen.drawn,
        "inside_limits": chosen.inside,
        "program": experiment,
    }


def explain_choice(chosen: DecidingProgram) -> str:
    """Say what the program is expected to show, and against how many others it was chosen."""
    of = f"the best of {chosen.drawn} programs, of which {chosen.inside} stay within the limits"
    least = _describe_separation(chosen.nearest)
    if chosen.promises:
        return f"{least} ({of})"
    return f"{of} promises no decision: {least}"


def _describe_separation(s: Separation) -> str:
    return (
        f"if {spell_names(s.true)} is true, {spell_names(s.refuted)} should leave "
        f"{s.residual_over_floor:.3g} times the floor of the {s.block} block"
    )


def format_experiment_file(chosen: DecidingProgram, logs: Sequence[str]) -> str:
    """Write the program as an experiment file, what it needs and what is expected as comments."""
    head = "".join(f"# {line}\n" for line in _list_head_lines(chosen, logs))
    return head + dump_yaml(chosen.to_experiment())


def _list_head_lines(chosen: DecidingProgram, logs: Sequence[str]) -> Iterator[str]:
    yield f"Written by `pamctl diagnose` from {', '.join(logs)}."
    yield f"It decides between: {'; '.join(map(spell_names, chosen.explanations))}."
    yield (
        f"{chosen.duration_s:.1f} s, open loop, from the vented muscle at rest. By the fitted "
        f"models it needs up to {1e-3 * chosen.pressure_pa:.0f} kPa absolute and moves from "
        f"{1e3 * chosen.low_m:.1f} to {1e3 * chosen.high_m:.1f} mm ({chosen.limits_from} hold)."
    )
    why = explain_choice(chosen)
    yield f"{why[:1].upper()}{why[1:]}."
