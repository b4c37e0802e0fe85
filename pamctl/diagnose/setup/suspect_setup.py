"""Ask the set-up before the physics.

Every number of the plant file and every column of the record is a suspect. A suspect is accepted
only if it explains most of what is left on held-out data, and no effect of the catalogue does
clearly better. Where an effect does as well, both are said, and nothing is corrected.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from pamctl.diagnose.fitting.block_fit import Fit, rms
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE, Drive
from pamctl.diagnose.fitting.evidence import SMALLEST_MISFIT, Evidence, prepare_evidence
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.held_out_rms import simulate_held_out
from pamctl.diagnose.fitting.model_fit import recalibrate, weigh_blocks
from pamctl.diagnose.fitting.numbers import AREA, value_of, with_values
from pamctl.diagnose.judging.mixture import Mixture, is_first_alone, is_second_alone, mix_models
from pamctl.diagnose.measured.noise.sensor_noise import Noise, estimate_from_residual
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.setup.decimation import fit_decimation
from pamctl.diagnose.setup.finding_words import advise_mending, describe
from pamctl.diagnose.setup.late_commands import fit_late_commands
from pamctl.diagnose.setup.mended_records import mend_record
from pamctl.diagnose.setup.setup_finding import SetupFinding
from pamctl.diagnose.setup.suspects import ATMOSPHERE, Suspect, list_suspects
from pamctl.diagnose.setup.time_changes import fit_changes_by_record, fit_time_changes
from pamctl.diagnose.setup.weighed_fit import (
    MUCH,
    Promise,
    SuspectFit,
    fit_suspect,
    held_out_margins,
    reached_fits,
    score_suspect,
)
from pamctl.diagnose.setup.wholesale import fit_wholesale

_Drives = Mapping[str, Sequence[Drive]]

MOST_FINDINGS = 3
PROMISING = 0.3
"""Share of what is left that a suspect must promise to be fitted."""
MOST_FITTED = 3
"""Suspects that are fitted for each set of blocks."""
NEAR_PROMISE = 0.7
"""Once a suspect reaches the floor, another must promise this share of what that one promised."""
LEAST_CLOSED = 0.8
"""Share of the way to the floor that a suspect must go in a block."""
WORSE = 1.1
"""A coupled signal is worse if its RMS grows by more than this factor."""
GEOMETRY = ("rest_length_m", "braid_length_m", "scale of position_m")
"""Suspects by label that say one thing: lengths of the plant and of the record do not agree."""

UNLIKE = 3.0
"""Repeats that differ by more than this multiple of the sensor's floor are asked why."""
HOPELESS = 5.0
"""A suspect that leaves so many times the square that an effect promises to leave is not fitted."""


Answer = TypeVar("Answer")
_PROMISES: WeakKeyDictionary[Fit, dict[Suspect, Promise]] = WeakKeyDictionary()
_FITS: WeakKeyDictionary[Fit, dict[Suspect, SuspectFit]] = WeakKeyDictionary()
"""By the fit that a suspect alters."""


class EffectRivals(Protocol):
    """The catalogue's single effects upon a base: rivals of every suspect."""

    def promise(self, base: Model, block: str) -> float:
        """Return the largest share of a block's residual that an effect promises to explain."""
        ...

    def fit(self, base: Model) -> Sequence[Model]:
        """Return the base with each of the most promising effects, fitted."""
        ...


@dataclass(frozen=True)
class CheckedSetup:
    """What was found about a set-up, and what to go on with."""

    base: Model
    """Recalibrated on the corrected set-up."""
    train: tuple[Record, ...]
    """The records, corrected where a column was wrong."""
    holdout: tuple[Record, ...]
    findings: tuple[SetupFinding, ...] = ()
    open_fits: tuple[SuspectFit, ...] = ()
    """Those that an effect equals: not corrected, the search decides beside them."""
    refusal: str = ""
    """Why nothing more can be said with these records; empty if more can."""


