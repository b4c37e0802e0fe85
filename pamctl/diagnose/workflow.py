"""The workflow: prepare, recalibrate, then audit, locate, name, confirm, extend, show.

from concurrent.futures import ProcessPoolExecutor
from pamctl.diagnose import diagnose, record_of, sentence

executor = ProcessPoolExecutor()  # or a Dask Client().get_executor()
diagnosis = diagnose(train, holdout, plant, executor=executor)
print(sentence(diagnosis))
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from time import perf_counter

from pamctl.bounded_memory import forget_results
from pamctl.diagnose.audit import audit_model
from pamctl.diagnose.confirm import Confirmation, confirm_naming
from pamctl.diagnose.deciding.deciding_program import choose_deciding_program
from pamctl.diagnose.deciding.explanations import list_explanations
from pamctl.diagnose.deciding.forecast import judge_forecasts, read_forecast
from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.extend import extend_plant
from pamctl.diagnose.finer_steps import name_with_finer_steps
from pamctl.diagnose.fitting.block_fit import Fit
from pamctl.diagnose.fitting.candidates import Candidate, list_candidates
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE
from pamctl.diagnose.fitting.evidence import Evidence, prepare_evidence, with_modelled_pressure
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.integrator import compare_substeps, refine_substeps
from pamctl.diagnose.fitting.model_fit import recalibrate, weigh_blocks
from pamctl.diagnose.fitting.split import (
    ConfirmedOn,
    describe_confirmation,
    keep_for_choice,
    keep_for_confirmation,
    split_by_run,
)
from pamctl.diagnose.hidden_motion import name_with_hidden_motion
from pamctl.diagnose.locate import locate_misfits
from pamctl.diagnose.measured.noise.channel_noise import describe_channels
from pamctl.diagnose.measured.noise.mend import SensorFault, mend_records
from pamctl.diagnose.measured.quality_rules import leave_out_unused
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.measured.refuse import (
    AcceptedDoubt,
    BadData,
    check_measured_runs,
    check_sensors,
)
from pamctl.diagnose.measured.resting_pressure import align_resting_pressure
from pamctl.diagnose.name import name_effects
from pamctl.diagnose.naming.doubt import is_strained
from pamctl.diagnose.naming.first_level import FirstLevel
from pamctl.diagnose.naming.remainder import regress_remainder
from pamctl.diagnose.naming.search import Progress, closed_share, search_effects
from pamctl.diagnose.naming.time_left import guess_time_left
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.setup.refused_columns import explain_refusal
from pamctl.diagnose.setup.setup_finding import SetupFinding
from pamctl.diagnose.setup.suspect_setup import (
    CheckedSetup,
    suspect_air_first,
    suspect_setup,
)
from pamctl.diagnose.setup_beside import ask_beside, ask_rival_setups
from pamctl.diagnose.setup_verdict import conclude_setup
from pamctl.diagnose.terms.describe import Description, describe_rest, is_confirmed
from pamctl.diagnose.within_margin import name_within_margin
from pamctl.plant.model import PlantSettings

NEARLY_ALL = 0.95
"""Share of the way to its limit that the pressure block must go to say where the rig rested."""


def diagnose(
    train: Sequence[Record],
    holdout: Sequence[Record],
    plant: PlantSettings,
    *,
    without: Collection[str] = (),
    accept: Mapping[str, str] | None = None,
    noise: Mapping[str, float] | None = None,
    cut: bool = False,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Say what the plant's model lacks to explain these runs.

    The model is fitted on `train`. Two of three stretches of `holdout` choose it, the third
    confirms it. Without `holdout`, `train` is split by run; a single run is split into long
    stretches, and so is every run with `cut`, or where a program that a diagnosis chose is among
    them. `without` leaves effects out of the catalogue.
    `accept` holds the user's reasons to overrule rules of `quality_rules.RULES`, by rule. `noise`
    states the sensors' standard deviations in SI by channel, before what the plant file or the
    records state.
    Candidates are fitted in `executor`'s workers if one is given; any executor with the standard
    library's `submit` will do. Data that cannot be diagnosed give the verdict `bad_data`.
    """
    began_s = perf_counter()
    forget_results()  # of the diagnosis before: no key of it comes again
    progress = progress or (lambda line: None)
    stated = {**(plant.noise.stated if plant.noise else {}), **(noise or {})}
    plants_pa = plant.parameters.atmospheric_pressure_pa
    for record in (*train, *holdout):
        if record.atmosphere_pa is not None and abs(record.atmosphere_pa - plants_pa) > 1.0:
            progress(
                f"{record.name}: its gauge pressure counts from {record.atmosphere_pa:.6g} Pa, as "
                f"its import map says, but the plant's atmosphere is {plants_pa:.6g} Pa: make "
                "atmospheric_pressure_pa the same in both"
            )
    train, holdout, faults = _mend_records(train, holdout, plant, stated)
    try:
        evidence, train, holdout, is_cut, accepted = _check_and_prepare(
            train, holdout, plant, accept, cut=cut
        )
    except BadData as error:
        given = (*train, *holdout)
        refused = explain_refusal(given, plant)
        reasons = "\n".join([str(error), *(f"{f.text}; {f.how_to_mend}" for f in refused)])
        return Diagnosis(Verdict.BAD_DATA, plant, plant, reasons, train=given, setup=refused)
    candidates = list_candidates(evidence, without)
    count = len({candidate.name for candidate in candidates})  # some have several forms
    progress(f"{', '.join(evidence.blocks)}: {count} effects of the catalogue are candidates")
    recalibrated = _recalibrate(evidence, candidates, train, holdout, executor, progress)
    train, holdout = [*recalibrated.train], [*recalibrated.holdout]
    base = weigh_blocks(recalibrated.base)
    ratios = ", ".join(f"{b} {base.ratio(b):.2f} x floor" for b in evidence.blocks)
    worst = max(base.ratio(block) for block in evidence.blocks)
    progress(f"recalibrated: {ratios}; {guess_time_left(perf_counter() - began_s, worst)}")
    effects = FirstLevel(candidates)
    setup = recalibrated.refused
    if setup is None:
        setup = suspect_setup(base, train, holdout, effects, progress, recalibrated.findings)
    if setup.refusal:
        given = (*train, *holdout)
        return Diagnosis(
            Verdict.BAD_DATA, plant, plant, setup.refusal, train=given, setup=setup.findings
        )
    known = recalibrated.models if setup.base is base else ()
    naming = name_effects(setup.base, candidates, executor, progress, known)
    naming, setup = ask_beside(naming, setup, candidates, executor, progress)
    naming, setup = name_with_hidden_motion(
        naming, setup, recalibrated.driving, candidates, executor, progress
    )
    naming, setup = name_with_finer_steps(naming, setup, candidates, executor, progress)
    naming, setup = ask_rival_setups(naming, setup, candidates, executor, progress)
    naming, setup = name_within_margin(naming, setup, candidates, executor, progress, is_cut=is_cut)
    confirming = keep_for_confirmation(naming.base.evidence, is_cut=is_cut)
    found = confirm_naming(naming, confirming)
    found = _search_below_limit(found, confirming, candidates, executor, progress)
    found, described = _describe_rest(found, confirming, executor, progress, without)
    on = describe_confirmation(confirming, is_cut=is_cut)
    diagnosis = _conclude(found, on, setup.train, setup.holdout, candidates)
    diagnosis = replace(conclude_setup(diagnosis, setup), described=described)
    channels = describe_channels([*train, *holdout], evidence.noises, faults)
    extended = diagnosis.plant.model_copy(update={"noise": plant.noise})
    found_all = replace(diagnosis, plant=extended, noise=channels, accepted=accepted)
    return _decide_next(found_all, [*train, *holdout], progress)


