"""The explanations that a diagnosis leaves, and how good earlier forecasts were."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from pydantic import ValidationError

from pamctl.control.experiment import ForecastSettings
from pamctl.diagnose.evidence.constants import COARSE_STEP_S
from pamctl.diagnose.evidence.fit import WeighedModel, Weigher
from pamctl.diagnose.evidence.name_search import NameSearch
from pamctl.diagnose.evidence.pool import CHAIN
from pamctl.diagnose.evidence.run_pieces import Runs, join_waves
from pamctl.diagnose.evidence.weigh import EvidenceVerdict
from pamctl.diagnose.plant_numbers import with_values
from pamctl.diagnose.record import Array, Record
from pamctl.plant.model import PlantSettings

BLOCKS = {"pressure_pa": "pressure", "position_m": "mechanics"}
"""What a forecast calls the channels."""
MOST_EXPLANATIONS = 4
"""The nearest ones; each pair of them is a question to the program."""
MOST_RIVALS = 3
"""Rivals of one finding that are fitted."""


@dataclass(frozen=True)
class Explanation:
    """One explanation: its name, and the model that was fitted with it."""

    name: str
    model: WeighedModel
    weigher: Weigher
    nominal: PlantSettings

    @cached_property
    def values(self) -> dict[str, float]:
        """The model's numbers by flat name, those of the measuring chain included."""
        return {**self.weigher.base, **self.model.values}

    @cached_property
    def laws(self) -> dict[str, object]:
        """The law that each number belongs to: None for those that every explanation has."""
        found = {u.name: v.form for v in self.model.picked.values() for u in v.free}
        return {n.name: found.get(n.name) for n in self.model.numbers}

    @cached_property
    def noise2(self) -> Array:
        """The squared noise of each channel, by what this explanation leaves."""
        return self.weigher.find_noise2(self.model)

    @cached_property
    def left2(self) -> Array:
        """The mean square of what it leaves of each channel."""
        return self.weigher.like.mean_squares(self.model.d)

    @cached_property
    def known(self) -> Array:
        """What the records so far know of its numbers: the information, in scales."""
        assert self.model.tangent is not None
        slope = self.model.tangent.reshape(len(self.model.x), -1)
        return np.asarray((slope * self.model.cost.weights.ravel()) @ slope.T)

    @cached_property
    def plant(self) -> PlantSettings:
        """The whole plant under this explanation."""
        return assemble_plant(self.nominal, self.model.values)


def assemble_plant(nominal: PlantSettings, values: dict[str, float]) -> PlantSettings:
    """Return the plant with a model's numbers; raise ValidationError if one is out of range.

    What is wrong with the measuring chain stays out of it, except the pressure of the place.
    """
    plain, chain = join_waves(values)
    if f"{CHAIN}atmosphere" in chain:
        plain["atmospheric_pressure_pa"] = chain[f"{CHAIN}atmosphere"]
    return with_values(nominal, plain)


def name_explanation(model: WeighedModel) -> str:
    """Return what a model says is missing, in one line."""
    return " and ".join(sorted(model.names)) or "recalibration alone"


def list_explanations(found: EvidenceVerdict, nominal: PlantSettings) -> tuple[Explanation, ...]:
    """Return what the data leave open: the chosen model first, then its rivals, the nearest first.

    Fewer than two explanations leave nothing to decide.
    """
    if not found.findings:
        return ()
    named = {name_explanation(found.model): replace(found.model)}
    for finding in found.findings:
        if finding.level in ("name", "rest"):  # a name's freer terms can always mimic it
            continue
        names_first = sorted(finding.judged, key=lambda j: j.hypothesis.is_term)
        for m in [j.model for j in names_first if j.model is not None][:MOST_RIVALS]:
            named.setdefault(name_explanation(m), m)
    chosen, weigher = [*named.items()][:MOST_EXPLANATIONS], found.weigher
    weigher.set_floor(*(m for _, m in chosen))
    return tuple(Explanation(name, weigher.leave_out(m), weigher, nominal) for name, m in chosen)


