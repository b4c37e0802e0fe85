"""The result of a diagnosis in one object: verdict, findings, numbers, the extended plant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

from pamctl.diagnose.audit import Audit
from pamctl.diagnose.deciding_program import DecidingProgram
from pamctl.diagnose.evidence.constants import LEFT_TIMES
from pamctl.diagnose.evidence.ladder import Finding
from pamctl.diagnose.evidence.weigh import EvidenceVerdict
from pamctl.diagnose.explanations import JudgedForecast
from pamctl.diagnose.plant_numbers import FittedNumber, value_of
from pamctl.diagnose.record import ChannelNoise, Record
from pamctl.diagnose.refuse import AcceptedDoubt
from pamctl.plant.model import PlantSettings

OPEN_TIMES = 1.2
"""Of the sensor's noise: what is left above it is visible."""


class Verdict(StrEnum):
    """What the measurement says about the model."""

    NO_DISCREPANCY = "no_discrepancy"
    MISCALIBRATED = "miscalibrated"
    """Only numbers of the plant file or of the set-up are off."""
    NAMED = "named"
    DESCRIBED = "described"
    """What is missing has a place, or a place and a kind, and no name."""
    AMBIGUOUS = "ambiguous"
    """One of several is missing, at several places."""
    PARTIAL = "partial"
    """Something is named, and something else has only a place."""
    NONE_KNOWN = "none_known"
    """Nothing that was asked explains anything, and something is left."""
    BAD_DATA = "bad_data"
    INTERRUPTED = "interrupted"
    """The search did not end: what was found so far is not compared with what looks like it."""


class HeldOutGap(NamedTuple):
    """RMS of measurement minus simulation of one channel, SI, by model; and its sensor's noise."""

    nominal: float
    recalibrated: float
    extended: float
    floor: float
    """RMS of the sensor's own noise."""

    @property
    def is_open(self) -> bool:
        """Tell whether recalibration leaves visibly more than noise."""
        return self.recalibrated > OPEN_TIMES * self.floor

    @property
    def closed(self) -> float:
        """Share of the way from recalibrated to the sensor's noise that the findings go."""
        way = self.recalibrated - self.floor
        return min(max((self.recalibrated - self.extended) / way, 0.0), 1.0) if way > 0.0 else 1.0


@dataclass(frozen=True)
class Diagnosis:
    """The outcome of `diagnose`."""

    verdict: Verdict
    nominal: PlantSettings
    plant: PlantSettings
    """The model to go on with: recalibrated, and extended by what was found."""
    reason: str = ""
    """Why the data cannot be diagnosed; empty otherwise."""
    evidence: EvidenceVerdict | None = None
    """The models, what they leave, and what was asked; None for bad data."""
    train: tuple[Record, ...] = ()
    holdout: tuple[Record, ...] = ()
    """Records that were not fitted; the gap is theirs if there are any."""
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
    def is_held_out(self) -> bool:
        """Whether the gap is that of records, or of stretches of records, that were not fitted."""
        return self.evidence is not None and self.evidence.weigher.held_out is not None

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What the model lacks, the first found first; also what is only mended (`rest`)."""
        return self.evidence.findings if self.evidence else ()

    @property
    def recalibrated(self) -> tuple[FittedNumber, ...]:
        """The numbers that the start model has already, those of its effects included."""
        return self.evidence.recalibrated if self.evidence else ()

    @property
    def numbers(self) -> tuple[FittedNumber, ...]:
        """Every fitted number: the recalibrated ones, then those of the findings."""
        return (*self.recalibrated, *(n for f in self.findings for n in f.numbers))

    @property
    def gap(self) -> Mapping[str, HeldOutGap]:
        """What each model leaves of each channel; of held-out records, if there are any."""
        if self.evidence is None:
            return {}
        nominal, recalibrated, extended = (
            self.evidence.gap[stage] for stage in ("nominal", "recalibrated", "extended")
        )
        return {
            c: HeldOutGap(nominal[c], recalibrated[c], extended[c], floor)
            for c, floor in self.evidence.noise_rms.items()
        }

    @property
    def explained(self) -> float | None:
        """The least `closed` of the channels that are open; None where none is."""
        closed = [gap.closed for gap in self.gap.values() if gap.is_open]
        return min(closed, default=None)

    @property
    def at_bound(self) -> tuple[str, ...]:
        """Fitted numbers at an end of their range."""
        ended = self.evidence.at_range if self.evidence else ()
        return (*dict.fromkeys((*ended, *(name for f in self.findings for name in f.at_range))),)

    def start_value(self, name: str) -> float:
        """Return a number of the start model."""
        return value_of(self.nominal, name)


class DiagnosisInterrupted(KeyboardInterrupt):
    """A diagnosis was interrupted; `diagnosis` has what was found until then."""

    def __init__(self, diagnosis: Diagnosis) -> None:
        """Keep the diagnosis."""
        super().__init__()
        self.diagnosis = diagnosis


def decide_verdict(evidence: EvidenceVerdict) -> Verdict:
    """Return the word for what the evidence says: that of the least of its findings."""
    if evidence.stopped_by is not None:
        return Verdict.INTERRUPTED
    said = [f for f in evidence.findings if f.level != "rest"]
    if not said:
        left = max(evidence.left_over_noise.values(), default=0.0)
        if left > LEFT_TIMES:
            return Verdict.NONE_KNOWN
        is_off = evidence.held_s > 0.0 or _is_start_off(evidence)
        return Verdict.MISCALIBRATED if is_off else Verdict.NO_DISCREPANCY
    if any(f.level == "set" for f in said):
        return Verdict.AMBIGUOUS
    named = [f for f in said if f.level == "name"]
    if len(named) < len(said):
        return Verdict.PARTIAL if named else Verdict.DESCRIBED
    only_setup = all(f.hypothesis.setup for f in named)
    return Verdict.MISCALIBRATED if only_setup else Verdict.NAMED


def _is_start_off(evidence: EvidenceVerdict) -> bool:
    """Tell whether the start model leaves visibly more than the recalibrated one."""
    start, fitted = evidence.gap["nominal"], evidence.gap["recalibrated"]
    return any(
        start[c] > OPEN_TIMES * max(fitted[c], noise) for c, noise in evidence.noise_rms.items()
    )
