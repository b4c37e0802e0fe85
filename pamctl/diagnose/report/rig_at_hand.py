"""Words for the rig at hand: no air where there is none, no command that cannot run there."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.experiments import write_advice, write_command


class RigWords(NamedTuple):
    """What texts call a rig and its parts."""

    start_model: str
    suspects: str
    """Where to look for what no effect explains."""
    begin: str
    """How a record should begin."""


_WORDS: Mapping[str, RigWords] = {
    "muscle": RigWords(
        "the paper's muscle and valve",
        "supply, tubing, mounting, sensors",
        "with the muscle vented and at rest",
    ),
    "direct": RigWords(
        "a mechanism that a measured force drives",
        "guides, mounting, the drive, sensors",
        "at rest",
    ),
    "chamber": RigWords(
        "a chamber of constant volume behind a valve",
        "supply, tubing, leaks, sensors",
        "with the chamber vented",
    ),
}


def words_of_rig(diagnosis: Diagnosis) -> RigWords:
    """Return the words for the actuator of the start model."""
    return _WORDS[diagnosis.nominal.actuator]


def runs_here(diagnosis: Diagnosis) -> bool:
    """Tell whether `pamctl run` moves this rig: a muscle whose records pamctl made."""
    imported = any(record.is_imported for record in (*diagnosis.train, *diagnosis.holdout))
    return diagnosis.nominal.actuator == "muscle" and not imported


def advise_experiment(diagnosis: Diagnosis, experiment: str) -> str:
    """Write the command for an experiment, or what to record on a rig that pamctl does not run."""
    if diagnosis.is_of_daemon:
        return write_command(experiment, by_daemon=True)
    return write_advice(experiment, diagnosis.nominal.actuator, runs_here=runs_here(diagnosis))
