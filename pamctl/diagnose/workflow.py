"""The workflow: prepare, recalibrate, then the steps: audit, locate, name, extend, show.

from concurrent.futures import ProcessPoolExecutor
from pamctl.diagnose import diagnose, record_of, sentence

executor = ProcessPoolExecutor()  # or a Dask Client().get_executor()
diagnosis = diagnose(train, holdout, plant, executor=executor)
print(sentence(diagnosis))
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace

from pamctl.diagnose.audit import audit_model
from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.extend import add_correction_tables, extend_plant
from pamctl.diagnose.fitting.candidates import Candidate, list_candidates
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE
from pamctl.diagnose.fitting.evidence import Evidence, prepare_evidence, with_modelled_pressure
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.integrator import compare_substeps
from pamctl.diagnose.fitting.model_fit import recalibrate, weigh_blocks
from pamctl.diagnose.fitting.split import split_by_run, split_by_stretch
from pamctl.diagnose.locate import locate_misfits
from pamctl.diagnose.measured.channel_noise import describe_channels
from pamctl.diagnose.measured.mend import SensorFault, mend_record
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.measured.refuse import BadData, check_measured_runs, check_sensors
from pamctl.diagnose.name import Naming, name_effects
from pamctl.diagnose.naming.remainder import regress_remainder
from pamctl.diagnose.naming.search import Progress, search_effects
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.show import HeldOutGap, is_no_worse, measure_gaps
from pamctl.plant.model import PlantSettings


def diagnose(
    train: Sequence[Record],
    holdout: Sequence[Record],
    plant: PlantSettings,
    *,
    without: Collection[str] = (),
    correction: bool = False,
    noise: Mapping[str, float] | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Say what the plant's model lacks to explain these runs.

    The model is fitted on `train` and judged by `holdout`. Without `holdout`, `train` is split by
    run; a single run is split into long stretches. `without` leaves effects out of the catalogue.
    `noise` states the sensors' standard deviations in SI by channel, before what the plant file or
    the records state. With `correction`, what no effect explains is added to the plant as a table,
    where that helps.
    Candidates are fitted in `executor`'s workers if one is given; any executor with the standard
    library's `submit` will do. Data that cannot be diagnosed give the verdict `bad_data`.
    """
    progress = progress or (lambda line: None)
    stated = {**(plant.noise.stated if plant.noise else {}), **(noise or {})}
    train, holdout, faults = _mend_records(train, holdout, stated)
    try:
        evidence, train, holdout = _check_and_prepare(train, holdout, plant)
    except BadData as error:
        return Diagnosis(Verdict.BAD_DATA, plant, plant, str(error))
    candidates = list_candidates(evidence, without)
    effects = len({candidate.name for candidate in candidates})  # some have several forms
    progress(f"{', '.join(evidence.blocks)}: {effects} effects of the catalogue are candidates")
    base = weigh_blocks(_recalibrate(evidence, candidates, train, holdout, executor, progress))
    ratios = ", ".join(f"{b} {base.ratio(b):.2f} x floor" for b in evidence.blocks)
    progress(f"recalibrated: {ratios}")
    naming = name_effects(base, candidates, executor, progress)
    naming, gaps = _withdraw_if_worse(naming, holdout)
    diagnosis = _conclude(naming, gaps, train, holdout, candidates, correction=correction)
    channels = describe_channels([*train, *holdout], evidence.noises, faults)
    extended = diagnosis.plant.model_copy(update={"noise": plant.noise})
    return replace(diagnosis, plant=extended, noise=channels)


def _mend_records(
    train: Sequence[Record], holdout: Sequence[Record], stated: Mapping[str, float]
) -> tuple[list[Record], list[Record], list[SensorFault]]:
    """Mend every record; a statement of its noise that is given here comes before its own."""
    faults: list[SensorFault] = []

    def mend(record: Record) -> Record:
        mended, found = mend_record(record)
        faults.extend(found)
        return replace(mended, stated_noise={**mended.stated_noise, **stated})

    return [mend(r) for r in train], [mend(r) for r in holdout], faults