def _search_below_limit(
    found: Confirmation,
    confirming: Evidence,
    candidates: Sequence[Candidate],
    executor: Executor | None,
    progress: Progress,
) -> Confirmation:
    """Ask the catalogue where an estimated limit hid what is no noise; keep what gives a name.

    Quiet stretches set such a limit. Play acts at reversals only, and leaves most of them quiet.
    """
    base = found.naming.base
    doubted = frozenset(s.block for s in found.signs if base.floors[s.block].is_estimate)
    if found.naming.model.effects or not doubted:
        return found
    progress("the limit was an estimate, and what is left is no noise: asking the effects")
    strict = replace(base, evidence=replace(base.evidence, doubted=doubted))
    again = name_effects(strict, candidates, executor, progress)
    if not again.model.effects:
        return found
    confirmed = confirm_naming(again, replace(confirming, doubted=doubted))
    return confirmed if confirmed.naming.model.effects else found


def _decide_next(found: Diagnosis, records: Sequence[Record], progress: Progress) -> Diagnosis:
    """Add the program that would decide what is left, and what earlier forecasts were worth."""
    model = found.model
    if model is None:
        return found
    judged = judge_forecasts(model, found.standings, list({id(r): r for r in records}.values()))
    explanations = list_explanations(
        found.verdict, model, found.standings, found.described, found.setup
    )
    chosen = None
    if len(explanations) > 1:
        progress("choosing the program that decides: " + ", ".join(e.name for e in explanations))
        chosen = choose_deciding_program(explanations, records, seed=len({*map(id, records)}))
    names = tuple(e.name for e in explanations)
    return replace(found, explanations=names, deciding=chosen, forecasts=judged)


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


