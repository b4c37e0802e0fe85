"""What an excitation cannot show, and what it cannot tell apart.

Every effect is simulated at its smallest size of interest. What the model's own numbers imitate
is removed, by their tangent; the rest would gain so many nats under the scales of the likelihood,
and it is seen or not. Both grow with the square of the size. An effect that gains less than a name
must, or that no channel shows, is a blind spot. Of a pair one is simulated and the other fitted: if
less than a name is left, this excitation does not tell them apart. For example, the paper's
full-scale squares cannot show a dead band of the valve: |u| is always 5 V, and the valve's gain
absorbs the dead band.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from itertools import combinations, permutations
from math import inf, sqrt

import numpy as np
from scipy.optimize import lsq_linear

from pamctl.diagnose.evidence.constants import LEFT_SHARE, NAME_NATS, SCORE_STEP_S, SEEN_SHARE
from pamctl.diagnose.evidence.fit import WeighedModel, Weigher
from pamctl.diagnose.evidence.pool import Hypothesis, list_effects
from pamctl.diagnose.evidence.weigh import (
    EvidenceVerdict,
    list_pool,
    prepare_weigher,
    scales_of,
)
from pamctl.diagnose.mend import mend_records
from pamctl.diagnose.plant_numbers import look_up_parameter
from pamctl.diagnose.record import Array, Record
from pamctl.diagnose.refuse import BadData, check_measured_runs, leave_out_unused
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.model import PlantSettings, plant_parameters, settings_of

INERT = 1e-12
"""An effect with a smaller power changes nothing: it is no part of another actuator."""
WHOLE = ("muscle", "cylinder")
"""Actuators with valve and motion: records may drive a part of them. What another one's records do
not drive it does not have."""
FULL_STEPS = ("square-1", "squares-apart")
MOST_TURNS_HZ = 2.5
"""Of steps that are held: square-1 has two turns a second."""
SINGULAR = 1e-9
ROOM = 1e-6
"""Scales; a number at its range has a little room, or there would be no range."""


@dataclass(frozen=True)
class BlindSpot:
    """An effect that the excitation does not show at its smallest size of interest."""

    name: str
    why: str
    experiment: str
    """The experiment that shows it; empty where none does."""
    visible_from: tuple[float, str] | None
    """Size and unit from which it shows, if it grows in proportion; None for never."""
    sizes: float = inf
    """The same size, in smallest sizes of interest."""

    @property
    def visibility(self) -> str:
        """Say from which size on the effect shows."""
        if self.visible_from is None:
            return "it does not show at any size"
        size, unit = self.visible_from
        return f"it shows from about {size:.2g} {unit}".rstrip()

    @property
    def reason(self) -> str:
        """Why it is blind, and from which size on the effect shows."""
        return f"{self.why}; {self.visibility}"

    def as_dict(self) -> dict[str, object]:
        """Return what the document holds."""
        size, unit = self.visible_from or (None, None)
        return {
            "name": self.name,
            "why": self.reason,
            "experiment": self.experiment,
            "visible_from": size,
            "unit": unit,
        }


@dataclass(frozen=True)
class Inseparable:
    """Two effects of which one explains the other down to the noise."""

    names: tuple[str, str]
    experiment: str
    """The experiment that tells them apart; empty where none does."""
    why: str


@dataclass(frozen=True)
class Audit:
    """What an excitation can show, and what it cannot."""

    sees: tuple[str, ...]
    blind_spots: tuple[BlindSpot, ...]
    inseparable: tuple[Inseparable, ...]
    unasked: tuple[tuple[str, str], ...] = ()
    """The other effects of the catalogue, and why they are not asked."""
    is_covered: bool = False
    """The model leaves so much of the record that this hides effects, and not the noise."""

    def advise_beyond(self, *run: str) -> Audit:
        """Return the same findings; no advice repeats an experiment that was run already."""
        spots = tuple(
            replace(s, experiment="") if s.experiment in run else s for s in self.blind_spots
        )
        pairs = tuple(_advise_pair(pair.names, *run) for pair in self.inseparable)
        return replace(self, blind_spots=spots, inseparable=pairs)

    def advise_nothing(self) -> Audit:
        """Return the same findings; no experiment would show more."""
        spots = tuple(replace(spot, experiment="") for spot in self.blind_spots)
        pairs = tuple(replace(pair, experiment="") for pair in self.inseparable)
        return replace(self, blind_spots=spots, inseparable=pairs)

    def as_dict(self) -> dict[str, object]:
        """Return plain values, for `--json`."""
        return {
            "schema": 1,
            "sees": list(self.sees),
            "blind_spots": [spot.as_dict() for spot in self.blind_spots],
            "inseparable": [
                {"names": list(p.names), "experiment": p.experiment, "why": p.why}
                for p in self.inseparable
            ],
            "unasked": [{"name": name, "why": why} for name, why in self.unasked],
            "covered": self.is_covered,
        }


def audit_run(record: Record, plant: PlantSettings) -> Audit:
    """Audit one record, measured or simulated; raises `BadData`."""
    given = [record]
    (record,), _ = leave_out_unused(given, plant)
    (record,), _ = mend_records([record])
    check_measured_runs([record], plant, given=given)
    try:
        weigher, start = prepare_weigher([record], (), plant)
    except ValueError as error:
        raise BadData(str(error)) from None
    found = audit_model(weigher, weigher.settle(start))
    if found.is_covered:
        return found.advise_nothing()
    is_known = record.is_imported and _holds_full_steps(record)
    return found.advise_beyond(record.experiment, *(FULL_STEPS if is_known else ()))


def _holds_full_steps(record: Record) -> bool:
    """Tell whether a record has steps of the largest command up and down, each held for long."""
    if record.valve_v is None:
        return False
    sizes = np.abs(record.valve_v)
    turns = np.count_nonzero(np.diff(np.sign(record.valve_v[sizes > 0.5 * sizes.max()])))
    return bool(
        np.mean(sizes > 0.9 * sizes.max()) >= 0.5 and 2 <= turns <= MOST_TURNS_HZ * record.t_s[-1]
    )


def audit_evidence(found: EvidenceVerdict, *, pairs: bool = True) -> Audit:
    """Audit the training records of a verdict, beside its extended model."""
    return audit_model(found.weigher, found.model, pairs=pairs)


def audit_model(weigher: Weigher, m: WeighedModel, *, pairs: bool = True) -> Audit:
    """Audit the training records of a fitted model."""
    plant = settings_of(weigher.base)
    has_already = {*plant.acting, *m.names}
    fitted = [
        h
        for h in list_pool(weigher.train, weigher.base, plant)
        if h.family in CATALOGUE and not {h.family, h.name} & has_already
    ]
    machine = scales_of(weigher.train, plant)
    mere = [
        h
        for h in list_effects(plant.actuator, machine, fitted=False)
        if h.family not in has_already and not weigher.train.imposed
    ]
    beside = _Beside(weigher, m)
    asked: dict[str, tuple[Hypothesis, Array]] = {}
    for h in (*fitted, *mere):
        doses = beside.push(h)
        known = asked.get(h.family)
        if known is None or beside.find_power(doses) > beside.find_power(known[1]):
            asked[h.family] = h, doses
    powers = {name: beside.find_power(doses) for name, (_, doses) in asked.items()}
    not_fitted = {h.family for h in mere}
    sees = tuple(n for n, power in powers.items() if power > 1.0 and n not in not_fitted)
    free = {number.name for number in m.numbers}
    held = {name for name, value in weigher.base.items() if value and name not in free}
    is_covered = weigher.is_much_left(m)
    lost_in = "what the plant leaves unexplained" if is_covered else "the sensors' noise"
    blind = [
        _describe_blind_spot(h, powers[n], plant, held, lost_in, is_fitted=n not in not_fitted)
        for n, (h, _) in asked.items()
        if n not in sees and (plant.actuator == "muscle" or powers[n] > INERT)
    ]
    blind += [
        BlindSpot(n, "these records do not drive its block", e.best_experiment, None)
        for n, e in CATALOGUE.items()
        if plant.actuator in WHOLE
        and plant.actuator in e.actuators
        and n not in {*asked, *has_already}
        and not e.unidentifiable
    ]
    alike = []
    if pairs:
        seen = [(n, asked[n][1]) for n in sees]
        alike = [
            _advise_pair((a, b))
            for (a, one), (b, other) in combinations(seen, 2)
            if beside.is_imitated(one, other) or beside.is_imitated(other, one)
        ]
    told = {*sees, *(spot.name for spot in blind)}
    unasked = tuple(
        (n, _explain_unasked(n, plant, has_already, asked)) for n in CATALOGUE if n not in told
    )
    return Audit(sees, tuple(blind), tuple(alike), unasked, is_covered)


class _Beside:
    """A model, and what an effect would add to its residual that its own numbers cannot take."""

    def __init__(self, weigher: Weigher, m: WeighedModel) -> None:
        assert m.tangent is not None
        self.weigher, self.m = weigher, m
        self.here = weigher.find_residual(m.values, SCORE_STEP_S)
        scales2 = m.cost.scales2[:, weigher.like.level][:, None, :]
        self.root = np.sqrt(weigher.like.keep / scales2)
        """One over the scale of each coefficient; 0 for those that do not count."""
        self.tangent = m.tangent.reshape(len(m.x), -1) * self.root.ravel()
        self.basis, self.triangle = np.linalg.qr(self.tangent.T)
        scale = np.array([n.scale for n in m.numbers])
        low, high = (np.array([getattr(n, k) for n in m.numbers]) for k in ("low", "high"))
        self.room = (low - m.x) / scale - ROOM, (high - m.x) / scale + ROOM
        noise2 = weigher.find_noise2(m)
        counts = weigher.like.counts
        robust2 = (counts * m.cost.scales2).sum(axis=1) / counts.sum(axis=1)
        seen2 = np.minimum(noise2, robust2 * SEEN_SHARE / (1.0 - SEEN_SHARE))
        left2 = weigher.like.mean_squares(m.d) - noise2
        self.least2 = np.maximum(seen2, LEFT_SHARE**2 * left2)
        """The mean square that is seen in each channel, and not small beside what is left there."""

    def push(self, hypothesis: Hypothesis) -> Array:
        """Return the smallest doses of interest, each size alone and all together, weighed.

        Shape (doses, coefficients). Two equal widths may hide where one shows.
        """
        variant = hypothesis.variants[0]
        shapes = {
            u.name: look_up_parameter(u.name).start if hypothesis.scan else u.value
            for u in variant.shapes
        }
        sizes = {}
        for u in variant.sizes:
            neutral = u.neutral or 0.0
            up = neutral + u.smallest <= u.high
            sizes[u.name] = neutral + (u.smallest if up else -u.smallest)
        off = {u.name: u.neutral or 0.0 for u in variant.sizes}
        doses = [{**off, name: size} for name, size in sizes.items()]
        doses += [sizes] if len(sizes) > 1 else []
        rows = []
        for dose in doses:
            values = {**self.m.values, **variant.held, **shapes, **dose}
            d = self.weigher.find_residual(values, SCORE_STEP_S)
            rows.append(((d - self.here) * self.root).ravel())
        return np.stack([row + self._find_move(row) @ self.tangent for row in rows])

    def _find_move(self, row: Array) -> Array:
        """Return how the model's own numbers would imitate a dose, within their ranges."""
        return np.asarray(lsq_linear(self.triangle, -self.basis.T @ row, self.room).x)

    def find_power(self, doses: Array) -> float:
        """Return how far the strongest dose is above what is sure and seen, as a square."""
        return max(map(self._weigh, doses))

    def _weigh(self, row: Array) -> float:
        d = row.reshape(self.root.shape)
        back = np.divide(d, self.root, out=np.zeros_like(d), where=self.root > 0.0)
        seen = float((self.weigher.like.mean_squares(back) / self.least2).max())
        return min(0.5 * float(row @ row) / NAME_NATS, seen)

    def is_imitated(self, hidden: Array, fitted: Array) -> bool:
        """Tell whether another effect, fitted, leaves less than a name of a dose."""
        strongest = hidden[int((hidden**2).sum(axis=1).argmax())]
        basis = _find_basis(fitted)
        left = strongest - strongest @ basis.T @ basis
        return 0.5 * float(left @ left) < NAME_NATS


