"""The diagnosis of the last minute, for a process that gives way to everything else."""

from __future__ import annotations

import os
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from pamctl.diagnose.record import Record
from pamctl.plant.model import PlantSettings

if TYPE_CHECKING:  # the diagnosis is imported by the process that needs it
    from pamctl.diagnose import Diagnosis

_IDLE_NICE = 19
_DECIDED = ("named", "described", "miscalibrated", "no_discrepancy", "bad_data")
"""Verdicts that leave nothing open that held constants could decide."""


def explain_gently(record: Record, plant: PlantSettings, before: Record | None) -> dict[str, Any]:
    """Do what `explain_record` does, in a worker process of its own that takes only idle time."""
    os.nice(_IDLE_NICE)
    with suppress(AttributeError, OSError):  # where the system knows it
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    return explain_record(record, plant, before)


def explain_record(record: Record, plant: PlantSettings, before: Record | None) -> dict[str, Any]:
    """Diagnose a record; return verdict, sentence and names as plain values.

    What these seconds leave open is asked again with the constants that `before` shows.
    """
    from pamctl.diagnose import diagnose, sentence

    found = diagnose([record], [], plant)
    if found.verdict not in _DECIDED and before is not None:
        held = diagnose([record], [], hold_constants(before, plant))
        found = _choose_surer(found, held)
    names, rivals = _list_names(found), _list_rivals(found)
    numbers = {n.name: n.as_dict() for n in found.numbers if n.name.split(".")[0] in names}
    text = f"best explanation: {sentence(found)}"
    if rivals:
        text += f"; not refuted: {', '.join(rivals)}"
    return {
        "sentence": text,
        "verdict": found.verdict.value,
        "effects": names,
        "not_refuted": rivals,
        "numbers": numbers,
        "seconds": record.duration_s,
    }


def hold_constants(before: Record, plant: PlantSettings) -> PlantSettings:
    """Return the plant with the constants that fit a faultless record, as known numbers.

    A small effect hides in constants that may move: a leak in the valve's gain and the tank's
    pressure. They did not move when the block left the model, unless they are what moved.
    """
    from pamctl.diagnose.evidence.weigh import CALIBRATED, prepare_weigher
    from pamctl.diagnose.mend import mend_records
    from pamctl.diagnose.plant_numbers import with_values

    (before,), _ = mend_records([before])
    weigher, start = prepare_weigher([before], (), plant)
    fitted = weigher.settle(start).values
    names = {*CALIBRATED[plant.actuator]} & {*fitted}
    held = with_values(plant, {name: fitted[name] for name in names})
    return held.model_copy(update={"known": tuple(sorted({*plant.known, *names}))})


def _choose_surer(free: Diagnosis, held: Diagnosis) -> Diagnosis:
    """Return the diagnosis with held constants where it decides among what the other left open.

    It cannot know that a constant is what moved. So it may only take away from a set of names
    that the diagnosis with free constants found itself.
    """
    from pamctl.diagnose import Verdict

    open_names = {*_list_names(free), *_list_rivals(free)}
    left = {*_list_names(held), *_list_rivals(held)}
    decides = held.verdict in (Verdict.NAMED, Verdict.AMBIGUOUS)
    is_surer = left < open_names or (left == open_names and free.verdict is Verdict.PARTIAL)
    return held if decides and left and is_surer else free


def _list_names(found: Diagnosis) -> list[str]:
    return [f.name for f in found.findings if f.level != "rest"]


def _list_rivals(found: Diagnosis) -> list[str]:
    """Return what the data do not refute beside the names, without freer terms of a sure name."""
    names = _list_names(found)
    open_ones = [f for f in found.findings if f.level not in ("name", "rest")]
    rivals = dict.fromkeys(r.name for f in open_ones for r in f.rivals)
    return [name for name in rivals if name not in names]