def suspect_setup(
    base: Model,
    train: Sequence[Record],
    holdout: Sequence[Record],
    effects: EffectRivals,
    progress: Callable[[str], None] = lambda line: None,
    known: Sequence[SetupFinding] = (),
) -> CheckedSetup:
    """Return the findings, and the base to search upon; `known` are corrected already."""
    setup = CheckedSetup(base, tuple(train), tuple(holdout), tuple(known))
    setup = _restore_commands(setup, base, progress)
    if setup.refusal:
        return setup
    differing = _find_what_differs(setup.base)
    if differing is not None:
        finding = _word_finding(differing, (), corrected=True)
        progress(f"set-up: {finding.text}")
        setup = replace(_correct(setup, differing), findings=(*setup.findings, finding))
    said: set[tuple[str, ...]] = set()
    while len(setup.findings) < MOST_FINDINGS and setup.base.unexplained and not setup.open_fits:
        found = _find_best(setup.base, effects)
        if found is None:
            break
        fitted, rivals = found
        if fitted.suspect.key in said:  # a second time would only undo the first
            break
        said.add(fitted.suspect.key)
        corrected = not rivals
        finding = _word_finding(fitted, rivals, corrected=corrected)
        if corrected:
            changed = _correct(setup, fitted)
            if not fitted.suspect.is_timed and _spoils_coupled(setup.base, changed.base):
                break
            setup = changed
        progress(f"set-up: {finding.text}")
        if not corrected:
            setup = replace(setup, open_fits=(*setup.open_fits, fitted))
        setup = replace(setup, findings=(*setup.findings, finding))
    return setup


def suspect_air_first(
    alone: Model,
    evidence: Evidence,
    train: Sequence[Record],
    holdout: Sequence[Record],
    effects: EffectRivals,
    progress: Callable[[str], None] = lambda line: None,
) -> CheckedSetup | None:
    """Ask what the pressure block alone can answer, before effects are sought in it.

    `alone` is that block, recalibrated. Returns the set-up with `evidence` of all blocks corrected;
    or None, where nothing of the pressure block alone is the whole cause and the only one.
    """
    if not alone.unexplained:
        return None
    setup = CheckedSetup(replace(alone, evidence=evidence), tuple(train), tuple(holdout))
    restored = _restore_commands(setup, alone, progress)
    if restored.findings:
        return restored
    at_bound = alone.at_bound
    own = [s for s in list_suspects(evidence, at_bound) if s.blocks == {PRESSURE}]
    if not any(f.is_good and _is_worth_saying(f) for f in _fit_most_promising(alone, own, effects)):
        return None
    found = _find_best(alone, effects)  # beside all others that the pressure shows
    if found is None:
        return None
    best, rivals = found
    labels = {s.label for s in own}
    if rivals or not best.is_good or not {best.suspect.label, *best.equal_suspects} <= labels:
        return None
    finding = _word_finding(best, rivals, corrected=True)
    progress(f"set-up: {finding.text}")
    return replace(_correct(setup, best), findings=(finding,))


def _restore_commands(
    setup: CheckedSetup, base: Model, progress: Callable[[str], None]
) -> CheckedSetup:
    """Return the set-up with the commands restored that the log has not as they were given.

    Where that leaves more than noise, the lost ones are the reason, and nothing else can be asked.
    `base` may be the pressure block alone.
    """
    fitted = fit_late_commands(base) or fit_decimation(base)
    if fitted is None:
        return setup
    finding = _word_finding(fitted, (), corrected=True)
    progress(f"set-up: {finding.text}")
    setup = replace(_correct(setup, fitted), findings=(*setup.findings, finding))
    if PRESSURE not in setup.base.unexplained:
        return setup
    lost = "; what was given between is lost, and nothing more can be concluded. To mend it: "
    text = f"{finding.text[:1].upper()}{finding.text[1:]}{lost}{finding.how_to_mend}"
    return replace(setup, refusal=text)