def _find_basis(rows: Array) -> Array:
    """Return orthonormal rows that span the same."""
    values, vectors = np.linalg.eigh(rows @ rows.T)
    kept = values > SINGULAR * max(float(values[-1]), 1e-300)
    return np.asarray((vectors[:, kept] / np.sqrt(values[kept])).T @ rows)


def _advise_pair(pair: tuple[str, str], *without: str) -> Inseparable:
    advice = find_separating_experiment(pair, without)
    return Inseparable(pair, str(advice["name"]), str(advice["why"]))


def _describe_blind_spot(
    hypothesis: Hypothesis,
    power: float,
    plant: PlantSettings,
    held: set[str],
    lost_in: str,
    *,
    is_fitted: bool,
) -> BlindSpot:
    effect, size = CATALOGUE[hypothesis.family], hypothesis.variants[0].sizes[0]
    number = size.name.rpartition(".")[2]
    p = next((p for p in effect.parameters if p.name == number), effect.parameters[0])
    same = effect.same_as.get(plant.actuator, ())
    if same and not {*same} & held:
        why = f"no record shows it: it does the same as another {' and '.join(same)}"
        return BlindSpot(effect.name, why, "", None)
    unit = "" if p.unit == "1" else p.unit
    dose = f"{size.smallest:g} {unit}".rstrip()
    if size.neutral:
        dose += f" away from {size.neutral:g}"
    why = f"a size of {dose} is lost in {lost_in}"
    if effect.unidentifiable and not is_fitted:
        because = effect.unidentifiable(plant_parameters(plant).paper)
        why = f"{why}: {because}"
        if power > 1.0:
            why = f"it is not fitted, though its smallest size would show: {because}"
    needed = size.smallest / sqrt(power) if power > 0.0 else inf
    if needed > max(abs(size.high), abs(size.low)):
        return BlindSpot(effect.name, why, effect.best_experiment, None)
    return BlindSpot(effect.name, why, effect.best_experiment, (needed, unit), 1.0 / sqrt(power))


