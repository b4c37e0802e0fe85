"""What a set-up finding means for the verdict."""

from __future__ import annotations

from dataclasses import replace

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.setup.decimation import suspect_decimation
from pamctl.diagnose.setup.setup_finding import SetupFinding
from pamctl.diagnose.setup.suspect_setup import CheckedSetup, is_refuted_by
from pamctl.diagnose.setup.symmetries import EqualFinding, find_equal_setups


def conclude_setup(diagnosis: Diagnosis, setup: CheckedSetup) -> Diagnosis:
    """Return the diagnosis with the set-up's findings.

    A corrected set-up that leaves nothing is a matter of numbers. Where an effect explains the
    data as well as a number of the set-up, neither is the cause alone, unless both say the same.
    """
    equals = _find_equals(diagnosis)
    by_equation = {equal.finding.number for equal in equals}
    others = [f for f in _keep_open(diagnosis, setup) if f.number not in by_equation]
    corrected = [f for f in setup.findings if f.is_corrected]
    found = (*(e.finding for e in equals), *corrected, *others)
    verdict = diagnosis.verdict
    if not found and verdict is Verdict.NONE_KNOWN and diagnosis.model is not None:
        suspicion = suspect_decimation(diagnosis.model)
        found = (suspicion,) if suspicion else ()
    if found and verdict is Verdict.NO_DISCREPANCY:
        verdict = Verdict.MISCALIBRATED
    names = {standing.effect.name for standing in diagnosis.standings}
    differ = [e.finding for e in equals if not e.is_the_same]
    doubtful = {n for f in (*differ, *others) for n in f.cannot_be_told_from}
    if verdict is Verdict.NAMED and names & doubtful:
        verdict = Verdict.AMBIGUOUS
    return replace(diagnosis, verdict=verdict, setup=found)


def _find_equals(diagnosis: Diagnosis) -> tuple[EqualFinding, ...]:
    """Return the set-up findings that are equal to a named effect by the equations.

    An effect that leaves something of its blocks is not known well enough to be another thing: of
    a sensor's bow it is the slope.
    """
    model, base = diagnosis.model, diagnosis.base
    if model is None or base is None:
        return ()
    left = {*model.unexplained, *(sign.block for sign in diagnosis.signs)}
    rivals = {
        s.effect.name: s.equal_rivals for s in diagnosis.standings if not s.effect.blocks & left
    }
    block = max(base.evidence.blocks, key=base.ratio)
    numbers = {n.name: n for n in diagnosis.numbers if n.name.split(".")[0] in rivals}
    return tuple(
        replace(equal, finding=equal.finding.beside(rivals[equal.effect]))
        for equal in find_equal_setups(
            numbers, model.evidence.nominal, base.rms[block] / model.rms[block], model.ratio(block)
        )
    )


def _keep_open(diagnosis: Diagnosis, setup: CheckedSetup) -> tuple[SetupFinding, ...]:
    """Return the findings that were left to the search, and that it has not refuted.

    What the search names then explains these data no better.
    """
    model = diagnosis.model
    refuted = {
        fitted.suspect.number
        for fitted in setup.open_fits
        if model is not None and is_refuted_by(fitted, model)
    }
    names = model.names if model is not None else ()
    return tuple(
        f.beside(names) for f in setup.findings if not f.is_corrected and f.number not in refuted
    )