def is_refuted_by(fitted: SuspectFit, model: Model) -> bool:
    """Tell whether a model with effects leaves clearly less than a suspect."""
    base, blocks = fitted.base, _blocks_of(fitted)
    low, _ = held_out_margins(model.residuals, fitted.residuals, base, blocks)
    return bool(model.effects) and (low > MUCH or is_second_alone(_mix_blocks(fitted, model)))


def _mix_blocks(fitted: SuspectFit, model: Model) -> list[Mixture]:
    """Return the best mixture of a suspect and a model with effects in each block, held out."""
    base = fitted.base
    return [
        mix_models(
            fitted.residuals[b] / base.floors[b].mean,
            model.residuals[b] / base.floors[b].mean,
            float(np.median(base.evidence.holdout[b][0].step_s)),
        )
        for b in _blocks_of(fitted)
    ]


def fit_hidden_setups(
    base: Model, model: Model, equals: Sequence[str]
) -> tuple[tuple[SuspectFit, ...], tuple[SetupFinding, ...]]:
    """Return the suspects that promised nothing and leave no more than a model with effects.

    They are not corrected: the model's effects, and those of `equals`, explain the data as well.
    """
    asked = list_suspects(base.evidence, {*base.at_bound})
    hidden = [s for s in asked if _may_matter(base, s) and (s.label in GEOMETRY or s.kind == "bow")]
    fits = [_fit_from_doses(base, s) for s in hidden]
    kept = tuple(f for f in fits if _is_worth_saying(f) and not is_refuted_by(f, model))
    names = tuple(dict.fromkeys((*model.names, *equals)))
    return kept, tuple(_word_finding(f, names, corrected=False) for f in kept)


def _fit_from_doses(base: Model, suspect: Suspect) -> SuspectFit:
    """Fit a suspect from its small doses too, where derivatives say nothing of it."""
    near = _fit(base, _score(base, suspect))
    doses = (suspect.scale, -suspect.scale)
    return min((near, *(fit_suspect(base, suspect, d, is_near=True) for d in doses)), key=_left)


def correct_whole_cause(
    setup: CheckedSetup, fits: Sequence[SuspectFit], model: Model
) -> CheckedSetup | None:
    """Return the set-up corrected by the suspect that explains all, and more than a model does.

    None if there is no such suspect: the effects of the model are then as good.
    """
    whole = sorted((f for f in fits if f.is_good and _refutes(f, model)), key=_left)
    if not whole:
        return None
    best = replace(whole[0], equal_suspects=_list_equals(whole))
    corrected = _correct(setup, best)
    if corrected.base.unexplained:
        return None
    return replace(corrected, findings=(_word_finding(best, (), corrected=True),))


def _refutes(fitted: SuspectFit, model: Model) -> bool:
    """Tell whether a suspect leaves clearly less than a model with effects."""
    blocks = _blocks_of(fitted)
    return held_out_margins(fitted.residuals, model.residuals, fitted.base, blocks)[0] > MUCH


def _find_best(base: Model, effects: EffectRivals) -> tuple[SuspectFit, tuple[str, ...]] | None:
    """Return the best accepted suspect, and the names of what it cannot be told from."""
    fits = [f for f in _fit_promising(base, effects) if _is_worth_saying(f)]
    if not fits:
        least = {b: effects.promise(base, b) for b in base.unexplained}
        fits = [f for f in fit_time_changes(base, least) if _is_worth_saying(f)]
    if not fits:
        return None
    fits.sort(key=_left)
    best = fits[0]
    blocks = _blocks_of(best)
    equals: list[str] = []
    for model in effects.fit(base):
        low, high = held_out_margins(best.residuals, model.residuals, base, blocks)
        mixed = _mix_blocks(best, model)
        if high < -MUCH or (all(map(model.is_explained, blocks)) and is_second_alone(mixed)):
            return None  # an effect leaves clearly less, or takes nothing of the suspect
        if low < MUCH and not (best.is_good and is_first_alone(mixed)):
            equals += model.names
    if equals and (best.suspect.is_rare or not best.is_good):
        return None  # both explain a part only: neither is said
    best = replace(best, equal_suspects=_list_equals(fits))
    return best, tuple(dict.fromkeys(equals))


