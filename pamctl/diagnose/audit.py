"""What an excitation cannot see, and what it cannot tell apart, before any fit.

Every effect is dosed at its smallest size of interest, recalibration takes what it can,
and the rest is held against the floor: below the limit the effect is in a blind spot. Of
two effects, the one is hidden and the other fitted: if less than the limit is left, this
excitation does not tell them apart. The paper's full-scale squares, for instance, cannot
see a dead band of the valve at all: |u| is always 5 V, and the valve's gain absorbs it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import inf

import numpy as np

from pamctl.diagnose.experiments import find_separating_experiment
from pamctl.diagnose.fitting.block_fit import Fit
from pamctl.diagnose.fitting.candidates import Candidate, apply_dose, list_candidates
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE
from pamctl.diagnose.fitting.evidence import prepare_evidence, with_modelled_pressure
from pamctl.diagnose.fitting.fitted_model import Model, extract_block_fit, recalibrate
from pamctl.diagnose.fitting.numbers import FreeNumber, look_up_parameter, unit_of, value_of
from pamctl.diagnose.measured.record import Array, Record
from pamctl.diagnose.measured.refuse import check_measured_runs, check_sensors
from pamctl.diagnose.naming.score import project_out, secant
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.model import PlantSettings


@dataclass(frozen=True)
class BlindSpot:
    """An effect that the excitation does not show at its smallest size of interest."""

    name: str
    why: str
    experiment: str
    """What would show it; empty where nothing would."""
    visible_from: tuple[float, str] | None
    """Size and unit from which it would show, if it grows in proportion; None for never."""
    sizes: float = inf
    """The same, in smallest sizes of interest."""

    @property
    def visibility(self) -> str:
        """Say from which size on it shows."""
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
    why: str


@dataclass(frozen=True)
class Audit:
    """What an excitation is good for."""

    sees: tuple[str, ...]
    blind_spots: tuple[BlindSpot, ...]
    inseparable: tuple[Inseparable, ...]

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
        }


def audit_run(record: Record, plant: PlantSettings) -> Audit:
    """Audit one record, measured or simulated; raises `BadData`."""
    check_measured_runs([record], plant)
    evidence = prepare_evidence([record], [record], plant)
    check_sensors([record], evidence.noises)
    found = list_candidates(evidence)
    if {*evidence.blocks} != {PRESSURE, MECHANICS}:
        return audit_model(recalibrate(evidence), found)
    alone = recalibrate(evidence.select_blocks({PRESSURE}))
    clean, trusted = alone.fit_of(PRESSURE).settings, alone.is_explained(PRESSURE)
    driven = with_modelled_pressure(evidence, [record], [record], clean, trusted=trusted)
    return audit_model(recalibrate(driven, alone.fits), found)


def audit_model(model: Model, found: Sequence[Candidate], *, pairs: bool = True) -> Audit:
    """Audit the training records of a model that is at, or near, its floor.

    Of an effect with several forms the first stands for all.
    """
    firsts = {c.name: c for c in reversed(found)}
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
    sees = tuple(name for name, power in powers.items() if power > 1.0)
    blind = tuple(_describe_blind_spot(c, powers[n]) for n, c in firsts.items() if n not in sees)
    alike = _find_inseparable_pairs(doses, spare, sees) if pairs else []
    return Audit(
        sees, (*blind, *_list_unseen_effects(model, found)), tuple(map(_advise_pair, alike))
    )


def _find_inseparable_pairs(
    doses: Mapping[str, Mapping[str, Array]], spare: Mapping[str, float], sees: Sequence[str]
) -> list[tuple[str, str]]:
    """Find pairs of which one explains all that the other does above the limits."""

    def explains(other: str, one: str) -> bool:
        return all(
            _unexplained_rms(d[one], d.get(other)) <= spare[block]
            for block, d in doses.items()
            if one in d
        )

    return [(a, b) for a, b in combinations(sees, 2) if explains(a, b) or explains(b, a)]


def _unexplained_rms(hidden: Array, fitted: Array | None) -> float:
    """RMS of what is left of an effect's strongest dose when another is fitted to it."""
    strongest = hidden[:, int(np.argmax(_column_rms(hidden)))]
    if fitted is None:
        return float(np.sqrt(np.mean(strongest**2)))
    return float(np.sqrt(np.mean(project_out(np.linalg.qr(fitted)[0], strongest) ** 2)))


