"""The workflow: prepare, recalibrate, locate, name, hear the rivals, extend, show.

from concurrent.futures import ProcessPoolExecutor
from pamctl.diagnose import diagnose, record_of, sentence

executor = ProcessPoolExecutor()  # or a Dask Client().get_executor()
diagnosis = diagnose(train, holdout, plant, executor=executor)
print(sentence(diagnosis))
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Executor

from pamctl.diagnose.conclude import conclude_diagnosis, refuse_diagnosis
from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.fitting.candidates import Candidate, list_candidates
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE
from pamctl.diagnose.fitting.evidence import Evidence, prepare_evidence, with_modelled_pressure
from pamctl.diagnose.fitting.fitted_model import (
    Model,
    recalibrate,
    weigh_blocks,
    wrap_nominal_model,
)
from pamctl.diagnose.fitting.split import split_by_run, split_by_stretch
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.measured.refuse import BadData, check_measured_runs, check_sensors
from pamctl.diagnose.naming.rivals import Standing, find_rivals
from pamctl.diagnose.naming.search import EffectSearch, search_effects
from pamctl.diagnose.naming.verdict import Judgement, Verdict, judge_search
from pamctl.plant.model import PlantSettings

Progress = Callable[[str], None]


def diagnose(
    train: Sequence[Record],
    holdout: Sequence[Record],
    plant: PlantSettings,
    *,
    without: Collection[str] = (),
    correction: bool = False,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Say what the plant's model lacks to explain these runs.

    Fits on `train`, judges by `holdout`; where that is empty, `train` is split by run, or
    by long stretches if there is one only. `without` leaves effects out of the catalogue.
    With `correction` what no effect explains is added to the plant as a table, where that helps.
    Candidates are fitted in `executor`'s workers if one is given, any with the standard
    library's `submit`. Data that cannot be diagnosed give the verdict `bad_data`.
    """
    tell = progress or (lambda line: None)
    try:
        evidence, train, holdout = _check_and_prepare(train, holdout, plant)
    except BadData as error:
        return refuse_diagnosis(plant, str(error))
    found = list_candidates(evidence, without)
    effects = len({candidate.name for candidate in found})  # some in several forms
    tell(f"{', '.join(evidence.blocks)}: {effects} effects of the catalogue can be asked for")
    base = weigh_blocks(
        _recalibrate_with_clean_pressure(evidence, found, train, holdout, executor, tell)
    )
    evidence = base.evidence
    tell("recalibrated: " + ", ".join(f"{b} {base.ratio(b):.2f} x floor" for b in evidence.blocks))
    search = search_effects(base, found, executor, tell)
    search, judgement, heard = _hear_rivals(
        search, wrap_nominal_model(evidence), found, executor, tell
    )
    return conclude_diagnosis(
        judgement, heard, search, train, holdout, found, correction=correction
    )


def _hear_rivals(
    search: EffectSearch,
    nominal: Model,
    found: Sequence[Candidate],
    executor: Executor | None,
    tell: Progress,
) -> tuple[EffectSearch, Judgement, tuple[Standing, ...]]:
    """Judge what was found, and hear its rivals; where one of them does better, hear its rivals."""
    judgement = judge_search(search, nominal)
    heard: tuple[Standing, ...] = ()
    while judgement.verdict in (Verdict.NAMED, Verdict.PARTIAL):
        tell("hearing the rivals of " + " and ".join(judgement.model.names))
        heard = find_rivals(judgement.model, search, found, executor)
        search = search.add_models(model for standing in heard for model in standing.heard)
        before, judgement = judgement, judge_search(search, nominal)
        if judgement.model.effects == before.model.effects:
            break
    return search, judgement, heard


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
        held_channels = ", ".join(records[0].channels) or "nothing"
        raise BadData(
            f"the records hold {held_channels}: wanted are pressure_pa with valve_v or "
            "position_m; or, with `actuator: direct` in the plant file, force_n with position_m"
        )
    check_sensors(records, evidence.noises)
    if split and len(train) == 1:
        evidence = split_by_stretch(evidence)
    return evidence, fitted, held


def _recalibrate_with_clean_pressure(
    evidence: Evidence,
    found: Sequence[Candidate],
    train: Sequence[Record],
    holdout: Sequence[Record],
    executor: Executor | None,
    tell: Progress,
) -> Model:
    """Recalibrate; let the pressure block, with whatever it takes, tell noise from pressure."""
    if {*evidence.blocks} != {PRESSURE, MECHANICS}:
        return recalibrate(evidence)
    alone = recalibrate(evidence.select_blocks({PRESSURE}))
    tell("pressure block alone, for a clean pressure to drive the mechanics")
    # The simplest form of a name would do to name it; what drives the mechanics is to be true.
    best = search_effects(alone, found, executor, width=2).nearest
    driven = with_modelled_pressure(
        evidence, train, holdout, best.fit_of(PRESSURE).settings, trusted=best.is_complete
    )
    return recalibrate(driven, alone.fits)
