"""The noise of each sensor: stated, or estimated; and how that is known."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.optimize import nnls
from scipy.special import ndtri

from pamctl.diagnose.mend import SensorFault, cut_even_stretches
from pamctl.diagnose.record import CHANNELS, Array, Record
from pamctl.log.record_problems import find_sensor_step

ORDER = 12
"""Order of the autoregressive model: enough for a filtered or drifting sensor."""
ENOUGH = 200
"""With fewer samples at rest, the noise is estimated from the spectrum."""
RESTING, WHITE_ENOUGH = 0.1, 4.0
"""Where no command proves a rest, it must be this much quieter than the whole record, and at most
this much louder than its own third differences: a slow motion is smooth."""
COARSE = 1.3
"""A tail of up to this multiple of the rounding error is the converter's alone."""
VAGUE = 0.25
"""A tail that is less certain than this, relative, says nothing."""
TWO_STEPS = 0.1
"""Relative uncertainty of a noise that reaches two steps of its converter."""
RIDGE = 1e-6
"""White share that is added to the noise of a rest: a filtered one would predict itself."""
Source = Literal["stated", "rest", "spectrum", "unknown"]


@dataclass(frozen=True)
class Noise:
    """Sensor noise as an autoregressive process, and the converter behind it."""

    deviation: float
    """Standard deviation, in the channel's unit."""
    memory: tuple[float, ...]
    """Coefficients on the earlier samples; empty for white noise."""
    drive: float
    """Standard deviation of the innovation."""
    resolution: float
    """Step of the converter; 0 where none is visible."""
    uncertainty: float = 0.0
    """Relative uncertainty of the deviation, one sigma."""
    source: Source = "rest"
    """Where the deviation comes from."""

    @property
    def is_known(self) -> bool:
        """False where the data do not tell noise from signal."""
        return self.source != "unknown"

    @property
    def total(self) -> float:
        """Standard deviation with the converter's rounding."""
        return float(np.hypot(self.deviation, self.resolution / np.sqrt(12.0)))

    def draw(self, samples: int, random: np.random.Generator) -> Array:
        """Draw a stretch of noise, not yet rounded."""
        if self.memory:
            from scipy.signal import lfilter  # most of a second to import

            settle = 200
            innovation = random.normal(0.0, self.drive, samples + settle)
            drawn: Array = lfilter([1.0], [1.0, *(-m for m in self.memory)], innovation)[settle:]
        else:
            drawn = random.normal(0.0, self.deviation, samples)
        return drawn

    def simulate_sensor(self, values: Array, random: np.random.Generator) -> Array:
        """Return what the sensor would show: noise is added, then rounded to the nearest step."""
        noisy = values + self.draw(len(values), random) if self.deviation > 0.0 else values
        if self.resolution == 0.0:
            return noisy
        if not noisy.any():  # the rounding error of a signal that moves
            return random.uniform(-0.5, 0.5, len(noisy)) * self.resolution
        # The zero of the converter lies anywhere within a step.
        offset = random.uniform(0.0, self.resolution)
        return np.round((noisy - offset) / self.resolution) * self.resolution + offset


def estimate_channel_noise(records: Sequence[Record], channel: str) -> Noise:
    """Return a channel's noise over records: stated, or from the rests, or from the spectrum.

    If none of these says it, the noise is unknown; its deviation is then only a unit.
    """
    step = float(np.median([find_sensor_step(r[channel]) for r in records]))
    stated = [r.stated_noise[channel] for r in records if channel in r.stated_noise]
    rested = _estimate_from_rests(_collect_rests(records, channel, step), step)
    if stated:
        pooled = float(np.sqrt(np.mean(np.square(stated))))
        noise = Noise(_subtract_rounding(pooled, step), (), 0.0, step, source="stated")
        return noise if rested is None else _take_colour(noise, rested)
    span = max(float(np.ptp(r[channel])) for r in records)
    if rested is not None and rested.total > QUIETEST * span:
        return _refine_white(rested, records, channel)
    return _read_tail(records, channel, step, span)


