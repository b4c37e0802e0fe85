"""What a set-up finding means for the verdict."""

from __future__ import annotations

from dataclasses import replace

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.setup.suspect_setup import CheckedSetup, is_refuted_by

WITHOUT_EFFECTS = (Verdict.NO_DISCREPANCY, Verdict.MISCALIBRATED)


def conclude_setup(diagnosis: Diagnosis, setup: CheckedSetup) -> Diagnosis:
    """Return the diagnosis with the set-up's findings.

    A corrected set-up that leaves nothing is a matter of numbers. Where an effect explains the
    data as well as a number of the set-up, neither is the cause alone, unless both say the same.
    """
    found = tuple(
        finding
        for finding in setup.findings
        if finding.is_corrected
        or diagnosis.model is None
        or not any(is_refuted_by(fitted, diagnosis.model) for fitted in setup.open_fits)
    )
    verdict = diagnosis.verdict
    if found and verdict is Verdict.NO_DISCREPANCY:
        verdict = Verdict.MISCALIBRATED
    open_twins = {name for fitted in setup.open_fits for name in fitted.twins}
    names = {standing.effect.name for standing in diagnosis.standings}
    equal = {name for f in found if not f.is_corrected for name in f.cannot_be_told_from}
    if verdict is Verdict.NAMED and names & equal and not names & equal <= open_twins:
        verdict = Verdict.AMBIGUOUS
    return replace(diagnosis, verdict=verdict, setup=found)
