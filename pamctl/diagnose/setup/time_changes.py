"""Numbers that change with time: from record to record, within a record, or at an instant.

To first order the answer to a number that acts for a part of the time only is that part of the
answer to the number itself. One simulation a number is enough to try every profile in time; what
promises most is then simulated as it would be.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pamctl.diagnose.fitting.block_fit import Fit, find_change, fit_numbers, project_out
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE, Drive, stack_residuals
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.numbers import (
    list_plant_numbers,
    numbers_of_effect,
    unit_of,
    value_of,
)
from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.setup.suspects import OF_RECORD, UNITS, Suspect
from pamctl.diagnose.setup.weighed_fit import (
    MUCH,
    SuspectFit,
    find_excess,
    fit_suspect,
    held_out_margins,
    score_suspect,
    weights_of,
)

PROMISING = 0.5
"""Share of what is left above the floor that a profile must promise to be fitted."""
NEAR_BEST = 0.7
"""A profile that promises a smaller share of what the best one promises is not fitted."""
INSTANTS = 24
"""Instants of a record that are tried first."""
REFINED, REFINEMENTS = 4, 5
"""Instants that are simulated between two of those, and how often."""
MOST_OF_A_WAY = 2
"""Numbers that are fitted for each way of changing."""
FAR, FAR_PROMISE = 3.0, 0.1
"""In a block that is left so many times its floor a drift is fitted for this promise."""
ALIKE = 1.02
"""Records whose lengths differ by less have one clock: a share of them is a time."""
CLEAR = 0.6
"""Not where an effect promises so much."""
ROUNDS = 3

_NUMBERS: dict[str, tuple[tuple[str, float], ...]] = {
    # name, and a small step: a share, or an amount of an effect
    PRESSURE: (
        ("valve_gain_m2_per_v", 1e-2),
        ("tank_pressure_pa", 1e-2),
        ("valve_v", 0.01),
        ("chamber_leak.area_m2", 3e-9),
    ),
    MECHANICS: (
        ("stiffness_n_per_m", 1e-2),
        ("damping_n_s_per_m", 1e-2),
        ("kinetic_friction_per_m", 1e-2),
        ("external_load.force_n", 0.5),
        ("coulomb_friction.force_n", 0.5),
    ),
}

_OF_MECHANISM = frozenset({"coulomb_friction.force_n"})
"""A muscle has its braid's friction in place of these."""


@dataclass(frozen=True)
class _Profile:
    """A number and when it acts, with what that promises."""

    suspect: Suspect
    explained: float
    start: float
    by_record: bool = False

    @property
    def way(self) -> tuple[str, bool]:
        """The way in which the number changes."""
        return self.suspect.kind, self.by_record


def fit_time_changes(base: Model, least: Mapping[str, float]) -> list[SuspectFit]:
    """Return the fits of the most promising changes over time.

    `least` is what they must promise, by block.
    """
    found = _rank_profiles(base)
    chosen = _choose_profiles(base, [p for block, p in found if p.explained > least[block]])
    fits = [_fit_profile(base, p) for p in chosen]
    if not any(f.is_good for f in fits):
        far = [b for b in base.unexplained if base.ratio(b) > FAR and least[b] < CLEAR]
        drifts = _list_far_drifts([p for block, p in found if block in far])
        fits += [_fit_profile(base, p) for p in drifts if p not in chosen]
    return [f for f in fits if not _acts_always(f)]


def fit_changes_by_record(base: Model) -> list[SuspectFit]:
    """Return the fits of the most promising numbers that differ from record to record."""
    profiles = [p for _, p in _rank_profiles(base) if p.by_record]
    return [_fit_profile(base, p) for p in _choose_profiles(base, profiles)]


def _rank_profiles(base: Model) -> list[tuple[str, _Profile]]:
    """Return every profile with its block, the most promising first."""
    found = [(b, p) for b in base.unexplained for p in _list_profiles(base, b)]
    return sorted(found, key=lambda pair: -pair[1].explained)


def _choose_profiles(base: Model, ranked: Sequence[_Profile]) -> list[_Profile]:
    """Return those to fit: of each way of changing a few numbers.

    The records may be too alike in length to tell per second from per record: both are fitted.
    """
    chosen: list[_Profile] = []
    enough = NEAR_BEST * ranked[0].explained if ranked else 0.0
    for profile in (p for p in ranked if p.explained > enough):
        (block,) = profile.suspect.blocks
        if profile.explained < PROMISING * find_excess(base, base.fit_of(block)):
            continue
        alike = [p.suspect for p in chosen if p.way == profile.way]
        keys, numbers = {s.key for s in alike}, {s.number for s in alike}
        is_few = len(numbers | {profile.suspect.number}) <= MOST_OF_A_WAY
        if profile.suspect.key not in keys and is_few:
            chosen.append(profile)
    return chosen