def _check_and_prepare(
    train: Sequence[Record],
    holdout: Sequence[Record],
    plant: PlantSettings,
    accept: Mapping[str, str] | None,
    *,
    cut: bool,
) -> tuple[Evidence, list[Record], list[Record], bool, tuple[AcceptedDoubt, ...]]:
    """Return the evidence for fits and choices, its records, and whether the runs were cut.

    The last are the doubts about the data that the user accepted.
    """
    records = [*train, *holdout]
    if not records:
        raise BadData("no records; give at least one log")
    accepted = check_measured_runs(records, plant, accept)
    # A program that was chosen to decide must be fitted on, and chosen by.
    cut = cut or any(read_forecast(record) for record in train)
    is_cut = not holdout and (cut or len(train) == 1)
    fitted, held = [*train], [*holdout]
    if not holdout:
        fitted, held = ([*train], [*train]) if is_cut else split_by_run(train)
    evidence = prepare_evidence(fitted, held, plant)
    if not evidence.blocks:
        channels = ", ".join(records[0].channels) or "nothing"
        raise BadData(
            f"the records hold {channels}; needed are pressure_pa with valve_v or "
            "position_m; or, with `actuator: direct` in the plant file, force_n with position_m"
        )
    accepted += check_sensors(records, evidence.noises, plant, accept)
    return keep_for_choice(evidence, is_cut=is_cut), fitted, held, is_cut, accepted


def _describe_rest(
    found: Confirmation,
    confirming: Evidence,
    executor: Executor | None,
    progress: Progress,
    without: Collection[str],
) -> tuple[Confirmation, Description | None]:
    """Ask what no effect explains; a term that the confirming samples refute is only a lead."""
    verdict, imitates = found.naming.verdict, is_strained(found.naming.model)
    if found.signs or not (imitates or verdict in (Verdict.PARTIAL, Verdict.NONE_KNOWN)):
        return found, None
    described = describe_rest(found.naming, executor, progress, without)
    if described.naming is None:
        return found, described
    naming = described.naming.without_unseen_numbers()
    again = confirm_naming(naming, confirming)
    before, after = (c.explained.get(described.block, 0.0) for c in (found, again))
    if again.naming.model is not naming.model or not is_confirmed(described, before, after):
        return found, replace(described, term=None, naming=None)
    return again, described