def _explain_unasked(
    name: str, plant: PlantSettings, has_already: set[str], asked: Collection[str]
) -> str:
    """Say why an effect is neither among those that show nor among the blind spots."""
    if plant.actuator not in CATALOGUE[name].actuators:
        return f"it is no part of a plant with `actuator: {plant.actuator}`"
    if name in has_already:
        return "the model has it already"
    if name in asked:
        return "it changes nothing here"
    return "this plant and its records have nothing that it acts on"


def find_separating_experiment(
    names: Iterable[str], without: Collection[str] = ()
) -> dict[str, object]:
    """Return the experiment that tells these effects apart, and why.

    Experiments in `without` were run already; the name is empty where no other one serves.
    """
    wanted = sorted(names)
    for one, other in permutations(wanted, 2):
        told = CATALOGUE[one].told_from.get(other)
        if told and told.experiment not in without:
            return {"name": told.experiment, "separates": sorted((one, other)), "why": told.why}
    for effect in map(CATALOGUE.__getitem__, wanted):
        if effect.best_experiment and effect.best_experiment not in without:
            why = f"it shows {effect.name} best: {effect.signature}"
            return {"name": effect.best_experiment, "separates": wanted, "why": why}
    return {"name": "", "separates": wanted, "why": "no shipped experiment separates them"}


def find_showing_experiment(name: str) -> dict[str, object]:
    """Return the experiment that shows an effect best."""
    effect = CATALOGUE[name]
    why = f"these records cannot show {name.replace('_', ' ')}: {effect.signature}"
    return {"name": effect.best_experiment, "separates": [name], "why": why}
