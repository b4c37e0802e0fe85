"""The result of a diagnosis in one object: verdict, names, numbers, the extended plant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from pamctl.diagnose.audit import Audit
from pamctl.diagnose.extend import CorrectionResult
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.intervals import FittedNumber
from pamctl.diagnose.fitting.numbers import value_of
from pamctl.diagnose.locate import RegimeMisfit, describe_worst_regimes
from pamctl.diagnose.measured.channel_noise import ChannelNoise
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.naming.remainder import Remainder
from pamctl.diagnose.naming.rivals import Standing
from pamctl.diagnose.naming.search import EffectsTrial
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.show import HeldOutGap
from pamctl.plant.model import PlantSettings


@dataclass(frozen=True)
class Diagnosis:
    """The outcome of `diagnose`."""

    verdict: Verdict
    nominal: PlantSettings
    plant: PlantSettings
    """The model to go on with: recalibrated, and extended by what was named."""
    reason: str = ""
    """Why the data cannot be diagnosed; empty otherwise."""
    model: Model | None = None
    """The fits with the named effects; None for bad data."""
    base: Model | None = None
    """The fits without any effect."""
    standings: tuple[Standing, ...] = ()
    numbers: tuple[FittedNumber, ...] = ()
    gap: dict[str, HeldOutGap] | None = None
    misfits: tuple[RegimeMisfit, ...] = ()
    """What the model leaves, by regime."""
    base_misfits: tuple[RegimeMisfit, ...] = ()
    """What the recalibrated model leaves, by regime."""
    substep_changes: Mapping[str, float] = field(default_factory=dict)
    """By how much half the integrator's sub-step changes each block, over its floor."""
    trials: tuple[EffectsTrial, ...] = ()
    """Every set of effects that was fitted, the best first."""
    remainder: Remainder | None = None
    """The shape of what the effects leave."""
    correction: CorrectionResult | None = None
    """The tables for what the effects leave; None where none were requested."""
    train: tuple[Record, ...] = ()
    holdout: tuple[Record, ...] = ()
    explained: float = 0.0
    """Share of the gap from recalibrated to floor that the effects close."""
    audit: Audit | None = None
    """What these records could not have shown."""
    noise: Mapping[str, ChannelNoise] = field(default_factory=dict)
    """What is known of each channel's noise, and of the time stamps, `t_s`."""

    @property
    def recalibrated(self) -> tuple[FittedNumber, ...]:
        """The numbers that the start model has already, those of its effects included."""
        named = self.model.names if self.model else ()
        return tuple(n for n in self.numbers if n.name.split(".")[0] not in named)

    def start_value(self, name: str) -> float:
        """Return a number of the start model."""
        return value_of(self.nominal, name)


def find_largest_remainder(diagnosis: Diagnosis) -> tuple[str, float, str]:
    """Return the block with the most left: its name, residual over floor, and worst regimes."""
    model = diagnosis.model
    if model is None:
        return "", 0.0, ""
    block = max(model.evidence.blocks, key=model.ratio)
    return block, model.ratio(block), describe_worst_regimes(diagnosis.misfits, block)