def _column_rms(columns: Array) -> Array:
    values: Array = np.sqrt(np.mean(columns**2, axis=0))
    return values


def _advise_pair(pair: tuple[str, str]) -> Inseparable:
    advice = find_separating_experiment(pair)
    return Inseparable(pair, str(advice["name"]), str(advice["why"]))


def _room_below_limit(model: Model, block: str) -> float:
    """How much a misfit adds before the limit is passed, in deviations of the sensor."""
    floor = model.floors[block]
    return float(np.sqrt(floor.limit**2 - floor.mean**2))


def _simulate_doses(model: Model, block: str, found: Iterable[Candidate]) -> dict[str, Array]:
    """Dose the switches by their smallest sizes of interest, beside what recalibration can do.

    Arrays of shape (n, doses) by name, in deviations of the sensor.
    """
    fitted = extract_block_fit(model.fit_of(block), block)
    basis = np.linalg.qr(fitted.jacobian)[0] if fitted.free else np.zeros((len(fitted.residual), 0))
    return {
        c.name: project_out(
            basis, np.column_stack([secant(fitted, d) for d in _list_smallest_doses(c, fitted)])
        )
        for c in found
        if block in c.blocks
    }


def _list_smallest_doses(candidate: Candidate, fitted: Fit) -> list[dict[str, float]]:
    """Each switch alone, and all together: two widths alike may hide where one would show."""
    held = dict(candidate.held)
    sizes = {
        s.name: apply_dose(s, 1.0, value_of(fitted.settings, s.name)) for s in candidate.switches
    }
    alone_each = [{**held, name: size} for name, size in sizes.items()]
    return [*alone_each, {**held, **sizes}] if len(sizes) > 1 else alone_each


def _describe_blind_spot(candidate: Candidate, power: float) -> BlindSpot:
    switch = candidate.switches[0]
    size = look_up_parameter(switch).smallest_of_interest
    effect = CATALOGUE[candidate.name]
    dose = f"{size:g} {unit_of(switch)}".rstrip()
    if neutral := look_up_parameter(switch).neutral:
        dose += f" off {neutral:g}"
    why = f"at {dose} it stays below the floor's limit"
    visible_from = _find_visible_size(switch, size, power)
    sizes = 1.0 / power if visible_from else inf
    return BlindSpot(candidate.name, why, effect.best_experiment, visible_from, sizes)


def _find_visible_size(switch: FreeNumber, size: float, power: float) -> tuple[float, str] | None:
    """In proportion: a size that would just pass the limit, where the range allows it."""
    if power <= 0.0 or size / power > max(abs(switch.high), abs(switch.low)):
        return None
    return size / power, unit_of(switch)


def _list_unseen_effects(model: Model, found: Sequence[Candidate]) -> list[BlindSpot]:
    """List effects that reach no block that these records drive, or that nothing can identify."""
    asked = {c.name for c in found} | {*model.names}
    spots = [
        BlindSpot(name, effect.unidentifiable, "", None)
        for name, effect in CATALOGUE.items()
        if effect.unidentifiable
    ]
    for name, effect in CATALOGUE.items():
        if name in asked or effect.unidentifiable or not effect.is_searched:
            continue
        if effect.block not in (*model.evidence.blocks, "sensors"):
            why = "these records do not drive its block"
            spots.append(BlindSpot(name, why, effect.best_experiment, None))
    return spots
