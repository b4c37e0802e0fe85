"""What a diagnosis found, in one object: verdict, names, numbers, the extended plant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from pamctl.diagnose.audit import Audit
from pamctl.diagnose.correction import CorrectionResult
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.intervals import FittedNumber
from pamctl.diagnose.fitting.numbers import value_of
from pamctl.diagnose.locate import RegimeMisfit, describe_worst_regimes
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.naming.rivals import Standing
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.remainder import Remainder
from pamctl.diagnose.show import HeldOutGap
from pamctl.plant.model import PlantSettings


@dataclass(frozen=True)
class EffectsTrial:
    """One set of effects that was fitted."""

    names: tuple[str, ...]
    ratios: Mapping[str, float]
    """Held-out RMS over the floor, by block."""


@dataclass(frozen=True)
class Diagnosis:
    """The outcome of `diagnose`."""

    verdict: Verdict
    nominal: PlantSettings
    plant: PlantSettings
    """The model to go on with: recalibrated, and extended by what was named."""
    reason: str = ""
    """Of bad data."""
    model: Model | None = None
    base: Model | None = None
    standings: tuple[Standing, ...] = ()
    numbers: tuple[FittedNumber, ...] = ()
    gap: dict[str, HeldOutGap] | None = None
    cells: tuple[RegimeMisfit, ...] = ()
    """What is left, by regime."""
    regimes: tuple[RegimeMisfit, ...] = ()
    """The misfit of the recalibrated model, by regime."""
    stepping: Mapping[str, float] = field(default_factory=dict)
    """By how much half the integrator's sub-step changes each block, over its floor."""
    tried: tuple[EffectsTrial, ...] = ()
    """What was fitted, the best first."""
    remainder: Remainder | None = None
    corrected: CorrectionResult | None = None
    """What became of the wish to have the remainder in the model."""
    train: tuple[Record, ...] = ()
    holdout: tuple[Record, ...] = ()
    explained: float = 0.0
    audit: Audit | None = None
    """What these records could not have shown."""

    @property
    def recalibrated(self) -> tuple[FittedNumber, ...]:
        """The numbers that the start model had already, its effects' among them."""
        named = self.model.names if self.model else ()
        return tuple(n for n in self.numbers if n.name.split(".")[0] not in named)

    def start_value(self, name: str) -> float:
        """Return a number of the start model."""
        return value_of(self.nominal, name)


def find_largest_remainder(diagnosis: Diagnosis) -> tuple[str, float, str]:
    """Return block, residual over floor and regimes of what is left most."""
    model = diagnosis.model
    if model is None:
        return "", 0.0, ""
    block = max(model.evidence.blocks, key=model.ratio)
    return block, model.ratio(block), describe_worst_regimes(diagnosis.cells, block)
