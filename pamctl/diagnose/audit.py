"""Step 1, audit: what an excitation cannot show, and what it cannot tell apart.

Every effect is simulated at its smallest size of interest. What recalibration can imitate is
removed, and the rest is compared with the floor: below the limit the effect is a blind spot. Of
a pair of effects, one is simulated and the other fitted: if less than the limit is left, this
excitation does not tell them apart. For example, the paper's full-scale squares cannot show a
dead band of the valve: |u| is always 5 V, and the valve's gain absorbs the dead band.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import inf

import numpy as np

from pamctl.diagnose.experiments import find_separating_experiment
from pamctl.diagnose.fitting.block_fit import Fit, find_secants, project_out
from pamctl.diagnose.fitting.candidates import (
    Candidate,
    apply_dose,
    list_candidates,
    list_forms,
)
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE
from pamctl.diagnose.fitting.evidence import prepare_evidence, with_modelled_pressure
from pamctl.diagnose.fitting.fitted_model import Model, extract_block_fit
from pamctl.diagnose.fitting.model_fit import recalibrate
from pamctl.diagnose.fitting.numbers import FreeNumber, look_up_parameter, unit_of, value_of
from pamctl.diagnose.measured.quality_rules import leave_out_unused
from pamctl.diagnose.measured.record import Array, Record
from pamctl.diagnose.measured.refuse import check_measured_runs, check_sensors
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.model import PlantSettings, plant_parameters

INERT = 1e-9
"""An effect that uses a smaller share of the room below the limit changes nothing."""
_BLOCKS_OF = {"direct": (MECHANICS, "sensors"), "chamber": (PRESSURE, "sensors")}
"""The blocks that an actuator has; a muscle has all. What it lacks is no blind spot."""


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

    def as_dict(self) -> dict[str, object]:
        """Return what the document holds."""
        size, unit = self.visible_from or (None, None)
        return {
            "name": self.name,
            "why": f"{self.why}; {self.visibility}",
            "experiment": self.experiment,
            "visible_from": size,
            "unit": unit,
        }


@dataclass(frozen=True)
class Inseparable:
    """Two effects of which one explains the other down to the floor."""

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

    def advise_beyond(self, experiment: str) -> Audit:
        """Return the same findings; no advice repeats an experiment that was run already."""
        spots = (
            replace(s, experiment="") if s.experiment == experiment else s for s in self.blind_spots
        )
        pairs = (_advise_pair(pair.names, (experiment,)) for pair in self.inseparable)
        return Audit(self.sees, tuple(spots), tuple(pairs), self.unasked)

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
        }


def audit_run(record: Record, plant: PlantSettings) -> Audit:
    """Audit one record, measured or simulated; raises `BadData`."""
    (record,), _ = leave_out_unused([record], plant)
    check_measured_runs([record], plant)
    evidence = prepare_evidence([record], [record], plant)
    check_sensors([record], evidence.noises, plant)
    candidates = list_candidates(evidence)
    if {*evidence.blocks} != {PRESSURE, MECHANICS}:
        found = audit_model(recalibrate(evidence), candidates)
        return found.advise_beyond(record.experiment)
    alone = recalibrate(evidence.select_blocks({PRESSURE}))
    clean, trusted = alone.fit_of(PRESSURE).settings, alone.is_explained(PRESSURE)
    driven = with_modelled_pressure(evidence, [record], [record], clean, trusted=trusted)
    found = audit_model(recalibrate(driven, alone.fits), candidates)
    return found.advise_beyond(record.experiment)


def audit_model(model: Model, candidates: Sequence[Candidate], *, pairs: bool = True) -> Audit:
    """Audit the training records of a model that is at its floor, or near it.

    The first form of an effect stands for all its forms.
    """
    not_fitted = _list_not_fitted(model)
    firsts = {c.name: c for c in reversed((*candidates, *not_fitted))}
    doses = {
        block: _simulate_doses(model, block, firsts.values()) for block in model.evidence.blocks
    }
    spare = {block: _room_below_limit(model, block) for block in model.evidence.blocks}
    powers = {
        name: max(
            (_column_rms(d[name]).min() / spare[block] for block, d in doses.items() if name in d),
            default=0.0,
        )
        for name in firsts
    }
    mere = {c.name for c in not_fitted}
    sees = tuple(name for name, power in powers.items() if power > 1.0 and name not in mere)
    # What moves nothing at all is no part of another actuator than the muscle.
    is_muscle = model.evidence.nominal.actuator == "muscle"
    blind = [
        _describe_blind_spot(c, powers[n])
        for n, c in firsts.items()
        if n not in (*sees, *mere) and (is_muscle or powers[n] > INERT)
    ]
    blind += [_describe_not_fitted(c, powers[c.name], model) for c in not_fitted]
    blind += _list_unseen_effects(model, candidates)
    alike = _find_inseparable_pairs(doses, spare, sees) if pairs else []
    told = {*sees, *(spot.name for spot in blind)}
    unasked = tuple((n, _explain_unasked(n, model)) for n in CATALOGUE if n not in told)
    return Audit(sees, tuple(blind), tuple(map(_advise_pair, alike)), unasked)


def _find_inseparable_pairs(
    doses: Mapping[str, Mapping[str, Array]], spare: Mapping[str, float], sees: Sequence[str]
) -> list[tuple[str, str]]:
    """Return the pairs in which one effect explains the other down to the limits."""

    def explains(other: str, one: str) -> bool:
        return all(
            _unexplained_rms(d[one], d.get(other)) <= spare[block]
            for block, d in doses.items()
            if one in d
        )

    return [(a, b) for a, b in combinations(sees, 2) if explains(a, b) or explains(b, a)]


def _unexplained_rms(hidden: Array, fitted: Array | None) -> float:
    """Return the RMS that is left of an effect's strongest dose when another effect is fitted."""
    strongest = hidden[:, int(np.argmax(_column_rms(hidden)))]
    if fitted is None:
        return float(np.sqrt(np.mean(strongest**2)))
    return float(np.sqrt(np.mean(project_out(np.linalg.qr(fitted)[0], strongest) ** 2)))