def _list_far_drifts(ranked: Sequence[_Profile]) -> list[_Profile]:
    """Return the drifts that may explain a block which friction has led far from the truth.

    To first order they promise little there. Where several records were fitted, the drift is that
    from the start to the end of each.
    """
    drifts = [p for p in ranked if p.suspect.kind == "drift" and p.suspect.over_s]
    of_record = [p for p in drifts if p.suspect.variant == OF_RECORD]
    return [p for p in of_record or drifts if p.explained > FAR_PROMISE]


def _acts_always(fitted: SuspectFit) -> bool:
    """Tell whether an effect that acts all the time does as well: then nothing has changed.

    Dry friction that begins with the first motion is dry friction.
    """
    suspect, base = fitted.suspect, fitted.base
    if "." not in suspect.number or not (suspect.over_s or suspect.after_s):
        return False
    always = replace(suspect, over_s=0.0, after_s=0.0)
    constant = fit_suspect(base, always, fitted.amount, is_near=True)
    low, _ = held_out_margins(fitted.residuals, constant.residuals, base, [*suspect.blocks])
    return low < MUCH


def _fit_profile(base: Model, profile: _Profile) -> SuspectFit:
    if profile.by_record:
        return _fit_by_record(base, profile.suspect)
    suspect = profile.suspect
    if suspect.after_s:
        suspect = _refine_instant(base, profile)
    return fit_suspect(base, suspect, profile.start, is_near=True)


def _list_profiles(base: Model, block: str) -> Iterator[_Profile]:
    fitted = base.fit_of(block)
    if not fitted.drives[0].has_position:
        return  # the whole rig runs then, and no piece of it can start from what was shown
    weight = weights_of(base, fitted)
    basis = np.linalg.qr(weight[:, None] * fitted.jacobian)[0]
    left = project_out(basis, weight * fitted.residual)
    before = float(left @ left)
    times = [_times_of(d) for d in fitted.drives]
    longest_s = max(float(t[-1]) for t in times)

    def promise(column: Array) -> tuple[float, float]:
        rest = project_out(basis, column)
        size = float(rest @ rest)
        if size < 1e-6 * before:
            return 0.0, 0.0
        dot = -float(rest @ left)
        return dot * dot / (size * before), dot / size

    for suspect, dose in _list_numbers(base, block):
        altered = [suspect.apply(d, dose) for d in fitted.drives]
        moved = weight * find_change(fitted, altered)
        clock = np.concatenate(times)
        explained, amount = promise(moved * clock / longest_s)
        yield _Profile(replace(suspect, over_s=longest_s), explained, amount * dose)
        if len(times) > 1:
            explained, amount = promise(moved * np.concatenate([t / t[-1] for t in times]))
            drift = replace(suspect, over_s=1.0, variant=OF_RECORD)
            yield _Profile(drift, explained, amount * dose)
        yield from _list_instants(fitted, suspect, dose, moved, times, basis, left)
        held_out = base.evidence.holdout[block]
        if len(times) == 1 and {d.name for d in held_out} != {fitted.drives[0].name}:
            # With one record to fit, only the held-out ones can differ from it.
            altered = [suspect.apply(d, dose) for d in held_out]
            unlike = base.residuals[block]
            answer = stack_residuals(altered, fitted.settings) - unlike
            size = float(answer @ answer) * float(unlike @ unlike)
            explained = float(answer @ unlike) ** 2 / size if size else 0.0
            yield _Profile(suspect, explained, 0.0, by_record=True)
        names = [d.name for d in fitted.drives]
        if len(names) > 1:
            marks = np.concatenate([np.full(len(t), i) for i, t in enumerate(times)])
            columns = np.column_stack(
                [project_out(basis, moved * (marks == i)) for i in range(len(names))]
            )
            amounts = np.linalg.lstsq(columns, -left, rcond=1e-8)[0]
            after = left + columns @ amounts
            yield _Profile(suspect, 1.0 - float(after @ after) / before, 0.0, by_record=True)


def _times_of(drive: Drive) -> Array:
    return drive.times_s if drive.rows is None else drive.times_s[drive.rows]


def _list_numbers(base: Model, block: str) -> Iterator[tuple[Suspect, float]]:
    fitted, evidence = base.fit_of(block), base.evidence
    acting = list_plant_numbers(evidence.nominal)
    for name, step in _NUMBERS[block]:
        if name in _OF_MECHANISM and evidence.reach is None:
            continue
        low, high, unit = -0.8, 3.0, UNITS.get(name, "V")
        if "." in name:
            effect, number = name.split(".")
            (known,) = numbers_of_effect(effect, {number}, evidence.nominal, evidence.reach)
            low, high, unit = known.low, known.high, unit_of(known)
            if evidence.reach is not None:  # of a mechanism of any size
                step = known.scale
            if getattr(fitted.settings.effects, effect) is None and low == 0.0:
                low = 1e-3 * step
        elif name != "valve_v" and not (name in acting and value_of(evidence.nominal, name) != 0.0):
            continue
        yield (
            Suspect("drift", name, unit, low, high, (step,), step, frozenset({block})),
            step,
        )