def _find_what_differs(base: Model) -> SuspectFit | None:
    """Return the number that differs from record to record, where repeats are far from alike.

    What a rig does differently each time is its limit, and nothing is missing below it. But one
    number of each record may explain the difference.
    """
    far = [f for f in base.floors.values() if f.repeatability > UNLIKE * f.mean]
    if base.unexplained or not far or any(f.is_estimate for f in far):
        return None
    strict = replace(base, evidence=replace(base.evidence, repeated=()))
    worthy = sorted(filter(_is_worth_saying, fit_changes_by_record(strict)), key=_left)
    return replace(worthy[0], equal_suspects=_list_equals(worthy)) if worthy else None


def _list_equals(ranked: Sequence[SuspectFit]) -> tuple[str, ...]:
    """Return the labels of the suspects that leave no more than the first."""
    best, *others = ranked
    base, blocks = best.base, _blocks_of(best)
    labels = (
        other.suspect.label
        for other in others
        if held_out_margins(best.residuals, other.residuals, base, blocks)[0] < MUCH
    )
    return tuple(dict.fromkeys(label for label in labels if label != best.suspect.label))


def _fit_promising(base: Model, effects: EffectRivals) -> list[SuspectFit]:
    """Fit the suspects that promise most."""
    wholesale = fit_wholesale(base)
    if any(f.is_good for f in wholesale):
        return wholesale
    at_bound = {name for f in base.fits.values() for name in f.at_bound}
    asked = [s for s in list_suspects(base.evidence, at_bound) if _may_matter(base, s)]
    fits = _fit_most_promising(base, asked, effects)
    if not any(f.is_good for f in fits):
        known = {f.suspect.key for f in fits}
        hidden = _list_hidden(base, asked)
        fits += [fit_suspect(base, s, _score(base, s).start) for s in hidden if s.key not in known]
    return [*fits, *wholesale]


def _list_hidden(base: Model, asked: Iterable[Suspect]) -> list[Suspect]:
    """Return the suspects to fit whatever they promise: other numbers have taken their place.

    Derivatives promise nothing of a length where a number is at its bound. A bow of the pressure
    sensor is spread over the numbers of both blocks.
    """
    is_strained = _has_strained_length(base)
    bows = len(base.unexplained) > 1 or bool(base.at_bound)
    return [s for s in asked if (is_strained and s.label in GEOMETRY) or (bows and s.kind == "bow")]


def _has_strained_length(base: Model) -> bool:
    """Tell whether every block above its limit strains its length; and the mechanics, which show a
    wrong length first. An effect of the air strains the length of the pressure block alone.
    """
    asked = {*base.unexplained, MECHANICS} & {*base.evidence.blocks}
    return all("braid_length_m" in base.fit_of(b).at_bound for b in asked)


def _fit_most_promising(
    base: Model, asked: Iterable[Suspect], effects: EffectRivals
) -> list[SuspectFit]:
    """Fit those that promise most, and not much less than an effect does."""
    least = {b: 1.0 - HOPELESS * (1.0 - effects.promise(base, b)) for b in base.unexplained}
    fits: list[SuspectFit] = []
    counts: Counter[frozenset[str]] = Counter()
    for promise in sorted((_score(base, s) for s in asked), key=lambda p: -p.explained):
        blocks = promise.suspect.blocks
        enough = max(PROMISING, min(least[b] for b in blocks if b in least))
        if promise.suspect.kind == "filtered":  # its spectrum has shown it
            enough = MUCH
        better = max((f.promised for f in fits if f.is_good), default=0.0)
        if promise.explained > max(enough, NEAR_PROMISE * better) and counts[blocks] < MOST_FITTED:
            counts[blocks] += 1
            fits.append(replace(_fit(base, promise), promised=promise.explained))
    return fits