def _column_rms(columns: Array) -> Array:
    values: Array = np.sqrt(np.mean(columns**2, axis=0))
    return values


def _advise_pair(pair: tuple[str, str], without: Sequence[str] = ()) -> Inseparable:
    advice = find_separating_experiment(pair, without)
    return Inseparable(pair, str(advice["name"]), str(advice["why"]))


def _room_below_limit(model: Model, block: str) -> float:
    """Return how much a misfit may add before the limit is passed, in deviations of the sensor."""
    floor = model.floors[block]
    return float(np.sqrt(floor.limit**2 - floor.mean**2))


def _simulate_doses(model: Model, block: str, candidates: Iterable[Candidate]) -> dict[str, Array]:
    """Simulate the smallest sizes of interest, without what recalibration can imitate.

    Returns arrays of shape (n, doses) by name, in deviations of the sensor.
    """
    fitted = extract_block_fit(model.fit_of(block), block)
    basis = np.linalg.qr(fitted.jacobian)[0] if fitted.free else np.zeros((len(fitted.residual), 0))
    return {
        c.name: project_out(basis, find_secants(fitted, _list_smallest_doses(c, fitted)))
        for c in candidates
        if block in c.blocks
    }


def _list_smallest_doses(candidate: Candidate, fitted: Fit) -> list[dict[str, float]]:
    """List each switch alone, and all together: two equal widths may hide where one shows."""
    held = dict(candidate.held)
    sizes = {
        s.name: apply_dose(s, 1.0, value_of(fitted.settings, s.name)) for s in candidate.switches
    }
    alone_each = [{**held, name: size} for name, size in sizes.items()]
    return [*alone_each, {**held, **sizes}] if len(sizes) > 1 else alone_each


def _describe_blind_spot(candidate: Candidate, power: float) -> BlindSpot:
    switch = candidate.switches[0]
    size = switch.scale
    effect = CATALOGUE[candidate.name]
    dose = f"{size:g} {unit_of(switch)}".rstrip()
    if neutral := look_up_parameter(switch.name).neutral:
        dose += f" away from {neutral:g}"
    why = f"a size of {dose} stays below the floor's limit"
    visible_from = _find_visible_size(switch, size, power)
    sizes = 1.0 / power if visible_from else inf
    return BlindSpot(candidate.name, why, effect.best_experiment, visible_from, sizes)


def _find_visible_size(switch: FreeNumber, size: float, power: float) -> tuple[float, str] | None:
    """Return the size that just passes the limit, in proportion; None beyond its range."""
    if power <= 0.0 or size / power > max(abs(switch.high), abs(switch.low)):
        return None
    return size / power, unit_of(switch)


def _list_not_fitted(model: Model) -> tuple[Candidate, ...]:
    """Return the effects that no diagnosis fits, where these records drive their block."""
    evidence = model.evidence
    return tuple(
        form
        for effect in CATALOGUE.values()
        if effect.unidentifiable
        and evidence.nominal.actuator in effect.actuators
        and effect.name not in evidence.nominal.acting
        for form in list_forms(effect, evidence)
    )


def _describe_not_fitted(candidate: Candidate, power: float, model: Model) -> BlindSpot:
    """Say of an effect that no diagnosis fits whether it would show here, and from which size."""
    explain = CATALOGUE[candidate.name].unidentifiable
    assert explain is not None
    because = explain(plant_parameters(model.evidence.nominal).paper)
    spot = _describe_blind_spot(candidate, power)
    if power <= 1.0:
        return replace(spot, why=f"{spot.why}: {because}")
    return replace(spot, why=f"it is not fitted, though its smallest size would show: {because}")


def _explain_unasked(name: str, model: Model) -> str:
    """Say why an effect is neither among those that show nor among the blind spots."""
    effect, nominal = CATALOGUE[name], model.evidence.nominal
    there = _BLOCKS_OF.get(nominal.actuator, (PRESSURE, MECHANICS, "sensors"))
    if nominal.actuator not in effect.actuators or effect.block not in there:
        return f"it is no part of a plant with `actuator: {nominal.actuator}`"
    if name in nominal.acting or name in model.names:
        return "the model has it already"
    if not effect.is_searched:
        return "no candidate of the search: asked as a fault of the set-up, or of what is left"
    return "it changes nothing in these records, or was left out"


def _list_unseen_effects(model: Model, candidates: Sequence[Candidate]) -> list[BlindSpot]:
    """List effects that reach no block that these records drive."""
    examined = {c.name for c in candidates} | {*model.names}
    actuator = model.evidence.nominal.actuator
    there = _BLOCKS_OF.get(actuator)
    here = {
        name: effect
        for name, effect in CATALOGUE.items()
        if actuator in effect.actuators and (there is None or effect.block in there)
    }
    spots = []
    for name, effect in here.items():
        if name in examined or not effect.is_searched:
            continue
        if effect.block not in (*model.evidence.blocks, "sensors"):
            why = "these records do not drive its block"
            spots.append(BlindSpot(name, why, effect.best_experiment, None))
    return spots