def _list_instants(
    fitted: Fit,
    suspect: Suspect,
    dose: float,
    moved: Array,
    times: Sequence[Array],
    basis: Array,
    left: Array,
) -> Iterator[_Profile]:
    """Yield the best instant at which the number changes: of all records or one, and as a share."""
    clock = np.concatenate(times)
    shares = np.concatenate([t / t[-1] for t in times])
    marks = np.concatenate([np.full(len(t), i) for i, t in enumerate(times)])
    lengths_s = [float(t[-1]) for t in times]
    of_one = [(d.name, "", clock, marks == i) for i, d in enumerate(fitted.drives)]
    of_all = np.ones(len(clock), bool)
    several = [("", "", clock, of_all), *(of_one if len(times) > 1 else [])]
    if max(lengths_s) > ALIKE * min(lengths_s):
        several.append(("", OF_RECORD, shares, of_all))
    best: dict[str, _Profile] = {}
    products = np.column_stack([moved * left, moved**2, moved[:, None] * basis])
    before = float(left @ left)
    for record, variant, when, own in several:
        instants = np.linspace(0.0, float(when[own].max()), INSTANTS + 2)[1:-1]
        # What acts from an instant on is the sum of all that lies behind it.
        bins = np.searchsorted(instants, when[own], side="right")
        summed = np.column_stack(
            [np.bincount(bins, column, INSTANTS + 1) for column in products[own].T]
        )
        behind = np.cumsum(summed[::-1], axis=0)[::-1][1:]
        sizes = behind[:, 1] - np.sum(behind[:, 2:] ** 2, axis=1)
        seen = sizes > 1e-6 * before
        explained = np.where(seen, behind[:, 0] ** 2 / np.where(seen, sizes * before, 1.0), 0.0)
        place = int(np.argmax(explained))
        if variant not in best or explained[place] > best[variant].explained:
            changed = replace(
                suspect,
                kind="change_at_instant",
                record=record,
                variant=variant,
                after_s=float(instants[place]),
            )
            start = -float(behind[place, 0] / max(sizes[place], 1e-30)) * dose
            best[variant] = _Profile(changed, float(explained[place]), start)
    yield from best.values()


def _refine_instant(base: Model, profile: _Profile) -> Suspect:
    """Return the suspect at the instant that explains most when it is simulated."""
    suspect = profile.suspect
    own = [d for d in base.fit_of(next(iter(suspect.blocks))).drives
           if suspect.record in ("", d.name)]  # fmt: skip
    longest_s = max(float(_times_of(d)[-1]) for d in own)
    width_s = (1.0 if suspect.variant == OF_RECORD else longest_s) / (INSTANTS + 1)
    for _ in range(REFINEMENTS):
        tried = [
            replace(suspect, after_s=float(s), doses=(profile.start,))
            for s in suspect.after_s + np.linspace(-1.0, 1.0, REFINED + 1) * width_s
            if s > 0.0
        ]
        suspect = max(tried, key=lambda s: score_suspect(base, s).explained)
        width_s *= 2.0 / REFINED
    return suspect


def _fit_by_record(base: Model, suspect: Suspect) -> SuspectFit:
    """Fit a number of each record, held-out ones too, in turn with what all records share.

    One number of a whole record is fitted to thousands of samples: what it takes from a held-out
    record is nothing beside the noise.
    """
    (block,) = suspect.blocks
    fitted = base.fit_of(block)
    blocks = next(b for b in base.fits if block in b)
    drives = (*fitted.drives, *base.evidence.holdout[block])
    amounts = dict.fromkeys((d.name for d in drives), 0.0)
    settings = fitted.settings
    for _ in range(ROUNDS):
        for drive in drives:
            amounts[drive.name] = _fit_amount(drive, settings, suspect, amounts[drive.name])
        middle = float(np.mean([*amounts.values()]))
        amounts = {name: a - middle for name, a in amounts.items()}
        altered = [suspect.apply(d, amounts[d.name]) for d in fitted.drives]
        refit = fit_numbers(altered, settings, fitted.free)
        settings = refit.settings
    span = max(amounts.values()) - min(amounts.values())
    return SuspectFit(base, suspect, span, 0.1 * span, {blocks: refit}, by_record=amounts)


def _fit_amount(drive: Drive, settings: object, suspect: Suspect, amount: float) -> float:
    """Return the amount that fits one record best, by Gauss-Newton steps."""
    for _ in range(3):
        here = stack_residuals([suspect.apply(drive, amount)], settings)  # type: ignore[arg-type]
        there = stack_residuals(
            [suspect.apply(drive, amount + suspect.scale)],
            settings,  # type: ignore[arg-type]
        )
        slope = (there - here) / suspect.scale
        size = float(slope @ slope)
        if size == 0.0:
            return amount
        change = -float(slope @ here) / size
        amount = float(np.clip(amount + change, suspect.low, suspect.high))
        if abs(change) < 0.02 * suspect.scale:
            break
    return amount