def _score(base: Model, suspect: Suspect) -> Promise:
    return _ask_once(_PROMISES, base, suspect, lambda: score_suspect(base, suspect))


def _fit(base: Model, promise: Promise) -> SuspectFit:
    suspect = promise.suspect
    fitted = _ask_once(_FITS, base, suspect, lambda: fit_suspect(base, suspect, promise.start))
    return replace(fitted, base=base)


def _ask_once(
    known: WeakKeyDictionary[Fit, dict[Suspect, Answer]],
    base: Model,
    suspect: Suspect,
    ask: Callable[[], Answer],
) -> Answer:
    """Return the answer for a suspect of one block: that block is asked alone, then with others."""
    touched = [*reached_fits(base, suspect).values()]
    if len(touched) > 1:
        return ask()
    answers = known.setdefault(touched[0], {})
    if suspect not in answers:
        answers[suspect] = ask()
    return answers[suspect]


def _may_matter(base: Model, suspect: Suspect) -> bool:
    return bool(suspect.blocks & {*base.unexplained})


def _blocks_of(fitted: SuspectFit) -> tuple[str, ...]:
    """Return the blocks that count: those above their limit that the suspect reaches."""
    return tuple(b for b in fitted.base.unexplained if b in fitted.suspect.blocks)


def _left(fitted: SuspectFit) -> float:
    return sum(fitted.ratio(b) ** 2 for b in fitted.base.evidence.blocks)


def _is_worth_saying(fitted: SuspectFit) -> bool:
    """Tell whether a suspect explains most of a block's misfit and makes no block worse."""
    base = fitted.base
    blocks = _blocks_of(fitted)
    spoiled = [
        b
        for b in fitted.suspect.blocks
        if not fitted.is_explained(b)
        and held_out_margins(fitted.residuals, base.residuals, base, [b])[1] < 0.0
    ]
    if not (blocks and fitted.is_credible) or fitted.is_at_bound or spoiled:
        return False
    if abs(fitted.amount) < 2.0 * fitted.half:
        return False
    best = max(blocks, key=fitted.closed)
    low, _ = held_out_margins(fitted.residuals, base.residuals, base, [best])
    least = 0.0 if fitted.suspect.kind == "filtered" else MUCH  # its spectrum has shown it
    return low > least and (fitted.is_explained(best) or fitted.closed(best) >= LEAST_CLOSED)


def _word_finding(fitted: SuspectFit, effects: tuple[str, ...], *, corrected: bool) -> SetupFinding:
    suspect, base = fitted.suspect, fitted.base
    block = max(_blocks_of(fitted), key=fitted.closed)
    value, (low, high), said = fitted.value_and_interval()
    return SetupFinding(
        suspect.kind,
        suspect.number,
        value,
        (low, high),
        suspect.unit,
        block,
        base.rms[block] / rms(fitted.residuals[block]),
        fitted.ratio(block),
        tuple(dict.fromkeys((*effects, *suspect.always_equal, *fitted.equal_suspects))),
        advise_mending(suspect, value, corrected=corrected)
        + _explain_half_a_sample(suspect, value, base.evidence.holdout[block][0]),
        describe(suspect, value, said),
        said,
        fitted.by_record,
        corrected,
    )


def _explain_half_a_sample(suspect: Suspect, value: float, drive: Drive) -> str:
    """Say what an input looks like that a converter held: half a sample early."""
    half_s = 0.5 * float(np.median(drive.step_s))
    is_input = suspect.kind == "skew" and suspect.number != drive.channel
    if not is_input or abs(value + half_s) > 0.1 * half_s:
        return ""
    return "; that is half a sample: each value was held until the next, where a line was assumed"