@dataclass(frozen=True)
class _Recalibrated:
    base: Model
    train: tuple[Record, ...]
    holdout: tuple[Record, ...]
    models: tuple[Model, ...] = ()
    """Models of the pressure block alone: they need not be fitted again."""
    driving: Fit | None = None
    """The fit of the pressure block whose simulation drives the mechanics."""
    findings: tuple[SetupFinding, ...] = ()
    """What was wrong about the pressure block's set-up; evidence and records are corrected."""
    refused: CheckedSetup | None = None
    """The set-up, where these records can say nothing more."""


def _recalibrate(
    evidence: Evidence,
    candidates: Sequence[Candidate],
    train: Sequence[Record],
    holdout: Sequence[Record],
    executor: Executor | None,
    progress: Progress,
) -> _Recalibrated:
    """Recalibrate; drive the mechanics by a pressure that the pressure block has cleaned.

    The pressure block takes all effects that it needs, to separate the pressure from its noise.
    A fault of its set-up is asked before: effects would imitate it poorly and at length.
    """
    given = (tuple(train), tuple(holdout))
    if {*evidence.blocks} != {PRESSURE, MECHANICS}:
        base = recalibrate(evidence)
        finer = refine_substeps(base)
        return _Recalibrated(base if finer is evidence else recalibrate(finer), *given)
    alone = recalibrate(evidence.select_blocks({PRESSURE}))
    effects = FirstLevel(candidates)
    setup = suspect_air_first(alone, evidence, train, holdout, effects, progress)
    findings: tuple[SetupFinding, ...] = ()
    if setup is not None:
        evidence, given = setup.base.evidence, (setup.train, setup.holdout)
        findings = setup.findings
        if setup.refusal:
            return _Recalibrated(setup.base, *given, (), None, findings, setup)
        alone = recalibrate(evidence.select_blocks({PRESSURE}))
    progress("pressure block alone: its simulation drives the mechanics with less noise")
    # Here the nearest fit counts, not the simplest form of a name.
    search = search_effects(alone, candidates, executor, width=2)
    nearest, fit = search.nearest, search.nearest.fit_of(PRESSURE)
    is_near = closed_share(alone, nearest, PRESSURE) > NEARLY_ALL
    driven = with_modelled_pressure(
        evidence, *given, fit.settings, trusted=nearest.is_complete, is_near=is_near
    )
    base = recalibrate(driven, alone.fits)
    return _Recalibrated(base, *given, search.models, fit, findings)


def _conclude(
    found: Confirmation,
    on: ConfirmedOn,
    train: Sequence[Record],
    holdout: Sequence[Record],
    candidates: Sequence[Candidate],
) -> Diagnosis:
    """Extend the plant, and locate what is left."""
    naming, remainder = found.naming, None
    base, model = naming.base, naming.model
    if naming.verdict in (Verdict.PARTIAL, Verdict.NONE_KNOWN):
        remainder = regress_remainder(model, max(model.evidence.blocks, key=model.ratio))
    is_open = naming.verdict in (Verdict.PARTIAL, Verdict.AMBIGUOUS)
    base_misfits = tuple(locate_misfits(base))
    return Diagnosis(
        naming.verdict,
        model.evidence.nominal,
        extend_plant(naming.verdict, model),
        model=model,
        base=base,
        standings=naming.standings,
        numbers=tuple(
            replace(n, conditional_on=model.names if is_open else ()) for n in naming.numbers
        ),
        gap={**found.gap},
        misfits=base_misfits if model is base else tuple(locate_misfits(model)),
        base_misfits=base_misfits,
        substep_changes=compare_substeps(model),
        trials=naming.trials,
        remainder=remainder,
        train=tuple(train),
        holdout=tuple(holdout),
        explained=min(found.explained.values(), default=1.0) if model.effects else 0.0,
        explained_by_block=found.explained,
        confirmed_on=on,
        confirmed_ratios=found.ratios,
        signs=found.signs,
        audit=audit_model(model, [c for c in candidates if c.name not in model.names], pairs=False),
    )