def _collect_rests(records: Sequence[Record], channel: str, step: float) -> list[Array]:
    """Return the rests without their trends; none where a rest may be a motion."""
    rests = [r[channel][: r.rest_samples] for r in records]
    rests = [_remove_trend(rest) for rest in rests if len(rest) >= ENOUGH // 2]
    if sum(map(len, rests)) < ENOUGH:
        return []
    commanded = all(r.valve_v is not None for r in records)
    deviation = float(np.sqrt(np.mean(np.concatenate(rests) ** 2)))
    usual = float(np.sqrt(np.mean([np.var(r[channel]) for r in records])))
    white = float(np.sqrt(np.mean(np.concatenate([np.diff(r, 3) for r in rests]) ** 2) / 20.0))
    is_still = deviation < RESTING * usual and deviation <= max(WHITE_ENOUGH * white, step)
    return rests if commanded or is_still else []


def _refine_white(rested: Noise, records: Sequence[Record], channel: str) -> Noise:
    """Take the size of white noise from the whole run: it shows more than a second of rest."""
    differences = float(np.median([_estimate_from_differences(r[channel]) for r in records]))
    close = abs(differences - rested.total) < 4.0 * rested.uncertainty * rested.total
    is_fine = rested.deviation > rested.resolution  # else differences are not normal
    if not (is_fine and close) or rested.memory:
        return rested
    size = _subtract_rounding(differences, rested.resolution)
    return replace(rested, deviation=size, uncertainty=0.005)


def _estimate_from_differences(values: Array) -> float:
    """Use third differences; leave out the largest tenth, which steps of the command cause."""
    third = np.abs(np.diff(values, 3))
    kept = third[third <= np.quantile(third, 0.9)]
    # A normal variable cut at its 90 % quantile keeps 0.7893 of its RMS. Third differences
    # multiply white noise by sqrt(20).
    return float(np.sqrt(np.mean(kept**2)) / (0.7893 * np.sqrt(20.0)))


def _read_tail(records: Sequence[Record], channel: str, step: float, span: float) -> Noise:
    """Return the noise that the end of the spectrum shows."""
    pieces = [r[channel][part] for r in records for part in cut_even_stretches(r)]
    tail = find_tail(pieces)
    if tail is None:
        return Noise(max(QUIETEST * span, step), (), 0.0, step, source="unknown")
    rounding = step / np.sqrt(12.0)
    if step and tail.deviation <= COARSE * rounding:
        # The converter's steps hide the noise; but filtered data look the same once a file holds
        # only a few of their digits.
        known = step > QUIETEST * span and not _is_decimal(step) and not falls_steeply(pieces)
        return Noise(0.0, (), 0.0, step, source="spectrum" if known else "unknown")
    size = max(_subtract_rounding(tail.deviation, step), QUIETEST * span)
    known = tail.is_flat and tail.uncertainty < VAGUE and tail.deviation > QUIETEST * span
    return Noise(size, (), 0.0, step, tail.uncertainty, "spectrum" if known else "unknown")


def _is_decimal(step: float) -> bool:
    """Tell whether a step is 1, 2 or 5 in the last digit of a file, in SI or a multiple."""
    mantissa = step / 10.0 ** np.floor(np.log10(step) + 1e-9)
    return any(abs(mantissa - digit) < 1e-3 * digit for digit in (1.0, 2.0, 5.0))


def _take_colour(noise: Noise, rested: Noise) -> Noise:
    """Give a stated noise the colour that the rests show."""
    if not rested.deviation:
        return noise
    ratio = noise.deviation / rested.deviation
    return replace(noise, memory=rested.memory, drive=rested.drive * ratio)


def _remove_trend(rest: Array) -> Array:
    index = np.arange(len(rest), dtype=np.float64)
    fitted: Array = np.polynomial.Polynomial.fit(index, rest, 1)(index)
    return rest - fitted


def _estimate_from_rests(pieces: Sequence[Array], step: float) -> Noise | None:
    """Solve the Yule-Walker equations for the pooled autocovariance of the rests.

    None if there are none.
    """
    if not pieces:
        return None
    lags = np.zeros(ORDER + 1)
    for piece in pieces:
        lags += [float(piece[lag:] @ piece[: len(piece) - lag]) for lag in range(ORDER + 1)]
    lags /= sum(map(len, pieces))
    deviation = float(np.sqrt(lags[0]))
    if not deviation:
        return Noise(0.0, (), 0.0, step)
    if deviation <= 0.6 * step:
        return _read_between_steps(pieces, step)
    lags[0] -= step**2 / 12.0
    lags[0] *= 1.0 + RIDGE
    toeplitz = np.array([[lags[abs(i - j)] for j in range(ORDER)] for i in range(ORDER)])
    memory = np.linalg.solve(toeplitz, lags[1:])
    # Coefficients within their own scatter are no memory.
    if np.all(np.abs(memory) < 3.5 / np.sqrt(sum(map(len, pieces)))):
        return Noise(
            _subtract_rounding(deviation, step), (), 0.0, step, _relative_uncertainty(pieces, 1.0)
        )
    drive = float(np.sqrt(max(lags[0] - memory @ lags[1:], 0.0)))
    worth = max(drive**2 / lags[0], 0.05)
    return Noise(
        float(np.sqrt(lags[0])),
        tuple(map(float, memory)),
        drive,
        step,
        _relative_uncertainty(pieces, worth),
    )


def _read_between_steps(pieces: Sequence[Array], step: float) -> Noise:
    """Return a noise of about a converter's step, from how often each step is shown.

    The two edges of the usual step are one step apart: the shares beyond them say how many
    deviations that is. On two steps nobody can tell noise from a value between them; on one step
    there is hardly any.
    """
    deviations = []
    for piece in pieces:
        shown = np.round((piece - np.median(piece)) / step)
        below, above = float(np.mean(shown < 0.0)), float(np.mean(shown > 0.0))
        if below and above:
            deviations.append(step / -float(ndtri(below) + ndtri(above)))
    if deviations:
        worth = _relative_uncertainty(pieces, 0.2)
        return Noise(float(np.median(deviations)), (), 0.0, step, worth)
    shakes = any(np.ptp(piece) > 0.5 * step for piece in pieces)
    return Noise(0.0, (), 0.0, step, TWO_STEPS if shakes else 0.0)


def _relative_uncertainty(pieces: Sequence[Array], worth: float) -> float:
    """Return the scatter of an estimated deviation; each sample counts as `worth` samples."""
    return float(1.0 / np.sqrt(2.0 * worth * sum(map(len, pieces))))


def _subtract_rounding(deviation: float, step: float) -> float:
    return float(np.sqrt(max(deviation**2 - step**2 / 12.0, 0.0)))


SENSORS = {channel: unit for channel, unit in CHANNELS.items() if channel != "valve_v"}


def parse_noise(texts: Iterable[str]) -> dict[str, float]:
    """Return standard deviations in SI by channel; raise ValueError with what is wrong."""
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


SOURCES = {
    "stated": "as stated",
    "rest": "from the rests",
    "spectrum": "from the end of the spectrum",
}


@dataclass(frozen=True)
class ChannelNoise:
    """One channel; the time stamps, `t_s`, and channels that are not used have faults only."""

    noise: Noise | None
    faults: tuple[SensorFault, ...] = ()

    def as_dict(self, channel: str) -> dict[str, Any]:
        """Return plain values for the document."""
        entry: dict[str, Any] = {}
        if self.noise is not None:
            noise = self.noise
            entry = {
                "deviation": noise.total if noise.is_known else None,
                "unit": CHANNELS[channel],
                "resolution": noise.resolution,
                "source": noise.source,
                "is_known": noise.is_known,
            }
        return {
            **entry,
            "faults": list(dict.fromkeys(fault.kind for fault in self.faults)),
            "says": [
                *([] if self.noise is None else [self.describe(channel)]),
                *(fault.says for fault in self.faults),
            ],
        }

    def list_faults(self, channel: str) -> list[str]:
        """Return a line for each fault, and one where the noise is unknown."""
        unknown = self.noise is not None and not self.noise.is_known
        return [*([self.describe(channel)] if unknown else []), *(f.says for f in self.faults)]

    def describe(self, channel: str) -> str:
        """Say how large the noise is and how that is known."""
        if self.noise is None:
            return ""
        if not self.noise.is_known:
            return (
                f"{channel}: noise unknown: the data do not tell it from the signal; state it with "
                f"`--noise {channel}=...`, in {CHANNELS[channel]}, or record a rest of 1 s"
            )
        return (
            f"{channel}: noise {self.noise.total:.3g} {CHANNELS[channel]}, "
            f"{SOURCES[self.noise.source]}"
        )


def describe_channels(
    records: Sequence[Record], noises: Mapping[str, Noise], mended: Iterable[SensorFault]
) -> dict[str, ChannelNoise]:
    """Return what is known of each channel; `mended` is what was taken off before."""
    faults = [*mended]
    for channel in noises:
        faults += _find_faults(records, channel)
    named = dict.fromkeys([*noises, *(fault.channel for fault in faults)])
    return {
        name: ChannelNoise(noises.get(name), tuple(f for f in faults if f.channel == name))
        for name in named
    }


def _find_faults(records: Sequence[Record], channel: str) -> Iterator[SensorFault]:
    filtering = find_filtering(records, channel)
    if filtering is not None:
        at = "" if filtering.cutoff_hz is None else f" near {filtering.cutoff_hz:.3g} Hz"
        how = ", forwards and backwards: it answers before its cause"
        how = how if filtering.is_zero_phase else ""
        says = f"{channel} was filtered{at}{how}; use the data as they were measured"
        yield SensorFault(channel, "filtered", says)


FEWEST = 96
"""Samples of a channel below which its spectrum says nothing."""
LAST = 0.97
"""Share of half the sampling rate above which the density is not used."""
TOP = 0.7
"""The tail begins here, as a share of half the sampling rate."""
ABOVE_TAIL = 4.0
"""Where the density is more than this above the tail, it is the signal's alone."""
NARROWEST = 0.25
"""Least width of a plateau, as a share of the band."""
MOST_COLOUR = 0.12
"""Share of the tail's density that may belong to the signal's own decay."""
LIVELY, WIDE = 0.1, 0.8
"""Noise that makes up more of a channel's variance is told from a signal only by a wide plateau."""
STEEP = 6.5
"""A density that falls by more powers of two in an octave, just after a slower fall, was cut off by
a filter: a force that switches makes a motion that falls by four."""
FAINT = 1e-3
"""Most of a channel's power that may lie beyond a filter's edge: the rest is the motion."""
SHELF = 3.0
"""Powers of two by which the noise before a filter's edge falls in an octave, at most."""


@dataclass(frozen=True)
class Tail:
    """What the end of a spectrum shows."""

    deviation: float
    """Standard deviation of white noise with the density of the tail."""
    is_flat: bool
    """The tail is a plateau."""
    uncertainty: float
    """Of `deviation`, relative, one sigma."""
    begins: float = 0.5
    """Where the signal ends in it, as a share of the sampling rate; 0.5 without a plateau."""


def find_tail(pieces: Sequence[Array], window: int = 0) -> Tail | None:
    """Return the tail of the spectrum of evenly sampled stretches; None if there is too little.

    The density is the median over short windows, so that a few steps or spikes do not count.
    `window` is their length in samples; 0 chooses it by the number of samples.
    """
    samples = sum(map(len, pieces))
    window = window or (128 if samples >= 2000 else 64 if samples >= 500 else 32)
    found = measure_density(pieces, window)
    if found is None or samples < FEWEST:
        return None
    density, windows = found
    index = np.arange(len(density))
    last = int(LAST * (len(density) - 1))
    top = slice(int(TOP * (len(density) - 1)), last + 1)
    level = float(np.mean(density[top]))
    if level <= 0.0:
        return Tail(0.0, False, 0.0)
    high = np.flatnonzero(density[: last + 1] > ABOVE_TAIL * level)
    first = max(int(high[-1]) + 1 if len(high) else 0, 4)  # the first bins hold the trend
    width = (last + 1 - first) / len(density)
    effective = max(0.5 * min(windows * window / 4.0, samples) * width, 1.0)
    uncertainty = float(1.0 / np.sqrt(2.0 * effective))
    if width < NARROWEST:
        return Tail(float(np.sqrt(level)), False, uncertainty)
    # A random walk's density is one over (2 - 2 cos), also where sampling folds it.
    walk = 1.0 / (2.0 - 2.0 * np.cos(np.pi * index[first : last + 1] / (len(density) - 1)))
    part = density[first : last + 1]
    terms = np.column_stack([np.ones_like(walk), walk, walk**2, walk**4])
    expected = part
    for _ in range(3):  # the scatter of a density is in proportion to what is expected of it
        shares = nnls(terms / expected[:, None], part / expected)[0]
        expected = np.maximum(terms @ shares, 1e-3 * level)
    white = float(shares[0])
    is_flat = white >= (1.0 - MOST_COLOUR - uncertainty) * level
    if white > LIVELY * _variance(pieces):  # most of it is noise, or the signal is alive throughout
        is_flat &= width >= WIDE
    begins = 0.5 * first / (len(density) - 1)
    return Tail(float(np.sqrt(white if is_flat else level)), is_flat, uncertainty, begins)


def _variance(pieces: Sequence[Array]) -> float:
    return float(np.mean([np.var(piece) for piece in pieces]))


def measure_density(pieces: Sequence[Array], window: int) -> tuple[Array, int] | None:
    """Return the density, shape (window // 2 + 1,), and in how many windows it was measured.

    White noise's density is its variance. None if no stretch is as long as a window.
    """
    cut = [_cut_windows(piece, window) for piece in pieces if len(piece) >= window + 2]
    if not cut:
        return None
    parts = np.concatenate(cut)
    # Differences first: what is slow would leak into the tail, however good the window.
    curvature = np.diff(parts, 2, axis=1)
    shape = _shape_window(window)
    spectra = np.abs(np.fft.rfft(curvature * shape, axis=1)) ** 2 / np.sum(shape**2)
    angle = np.linspace(0.0, np.pi, window // 2 + 1)[1:]
    spectra[:, 1:] /= (2.0 - 2.0 * np.cos(angle)) ** 2
    # Densities are distributed as chi-square of two degrees: the median is log 2 of the mean.
    return _debiased_median(spectra), len(parts)


def _shape_window(samples: int) -> Array:
    """Return the window of Blackman and Harris with four terms, for a period of samples."""
    turn = 2.0 * np.pi * np.arange(samples) / samples
    weights = (0.35875, -0.48829, 0.14128, -0.01168)
    shape: Array = sum(w * np.cos(k * turn) for k, w in enumerate(weights)) + np.zeros(samples)
    return shape


def _debiased_median(spectra: Array) -> Array:
    windows = len(spectra)
    # Median of an exponential distribution for few draws, which is not yet log 2.
    odd = windows if windows % 2 else windows + 1
    harmonic = float(np.sum(1.0 / np.arange((odd + 1) // 2, odd + 1)))
    median: Array = np.median(spectra, axis=0) / harmonic
    return median


def _cut_windows(piece: Array, window: int) -> Array:
    view = np.lib.stride_tricks.sliding_window_view(piece, window + 2)
    return np.asarray(view[:: window // 4])


def find_cutoff(pieces: Sequence[Array]) -> float | None:
    """Return where a filter cut off the spectrum, as a share of the sampling rate; None if nowhere.

    The density falls steeply there, from a shelf of noise that is far below the motion's power.
    """
    octaves = _measure_octaves(pieces)
    if octaves is None:
        return None
    shares, levels, beyond = octaves
    for k in range(2, len(shares) - 2):
        before, after = levels[k - 2] - levels[k], levels[k] - levels[k + 2]
        if after >= STEEP and before <= SHELF and beyond[k] < FAINT:
            return float(shares[k])
    return None


def falls_steeply(pieces: Sequence[Array]) -> bool:
    """Tell whether the density falls anywhere as steeply as behind a filter's edge."""
    octaves = _measure_octaves(pieces)
    return octaves is not None and bool(np.any(octaves[1][:-2] - octaves[1][2:] >= STEEP))


def _measure_octaves(pieces: Sequence[Array]) -> tuple[Array, Array, Array] | None:
    """Return half-octaves: frequency over sampling rate, log2 of the density, power beyond."""
    longest = max(map(len, pieces), default=0)
    window = 1 << min(int(np.log2(max(longest - 2, 1))), 10)
    found = measure_density(pieces, window) if window >= 128 else None
    if found is None:
        return None
    density = found[0]
    beyond = np.cumsum(density[:0:-1])[::-1] / max(float(np.sum(density[1:])), 1e-300)
    centres = 8.0 * np.sqrt(2.0) ** np.arange(int(2 * np.log2(len(density) / 8.0)))
    levels = [float(np.median(density[int(c / 1.09) : int(c * 1.09) + 1])) for c in centres]
    return (
        centres / window,
        np.log2(np.maximum(levels, 1e-300)),
        beyond[centres.astype(int) - 1],
    )


QUIETEST = 1e-6
"""No sensor's noise is smaller than this share of the channel's span: less is a filter's work."""
STILL_S, AFTER_S = 0.1, 0.05
"""A step of the command counts if it rested this long before; the answer is taken after it."""
BEFORE_CUTOFF = 0.15
"""A filter without delay shows a step this many periods of its cutoff ahead."""
LEAST_AHEAD = 0.005
"""Share of the answer that must be there before its cause."""
FEWEST_STEPS = 3
FEWEST_AT_REST = 256
"""Samples of a rest that show an edge in its noise."""


class Filtering(NamedTuple):
    """How a channel was filtered."""

    cutoff_hz: float | None
    """Where its spectrum is cut off; None if no edge is visible."""
    is_zero_phase: bool
    """A step begins before its cause, as a filter does that runs forwards and backwards."""


def find_filtering(records: Sequence[Record], channel: str) -> Filtering | None:
    """Return how a channel was filtered; None if it shows no sign of that."""
    pieces = [r[channel][part] for r in records for part in cut_even_stretches(r)]
    tail = find_tail(pieces)
    span = max(float(np.ptp(r[channel])) for r in records)
    period_s = records[0].period_s
    step = max(find_sensor_step(r[channel]) for r in records)
    if tail is not None and tail.is_flat and tail.deviation > max(QUIETEST * span, 0.4 * step):
        return None  # a filter would have taken this noise away
    rests = [r[channel][: r.rest_samples] for r in records]
    share = find_cutoff([rest for rest in rests if len(rest) >= FEWEST_AT_REST])
    is_too_quiet = False
    if not step:  # a converter's steps end a spectrum as a filter's edge does
        share = share or find_cutoff(pieces)
        is_too_quiet = tail is not None and tail.deviation < QUIETEST * span
    if share is None and not is_too_quiet:
        return None
    cutoff_hz = None if share is None else share / period_s
    return Filtering(cutoff_hz, _is_ahead(records, channel, cutoff_hz))


def _is_ahead(records: Sequence[Record], channel: str, cutoff_hz: float | None) -> bool:
    """Tell whether a channel answers steps of the command before they come."""
    shares = np.array(
        [
            share
            for record in records
            if record.valve_v is not None
            for share in _measure_ahead(record, channel, cutoff_hz)
        ]
    )
    if len(shares) < FEWEST_STEPS:
        return False
    error = float(shares.std(ddof=1)) / np.sqrt(len(shares))
    return bool(np.median(shares) > LEAST_AHEAD and shares.mean() > 3.0 * error)


def _measure_ahead(record: Record, channel: str, cutoff_hz: float | None) -> list[float]:
    """Return, for each step of the command, the share of the answer that comes before it."""
    command, values = record["valve_v"], record[channel]
    period_s = record.period_s
    still, after = round(STILL_S / period_s), max(round(AFTER_S / period_s), 1)
    clear = round(min(0.5 / (cutoff_hz or 30.0), 0.5 * STILL_S) / period_s)
    last = round(BEFORE_CUTOFF / (cutoff_hz or 30.0) / period_s)
    least = 0.2 * float(np.ptp(command))
    shares = []
    for jump in (np.flatnonzero(np.abs(np.diff(command)) > max(least, 1e-9)) + 1).tolist():
        if jump < still or jump + after >= len(record) or np.ptp(command[jump - still : jump]):
            continue
        before = _extend_line(values[jump - still : jump - clear], clear - last)
        whole = float(values[jump + after] - before)
        if whole:
            shares.append(float(values[jump - last] - before) / whole)
    return shares


def _extend_line(values: Array, by: int) -> float:
    """Return where the straight line through some values is, so many samples later."""
    index = np.arange(len(values), dtype=np.float64)
    return float(np.polynomial.Polynomial.fit(index, values, 1)(len(values) - 1.0 + by))