def _correct(setup: CheckedSetup, fitted: SuspectFit) -> CheckedSetup:
    """Correct plant, drives and records, and recalibrate."""
    suspect, evidence = fitted.suspect, setup.base.evidence
    nominal = evidence.nominal
    train, holdout = (
        tuple(mend_record(r, suspect, fitted.amount, nominal) for r in records)
        for records in (setup.train, setup.holdout)
    )
    if suspect.number == AREA:
        turned = with_values(nominal, {AREA: -value_of(nominal, AREA)})
        changed = replace(evidence, nominal=turned, together={})
    elif suspect.kind in ("sign", "gauge") and {id(r) for r in setup.train}.isdisjoint(
        map(id, setup.holdout)
    ):
        # Where the records rest depends on the column, and with it what is known of noise.
        changed = prepare_evidence(train, holdout, nominal)
        changed = replace(changed, holdout=_keep_parts(changed.holdout, evidence.holdout))
    elif suspect.kind == "plant_constant":
        changed = _correct_constant(evidence, suspect, fitted.amount)
    else:
        changed = replace(
            evidence,
            train={b: tuple(map(fitted.apply, d)) for b, d in evidence.train.items()},
            holdout={b: tuple(map(fitted.apply, d)) for b, d in evidence.holdout.items()},
            balance=tuple(map(fitted.apply, evidence.balance)),
            together={},
        )
        if suspect.kind == "filtered" and fitted.is_good:
            changed = replace(changed, noises=_read_filtered_noise(fitted))
    return replace(
        setup,
        base=weigh_blocks(recalibrate(changed)),
        train=train,
        holdout=holdout,
    )


def _read_filtered_noise(fitted: SuspectFit) -> dict[str, Noise]:
    """Return the noises; a filtered channel's is what is left, where nothing else shows it."""
    evidence, column = fitted.base.evidence, fitted.suspect.number
    known = evidence.noises[column]
    if known.is_known:
        return evidence.noises
    (block,) = fitted.suspect.blocks
    drives = evidence.holdout[block]
    left = fitted.residuals[block] * drives[0].deviation
    pieces = np.split(left, np.cumsum([d.samples for d in drives])[:-1])
    return {**evidence.noises, column: estimate_from_residual(pieces, known)}


def _spoils_coupled(before: Model, after: Model) -> bool:
    """Tell whether a correction makes every coupled signal worse.

    A block alone may take a wrong neighbour for its cause. Driven by the command alone, the whole
    rig shows that nothing has become better.
    """
    old, new = map(_measure_coupled, (before, after))
    return all(new[c] > WORSE * old[c] + SMALLEST_MISFIT[c] for c in old)


def _measure_coupled(model: Model) -> dict[str, float]:
    plant = with_values(model.evidence.nominal, model.values)
    return simulate_held_out(model.evidence, plant).measure_rms(model.evidence)


def _keep_parts(drives: _Drives, before: _Drives) -> dict[str, tuple[Drive, ...]]:
    """Return drives that serve for the same part of the data as those before: what confirms
    must not choose.
    """
    return {
        block: tuple(replace(d, part=b.part) for d, b in zip(some, before[block], strict=True))
        for block, some in drives.items()
    }


def _correct_constant(evidence: Evidence, suspect: Suspect, amount: float) -> Evidence:
    before = value_of(evidence.nominal, suspect.number)
    after = before * (1.0 + amount)
    nominal = with_values(evidence.nominal, {suspect.number: after})
    if suspect.number != ATMOSPHERE:
        return replace(evidence, nominal=nominal, together={})

    shift = after - before if suspect.variant == "gauge" else 0.0

    def move(drives: Iterable[Drive]) -> tuple[Drive, ...]:
        moved = []
        for drive in drives:
            start = after if drive.start == before else drive.start + shift
            if drive.block == PRESSURE:
                drive = replace(drive, start=start, measured=drive.measured + shift)
            else:
                drive = replace(drive, driven=drive.driven + shift)
            moved.append(drive)
        return tuple(moved)

    return replace(
        evidence,
        nominal=nominal,
        train={b: move(d) for b, d in evidence.train.items()},
        holdout={b: move(d) for b, d in evidence.holdout.items()},
        together={},
    )
