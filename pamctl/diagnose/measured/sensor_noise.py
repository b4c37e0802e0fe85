"""Sensor noise: estimated from the rest, and drawn again for the self-simulated floor."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from pamctl.diagnose.measured.record import Array, Record, estimate_resolution

ORDER = 12
"""Order of the autoregressive model: enough for a filtered or drifting sensor."""
ENOUGH = 200
"""With fewer samples at rest, the noise is estimated from differences."""


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

    @property
    def total(self) -> float:
        """Standard deviation with the converter's rounding."""
        return float(np.hypot(self.deviation, self.resolution / np.sqrt(12.0)))

    def draw(self, samples: int, random: np.random.Generator) -> Array:
        """Draw a stretch of noise, not yet rounded."""
        if not self.memory:
            return random.normal(0.0, self.deviation, samples)
        settle = 200
        innovation = random.normal(0.0, self.drive, samples + settle)
        drawn: Array = lfilter([1.0], [1.0, *(-m for m in self.memory)], innovation)[settle:]
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
    """Estimate a channel's noise over records, from the rests or else from differences.

    A median of differences would not do: the converter's step quantises it.
    """
    step = float(np.median([estimate_resolution(r[channel]) for r in records]))
    rests = [r[channel][: r.rest_samples] for r in records]
    rests = [_remove_trend(rest) for rest in rests if len(rest) >= ENOUGH // 2]
    differences = float(np.median([_estimate_from_differences(r[channel]) for r in records]))
    if sum(map(len, rests)) < ENOUGH:
        return Noise(_subtract_rounding(differences, step), (), 0.0, step, 0.02)
    rested = _estimate_from_rests(rests, step)
    # White noise has no memory: the whole run shows its size better than a second of rest.
    close = abs(differences - rested.total) < 4.0 * rested.uncertainty * rested.total
    if rested.deviation and not rested.memory and close:
        return Noise(_subtract_rounding(differences, step), (), 0.0, step, 0.005)
    return rested


def _remove_trend(rest: Array) -> Array:
    index = np.arange(len(rest), dtype=np.float64)
    fitted: Array = np.polynomial.Polynomial.fit(index, rest, 1)(index)
    return rest - fitted


def _estimate_from_rests(rests: Iterable[Array], step: float) -> Noise:
    """Solve the Yule-Walker equations for the pooled autocovariance of the rests."""
    pieces = [rest for rest in rests if len(rest) > 4 * ORDER]
    lags = np.zeros(ORDER + 1)
    for piece in pieces:
        lags += [float(piece[lag:] @ piece[: len(piece) - lag]) for lag in range(ORDER + 1)]
    lags /= sum(map(len, pieces))
    deviation = float(np.sqrt(lags[0]))
    if deviation <= 0.6 * step:  # only the converter is visible
        return Noise(0.0, (), 0.0, step)
    lags[0] -= step**2 / 12.0
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


def _relative_uncertainty(pieces: Sequence[Array], worth: float) -> float:
    """Return the scatter of an estimated deviation; each sample counts as `worth` samples."""
    return float(1.0 / np.sqrt(2.0 * worth * sum(map(len, pieces))))


def _estimate_from_differences(values: Array) -> float:
    """Use third differences; leave out the largest tenth, which steps of the command cause."""
    third = np.abs(np.diff(values, 3))
    kept = third[third <= np.quantile(third, 0.9)]
    # A normal variable cut at its 90 % quantile keeps 0.7893 of its RMS. Third differences
    # multiply white noise by sqrt(20).
    return float(np.sqrt(np.mean(kept**2)) / (0.7893 * np.sqrt(20.0)))


def _subtract_rounding(deviation: float, step: float) -> float:
    return float(np.sqrt(max(deviation**2 - step**2 / 12.0, 0.0)))