def _check_and_prepare(
    train: Sequence[Record], holdout: Sequence[Record], plant: PlantSettings
) -> tuple[Evidence, list[Record], list[Record]]:
    records = [*train, *holdout]
    if not records:
        raise BadData("no records; give at least one log")
    check_measured_runs(records, plant)
    split = not holdout
    fitted, held = split_by_run(train) if split else ([*train], [*holdout])
    evidence = prepare_evidence(fitted, held, plant)
    if not evidence.blocks:
        channels = ", ".join(records[0].channels) or "nothing"
        raise BadData(
            f"the records hold {channels}; needed are pressure_pa with valve_v or "
            "position_m; or, with `actuator: direct` in the plant file, force_n with position_m"
        )
    check_sensors(records, evidence.noises)
    if split and len(train) == 1:
        evidence = split_by_stretch(evidence)
    return evidence, fitted, held


def _recalibrate(
    evidence: Evidence,
    candidates: Sequence[Candidate],
    train: Sequence[Record],
    holdout: Sequence[Record],
    executor: Executor | None,
    progress: Progress,
) -> Model:
    """Recalibrate; drive the mechanics by a pressure that the pressure block has cleaned.

    The pressure block takes all effects that it needs, to separate the pressure from its noise.
    """
    if {*evidence.blocks} != {PRESSURE, MECHANICS}:
        return recalibrate(evidence)
    alone = recalibrate(evidence.select_blocks({PRESSURE}))
    progress("pressure block alone: its simulation drives the mechanics with less noise")
    # Here the nearest fit counts, not the simplest form of a name.
    nearest = search_effects(alone, candidates, executor, width=2).nearest
    driven = with_modelled_pressure(
        evidence, train, holdout, nearest.fit_of(PRESSURE).settings, trusted=nearest.is_complete
    )
    return recalibrate(driven, alone.fits)


def _withdraw_if_worse(
    naming: Naming, holdout: Sequence[Record]
) -> tuple[Naming, dict[str, HeldOutGap]]:
    """Measure the held-out gap; withdraw names that make the coupled simulation worse."""
    gaps = measure_gaps(naming.base, naming.model, holdout)
    if not naming.model.effects or is_no_worse(gaps):
        return naming, gaps
    naming = naming.withdraw_effects()
    return naming, measure_gaps(naming.base, naming.model, holdout)


def _conclude(
    naming: Naming,
    gaps: dict[str, HeldOutGap],
    train: Sequence[Record],
    holdout: Sequence[Record],
    candidates: Sequence[Candidate],
    *,
    correction: bool,
) -> Diagnosis:
    """Extend the plant, and locate what is left."""
    model = naming.model
    plant, remainder, tables = extend_plant(naming.verdict, model), None, None
    if naming.verdict in (Verdict.PARTIAL, Verdict.NONE_KNOWN):
        remainder = regress_remainder(model, max(model.evidence.blocks, key=model.ratio))
        tables = add_correction_tables(model, plant, holdout) if correction else None
    if tables and tables.blocks:
        gaps = {name: replace(gap, corrected=tables.after[name]) for name, gap in gaps.items()}
    return Diagnosis(
        naming.verdict,
        model.evidence.nominal,
        tables.plant if tables else plant,
        model=model,
        base=naming.base,
        standings=naming.standings,
        numbers=naming.numbers,
        gap=gaps,
        misfits=tuple(locate_misfits(model)),
        base_misfits=tuple(locate_misfits(naming.base)),
        substep_changes=compare_substeps(model),
        trials=naming.trials,
        remainder=remainder,
        correction=tables,
        train=tuple(train),
        holdout=tuple(holdout),
        explained=naming.explained,
        audit=audit_model(model, [c for c in candidates if c.name not in model.names], pairs=False),
    )
