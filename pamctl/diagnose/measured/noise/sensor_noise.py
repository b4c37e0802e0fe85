"""Sensor noise: stated, or estimated from the rests or the spectrum; and drawn for the monitor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import ndtri

from pamctl.diagnose.measured.noise.filtering import QUIETEST
from pamctl.diagnose.measured.noise.spectrum import falls_steeply, find_tail
from pamctl.diagnose.measured.noise.time_stamps import cut_even_stretches
from pamctl.diagnose.measured.record import Array, Record
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
