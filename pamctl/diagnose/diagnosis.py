"""The result of a diagnosis in one object: verdict, names, numbers, the extended plant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from pamctl.diagnose.audit import Audit
from pamctl.diagnose.deciding.deciding_program import DecidingProgram
from pamctl.diagnose.deciding.forecast import JudgedForecast
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.intervals import FittedNumber
from pamctl.diagnose.fitting.numbers import value_of
from pamctl.diagnose.fitting.split import ConfirmedOn
from pamctl.diagnose.locate import RegimeMisfit, describe_worst_regimes
from pamctl.diagnose.measured.noise.channel_noise import ChannelNoise
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.measured.refuse import AcceptedDoubt
from pamctl.diagnose.naming.remainder import Remainder
from pamctl.diagnose.naming.rivals import Standing
from pamctl.diagnose.naming.search import EffectsTrial
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.naming.whiteness import ResidualSign
from pamctl.diagnose.setup.setup_finding import SetupFinding
from pamctl.diagnose.show import HeldOutGap
from pamctl.diagnose.terms.describe import Description
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
    train: tuple[Record, ...] = ()
    holdout: tuple[Record, ...] = ()
    explained: float = 0.0
    """The smallest of `explained_by_block`; 1 where each block alone was at its limit before."""
    explained_by_block: Mapping[str, float] = field(default_factory=dict)
    """Share of the way from recalibrated to limit that the effects go, by block that they reach."""
    confirmed_on: ConfirmedOn | None = None
    """The samples that `gap`, the shares and `confirmed_ratios` rest on."""
    confirmed_ratios: Mapping[str, float] = field(default_factory=dict)
    """Residual over floor by block, on the samples that confirm."""
    signs: tuple[ResidualSign, ...] = ()
    """What speaks against noise in residuals that are at their limits."""
    setup: tuple[SetupFinding, ...] = ()
    """What is wrong about the set-up: numbers of the plant file, columns of the records."""
    described: Description | None = None
    """What was asked of a remainder that no effect explains; None where nothing was asked."""
    audit: Audit | None = None
    """What these records could not have shown."""
    accepted: tuple[AcceptedDoubt, ...] = ()
    """Doubts about the data that the user overruled, each with the reason."""
    noise: Mapping[str, ChannelNoise] = field(default_factory=dict)
    """What is known of each channel's noise, and of the time stamps, `t_s`."""
    explanations: tuple[str, ...] = ()
    """What the data leave open, the chosen one first."""
    deciding: DecidingProgram | None = None
    """The program that would decide between what is left; None where nothing can be decided."""
    is_of_daemon: bool = False
    """A running daemon drives the rig: `pamctl start` begins its experiments."""
    forecasts: tuple[JudgedForecast, ...] = ()
    """What earlier diagnoses expected of these records, and what came of it."""

    @property
    def recalibrated(self) -> tuple[FittedNumber, ...]:
        """The numbers that the start model has already, those of its effects included."""
        named = self.model.names if self.model else ()
        return tuple(n for n in self.numbers if n.name.split(".")[0] not in named)

    @property
    def at_bound(self) -> tuple[str, ...]:
        """Fitted numbers at an end of their range."""
        return self.model.at_bound if self.model else ()

    def start_value(self, name: str) -> float:
        """Return a number of the start model."""
        return value_of(self.nominal, name)


def find_largest_remainder(diagnosis: Diagnosis) -> tuple[str, float, str]:
    """Return the block with the most left: its name, residual over floor, and worst regimes."""
    model, ratios = diagnosis.model, diagnosis.confirmed_ratios
    if model is None:
        return "", 0.0, ""
    block = max(model.evidence.blocks, key=model.ratio)
    ratio = ratios.get(block, model.ratio(block))
    return block, ratio, describe_worst_regimes(diagnosis.misfits, block)