def exchange_name(search: NameSearch, m: WeighedModel, gone: str, new: str) -> WeighedModel | None:
    """Return a model with one name instead of another, fitted; None where the new does nothing.

    An empty name stands for none. The floor is that of the model without either.
    """
    without = search.drop(m, gone) if gone else m
    if not new:
        return without
    score, weigher = next(iter(search.score(without, [new])), None), search.weigher
    if score is None:
        return None
    floor2 = weigher.floor2
    fitted = weigher.settle(search.refit(without, [score], 1)[0])
    weigher.floor2 = floor2
    return weigher.leave_out(fitted)


GOOD = 2.0
"""A forecast within this factor of what was found was good."""


@dataclass(frozen=True)
class JudgedForecast:
    """One forecast, and what came of it."""

    record: str
    true: str
    """The explanation that was found in the end."""
    refuted: str
    block: str
    expected: float
    """Residual over the sensor's noise that the refuted one should leave of this record."""
    found: float | None
    """What it leaves; None where it was not fitted again."""

    @property
    def is_good(self) -> bool | None:
        """Whether both agree; None where nothing can be compared."""
        if self.found is None:
            return None
        return max(self.found / self.expected, self.expected / self.found) <= GOOD

    def as_dict(self) -> dict[str, Any]:
        """Return what the document holds."""
        return {**asdict(self), "is_good": self.is_good}


def read_forecast(record: Record) -> ForecastSettings | None:
    """Return the forecast that a record's program carried; None without a valid one."""
    keys = record.settings.get("experiment")
    forecast = keys.get("forecast") if isinstance(keys, Mapping) else None
    if forecast is None:
        return None
    try:
        return ForecastSettings.model_validate(forecast)
    except ValidationError:
        return None


def judge_forecasts(
    found: EvidenceVerdict, records: Sequence[Record]
) -> tuple[JudgedForecast, ...]:
    """Compare what was expected of each record with what its refuted explanations leave.

    A forecast is judged where the explanation that it took for true is the one that was found.
    """
    here, judged = name_explanation(found.model), []
    fitted: dict[str, WeighedModel | None] = {}
    for record in records:
        forecast = read_forecast(record)
        for pair in forecast.pairs if forecast else ():
            if pair.true != here:
                continue
            if pair.refuted not in fitted:
                fitted[pair.refuted] = _fit_again(found, pair.refuted)
            m = fitted[pair.refuted]
            left = None if m is None else _measure(found, m, pair.block, record)
            judged.append(
                JudgedForecast(
                    record.name, here, pair.refuted, pair.block, pair.residual_over_floor, left
                )
            )
    return tuple(judged)


def _fit_again(found: EvidenceVerdict, explanation: str) -> WeighedModel | None:
    """Return the model of an explanation, fitted to all records; None if it differs by far."""
    names = {*explanation.split(" and ")} - {"recalibration alone"}
    gone, new = {*found.model.names} - names, names - {*found.model.names}
    if len(gone) > 1 or len(new) > 1 or not new <= {*found.pool}:
        return None
    search = NameSearch(found.weigher, found.pool)
    return exchange_name(search, found.model, "".join(gone), "".join(new))


def _measure(found: EvidenceVerdict, m: WeighedModel, block: str, record: Record) -> float | None:
    """Return the RMS that a model leaves of one record, over the sensor's noise."""
    weigher = found.weigher
    channel = next((c for c, name in BLOCKS.items() if name == block), "")
    if channel not in weigher.train.channels:
        return None
    row = weigher.train.channels.index(channel)
    try:
        runs = Runs([record], weigher.base, weigher.train)
    except ValueError:  # shorter than a block
        return None
    off = runs.shown - runs.simulate({**weigher.base, **m.values}, COARSE_STEP_S)
    rms = float(np.sqrt((runs.fill_masked(off)[row] ** 2).mean()))
    return rms / float(np.sqrt(weigher.find_noise2(found.model)[row]))
