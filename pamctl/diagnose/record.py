"""One measured run for the diagnosis: arrays in SI, sampled together; and its sensors' noise."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import isfinite, sqrt
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pamctl.log.edit import find_longest_step_s, split_at_gaps
from pamctl.log.record_problems import find_sensor_step
from pamctl.log.run_meta import Moment

Array = NDArray[np.float64]

CHANNELS: Mapping[str, str] = {
    "valve_v": "V",
    "pressure_pa": "Pa",
    "position_m": "m",
    "force_n": "N",
}
"""The channels that a record may hold, and their units."""

REST_V = 0.05
"""Commands that differ by less do not move the valve (V)."""


@dataclass(frozen=True)
class Record:
    """A run: `pressure_pa[k]` and `position_m[k]` were sampled at `t_s[k]`.

    `valve_v[k]` acts from `t_s[k] + acts_after_s[k]` until the next one does. Pressure is absolute.
    A channel that was not measured is None. The run should begin vented and at rest.
    """

    name: str
    t_s: Array
    valve_v: Array | None = None
    pressure_pa: Array | None = None
    position_m: Array | None = None
    force_n: Array | None = None
    reference_m: Array | None = None
    """Reference position in closed loop, NaN elsewhere; it shows which runs are repeats."""
    acts_after_s: Array | None = None
    """Time from each sample to the instant from which its command acts; None: at the sample."""
    held_v: float | None = None
    """The command before the first, which acts until the first does; None: the first itself."""
    notes: tuple[str, ...] = field(default=(), compare=False)
    experiment: str = field(default="", compare=False)
    """Name of the experiment that was run; empty if unknown."""
    is_imported: bool = field(default=False, compare=False)
    """Whether another system measured it: this one cannot be asked to run an experiment."""
    counts: NDArray[np.bool_] | None = None
    """False where a sample is an outlier, a dropout or missing, shape (n,); None if all count."""
    stated_noise: Mapping[str, float] = field(default_factory=dict)
    """Standard deviation of a reading by channel, in SI, where the user states it."""
    steps: Mapping[str, float] = field(default_factory=dict, compare=False)
    """Of the converter by channel, in SI, where mending took the readings off them."""
    atmosphere_pa: float | None = field(default=None, compare=False)
    """From which an imported gauge pressure counts; None where no import map says it."""
    moments: tuple[Moment, ...] = field(default=(), compare=False)
    """Marks, changes of gains and the trip, which plots show; in the time of `t_s`."""
    settings: Mapping[str, Any] = field(default_factory=dict, compare=False)
    """What the run was set to, as its log holds it: rig, experiment; empty if unknown."""

    def __post_init__(self) -> None:
        """Accept any sequence of numbers; raise ValueError where lengths differ."""
        object.__setattr__(self, "t_s", _as_column(self.t_s))
        for channel in (*CHANNELS, "reference_m", "acts_after_s"):
            values = getattr(self, channel)
            if values is None:
                continue
            column = _as_column(values)
            if column.shape != self.t_s.shape:
                raise ValueError(
                    f"{self.name}: {channel} has {len(column)} samples, t_s has {len(self.t_s)}"
                )
            object.__setattr__(self, channel, column)

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.t_s)

    @property
    def duration_s(self) -> float:
        """From the first sample to the last."""
        return float(self.t_s[-1] - self.t_s[0])

    @cached_property
    def step_s(self) -> Array:
        """Time from each sample to the next, shape (n - 1,)."""
        return np.diff(self.t_s)

    @cached_property
    def period_s(self) -> float:
        """The usual time between two samples."""
        return float(np.median(self.step_s))

    @property
    def longest_step_s(self) -> float:
        """The longest time between two samples that is not a gap."""
        return find_longest_step_s(self.step_s, holds_command=self.valve_v is not None)

    @cached_property
    def segments(self) -> tuple[slice, ...]:
        """The stretches between gaps, in order; a record without gaps is one."""
        return split_at_gaps(self.t_s, holds_command=self.valve_v is not None)

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels that were measured."""
        return tuple(name for name in CHANNELS if getattr(self, name) is not None)

    def __getitem__(self, channel: str) -> Array:
        """Return a channel; raise KeyError where it was not measured."""
        values = getattr(self, channel) if channel in CHANNELS else None
        if values is None:
            raise KeyError(f"{self.name} has no {channel}")
        column: Array = values
        return column

    def find_step(self, channel: str) -> float:
        """Return the step with which a channel was digitised; 0 where none is visible."""
        return self.steps.get(channel) or find_sensor_step(self[channel])

    def cut_samples(self, start: int, stop: int, name: str) -> Record:
        """Return the samples [start, stop) as a record of their own."""
        before = start and self.valve_v is not None
        held_v = float(self["valve_v"][start - 1]) if before else self.held_v
        return replace(self._take(slice(start, stop)), name=name, held_v=held_v)

    def keep_rows(self, kept: NDArray[np.bool_]) -> Record:
        """Return the record with the samples that are `kept`, shape (n,)."""
        return self if kept.all() else self._take(kept)

    def _take(self, rows: slice | NDArray[np.bool_]) -> Record:
        arrays = ("t_s", *self.channels, "reference_m", "acts_after_s", "counts")
        taken: dict[str, Any] = {
            c: getattr(self, c)[rows] for c in arrays if getattr(self, c) is not None
        }
        return replace(self, **taken)


