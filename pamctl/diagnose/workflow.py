"""The workflow: mend and check the records, weigh the evidence, conclude, and decide what is next.

from pamctl.diagnose import diagnose, record_of, sentence

diagnosis = diagnose(train, holdout, plant)
print(sentence(diagnosis))
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace

from pamctl.diagnose.audit import audit_evidence
from pamctl.diagnose.deciding_program import choose_deciding_program
from pamctl.diagnose.diagnosis import (
    Diagnosis,
    DiagnosisInterrupted,
    Verdict,
    decide_verdict,
)
from pamctl.diagnose.evidence import EvidenceVerdict, weigh_evidence
from pamctl.diagnose.evidence.run_pieces import CannotBeWeighed
from pamctl.diagnose.explanations import assemble_plant, judge_forecasts, list_explanations
from pamctl.diagnose.guess_plant import doubt_numbers
from pamctl.diagnose.mend import align_resting_pressure, mend_records
from pamctl.diagnose.record import Record, SensorFault, describe_channels, pool_stated_noise
from pamctl.diagnose.refuse import BadData, check_measured_runs, leave_out_unused
from pamctl.plant.model import PlantSettings

Progress = Callable[[str], None]


def diagnose(
    train: Sequence[Record],
    holdout: Sequence[Record],
    plant: PlantSettings,
    *,
    without: Collection[str] = (),
    accept: Mapping[str, str] | None = None,
    noise: Mapping[str, float] | None = None,
    jobs: int | None = None,
    progress: Progress = lambda line: None,
) -> Diagnosis:
    """Say what the plant's model lacks to explain these runs.

    The model is fitted to `train`, with each block left out in turn; `holdout` judges it too.
    `without` leaves effects out of the pool. `accept` holds the user's reasons to overrule rules
    of `refuse.RULES`, by rule. `noise` states the sensors' standard deviations in SI by
    channel, before what the plant file or the records state. `jobs` records are simulated side by
    side [default: as many as there are cores]. Data that cannot be diagnosed give the verdict
    `bad_data`. A KeyboardInterrupt after the first fit becomes `DiagnosisInterrupted`.
    """
    stated = {**(plant.noise.stated if plant.noise else {}), **(noise or {})}
    plants_pa = plant.parameters.atmospheric_pressure_pa
    of_maps = {r.atmosphere_pa for r in (*train, *holdout) if r.atmosphere_pa is not None}
    for air_pa in sorted(air_pa for air_pa in of_maps if abs(air_pa - plants_pa) > 1.0):
        names = [r.name for r in (*train, *holdout) if r.atmosphere_pa == air_pa]
        progress(
            f"{', '.join(names)}: gauge pressure counts from {air_pa:.6g} Pa, as the import map "
            f"says, but the plant's atmosphere is {plants_pa:.6g} Pa: make "
            "atmospheric_pressure_pa the same in both"
        )
    given = [*train, *holdout]
    train, holdout, faults = _mend_records(train, holdout, plant, stated)
    records = [*train, *holdout]
    try:
        accepted = check_measured_runs(records, plant, accept, given)
        for doubt in doubt_numbers(records, plant):
            progress(doubt)
        if plant.actuator in ("muscle", "cylinder") and records[0].valve_v is None:
            progress("no command: only the mechanics is asked, and the measured pressure drives it")
        stated = pool_stated_noise(records)
        cores = jobs or os.cpu_count() or 1
        found = weigh_evidence(
            train, holdout, plant, without=[*without], noise=stated, jobs=cores, tell=progress
        )
        acting = {*found.noise_rms, *found.weigher.train.drivers}
        for channel in sorted((noise or {}).keys() - acting):
            compared = " and ".join(found.noise_rms)
            progress(f"noise of {channel} has no effect: the model is compared with {compared}")
    except (BadData, CannotBeWeighed) as error:
        return Diagnosis(Verdict.BAD_DATA, plant, plant, str(error), train=tuple(records))
    verdict = decide_verdict(found)
    diagnosis = Diagnosis(
        verdict,
        plant,
        plant if verdict is Verdict.NO_DISCREPANCY else assemble_plant(plant, found.model.values),
        evidence=found,
        train=tuple(train),
        holdout=tuple(holdout),
        accepted=accepted,
        noise=describe_channels(records, found.sensor_rms, [*faults, *_tell_instants(found)]),
    )
    if found.stopped_by is not None:
        raise DiagnosisInterrupted(diagnosis) from found.stopped_by
    try:
        diagnosis = replace(diagnosis, audit=audit_evidence(found, pairs=False))
        return _decide_next(diagnosis, found, records, progress)
    except KeyboardInterrupt as interrupt:
        raise DiagnosisInterrupted(diagnosis) from interrupt


def _tell_instants(found: EvidenceVerdict) -> Iterator[SensorFault]:
    """Say so where commands act before the samples at which the files have them."""
    jumps = sum(len(each.owner) for each in found.instants)
    if jumps:
        early = sum(each.early for each in found.instants)
        says = f"{early} of {jumps} steps of the command act before their samples: the files do not"
        says += " have all commands. The instants of the steps were fitted"
        yield SensorFault("valve_v", "early", says)


def _decide_next(
    diagnosis: Diagnosis, found: EvidenceVerdict, records: Sequence[Record], progress: Progress
) -> Diagnosis:
    """Add the program that would decide what is left, and what earlier forecasts were worth."""
    explanations = list_explanations(found, diagnosis.nominal)
    chosen = None
    if len(explanations) > 1:
        progress("choosing the program that decides: " + ", ".join(e.name for e in explanations))
        chosen = choose_deciding_program(explanations, records, seed=len(records))
        if chosen is None:
            progress(
                "no program was found: it takes a muscle of which pressure and position were "
                "measured, and limits that leave room; what to record instead is said below"
            )
    return replace(
        diagnosis,
        explanations=tuple(e.name for e in explanations),
        deciding=chosen,
        forecasts=judge_forecasts(found, records),
    )


def _mend_records(
    train: Sequence[Record],
    holdout: Sequence[Record],
    plant: PlantSettings,
    stated: Mapping[str, float],
) -> tuple[list[Record], list[Record], list[SensorFault]]:
    """Mend every record; a statement of its noise that is given here comes before its own.

    Channels that the plant's model does not read are left out. The zeros that homing gave the
    pressure sensor are aligned.
    """
    used, unused = leave_out_unused([*train, *holdout], plant)
    mended, faults = mend_records(used)
    stating = [replace(r, stated_noise={**r.stated_noise, **stated}) for r in mended]
    aligned = align_resting_pressure(stating)
    return aligned[: len(train)], aligned[len(train) :], [*unused, *faults]