def estimate_white_noise(values: Array) -> float:
    """Return the deviation of a channel's white noise, rounding included, from third differences.

    They multiply it by sqrt(20), and smooth motion vanishes. The largest tenth is left out, which
    steps of the command cause: the rest of a normal variable has 0.7893 of its RMS.
    """
    third = np.abs(np.diff(values, 3))
    kept = third[third <= np.quantile(third, 0.9)]
    return float(np.sqrt(np.mean(kept**2)) / (0.7893 * np.sqrt(20.0)))


def _as_column(values: ArrayLike) -> Array:
    return np.ascontiguousarray(values, dtype=np.float64).reshape(-1)


# --- what is known of the sensors -----------------------------------------------------------------

FaultKind = Literal["jitter", "outliers", "dropouts", "hum", "filtered", "unused", "early"]
SENSORS = {channel: unit for channel, unit in CHANNELS.items() if channel != "valve_v"}
SOURCES = {
    "stated": "as stated",
    "residual": "from what changes from sample to sample of what is left",
    "differences": "from differences of the samples",
}


class SensorFault(NamedTuple):
    """What is wrong with a channel beside its noise."""

    channel: str
    """The channel; `t_s` for the time stamps."""
    kind: FaultKind
    says: str
    """What was found, with the number and its unit, and what was done about it."""


@dataclass(frozen=True)
class ChannelNoise:
    """What is known of one channel; the time stamps, `t_s`, and unused channels have faults only.

    Numbers are in SI.
    """

    deviation: float | None = None
    """Standard deviation of a reading, with the converter's rounding."""
    resolution: float = 0.0
    """Step of the converter; 0 where none is visible."""
    source: str = ""
    """Of `SOURCES`."""
    faults: tuple[SensorFault, ...] = ()

    def as_dict(self, channel: str) -> dict[str, Any]:
        """Return plain values for the document."""
        entry: dict[str, Any] = {}
        says = [fault.says for fault in self.faults]
        if self.deviation is not None:
            unit = CHANNELS[channel]
            how = SOURCES[self.source]
            says.insert(0, f"{channel}: noise {self.deviation:.3g} {unit}, {how}")
            entry = {
                "deviation": self.deviation,
                "unit": unit,
                "resolution": self.resolution,
                "source": self.source,
                "is_known": True,
            }
        return {**entry, "faults": [*dict.fromkeys(f.kind for f in self.faults)], "says": says}


def describe_channels(
    records: Sequence[Record], left: Mapping[str, float], faults: Sequence[SensorFault]
) -> dict[str, ChannelNoise]:
    """Return what is known of each channel.

    `left` is the noise of the channels that a model explains, as the fitted model leaves it, in SI.
    """
    found = {}
    sensors = [c for c in records[0].channels if c in SENSORS]
    for name in dict.fromkeys([*sensors, *(fault.channel for fault in faults)]):
        mine = tuple(f for f in faults if f.channel == name)
        if name not in sensors:
            found[name] = ChannelNoise(faults=mine)
            continue
        step = float(np.median([r.find_step(name) for r in records]))
        stated = [r.stated_noise[name] for r in records if name in r.stated_noise]
        if stated:
            size, source = sqrt(np.mean(np.square(stated))), "stated"
        elif name in left:
            size, source = left[name], "residual"
        else:
            size = float(np.median([estimate_white_noise(r[name]) for r in records]))
            source = "differences"
        found[name] = ChannelNoise(size, step, source, mine)
    return found


def pool_stated_noise(records: Sequence[Record]) -> dict[str, float]:
    """Return the stated standard deviation of each channel over records, without the rounding."""
    pooled = {}
    for channel in SENSORS:
        stated = [r.stated_noise[channel] for r in records if channel in r.stated_noise]
        if stated and channel in records[0].channels:
            step = float(np.median([r.find_step(channel) for r in records]))
            white2 = float(np.mean(np.square(stated))) - step**2 / 12.0
            pooled[channel] = sqrt(max(white2, 0.0))
    return pooled


def parse_noise(texts: Iterable[str]) -> dict[str, float]:
    """Return standard deviations in SI from texts such as `position_m=2e-6`.

    Raise ValueError with what is wrong.
    """
    stated: dict[str, float] = {}
    for text in texts:
        channel, equals, number = text.partition("=")
        channel = channel.strip()
        if channel not in SENSORS or not equals:
            listed = ", ".join(f"{name}=... ({unit})" for name, unit in SENSORS.items())
            raise ValueError(f"{text!r} states no channel's noise; give {listed}")
        if channel in stated:
            raise ValueError(f"{channel} is stated twice")
        try:
            deviation = float(number)
        except ValueError:
            deviation = float("nan")
        if not isfinite(deviation) or deviation < 0.0:
            raise ValueError(
                f"{channel} is {number.strip()!r}, but must be a number of {SENSORS[channel]} that "
                "is 0 or more: the standard deviation of a reading"
            )
        stated[channel] = deviation
    return stated


def group_notes(records: Iterable[Record]) -> list[str]:
    """Return each note once, behind the names of its records."""
    names: dict[str, list[str]] = {}
    for record in records:
        for note in record.notes:
            names.setdefault(note, []).append(record.name)
    return [f"{', '.join(dict.fromkeys(of))}: {note}" for note, of in names.items()]
