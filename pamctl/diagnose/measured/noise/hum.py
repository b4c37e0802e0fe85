"""Mains hum: a steady sinusoid of 50 or 60 Hz in a channel; it is fitted and taken off.

It belongs to the sensor's cable and not to the rig. A line that the command has too is the rig's.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, uniform_filter1d
from scipy.signal import butter, sosfiltfilt, sosfreqz

from pamctl.diagnose.measured.record import Array

MAINS_HZ = (50.0, 60.0)
OFF_HZ = 0.5
"""Mains are at most this far from their frequency."""
LINE = 6.0
"""A line stands out of the density beside it by this factor."""
LEFT = 2.5
"""A density of less, over that beside it, is no line."""
LEAST_TAKEN = 0.9
"""Share of a line that a sinusoid takes off; less is not a steady sinusoid."""
BAND = (0.7, 1.4)
"""The sinusoid is fitted to what lies in this band around it: motion is slower, noise faster."""
LARGEST = 0.05
"""Share of the channel's span that hum may have; more would be an excitation."""
STILL_S, SETTLED_S = 0.3, 0.15
"""A command that stands still for this long in all, after it has settled, must show the hum too."""
THERE = (0.7, 1.4)
"""The hum while the command stands still, over what it is on the whole."""
COMMANDED, NEIGHBOUR = 1e-2, 0.1
"""Share of the command's span that a sinusoid in it must have; a step has less at such rates. It
may be this far from the mains, as a share of their frequency: the answer to it is broader."""
PADDED = 15
"""Samples that are mirrored at each end."""
SHORTEST_S = 2.0
"""A shorter stretch does not tell a line from its neighbours."""
STEADY_S = 4.0
"""Amplitude and phase may change from one such time to the next, for mains drift a little."""


class Hum(NamedTuple):
    """A sinusoid found in a channel."""

    frequency_hz: float
    """Of the mains; sampling may show it at a lower frequency."""
    amplitude: float
    """In the channel's unit."""


def remove_hum(values: Array, period_s: float, command: Array | None) -> tuple[Array, list[Hum]]:
    """Return evenly sampled values without hum, and the hum that was there."""
    found: list[Hum] = []
    if len(values) * period_s < SHORTEST_S:
        return values, found
    for mains_hz in MAINS_HZ:
        share = _fold(mains_hz * period_s)
        half_width = OFF_HZ * period_s
        # The slow end holds the motion; close to half the sampling rate there is no neighbour.
        line = _measure_line(values, share, half_width, period_s) if 0.04 < share < 0.48 else 0.0
        if line < LINE:
            continue
        still = _find_still(command, period_s)
        if command is not None and not still.any() and _is_commanded(command, share):
            continue
        sinusoid = _fit_sinusoid(values, share, half_width, period_s)
        amplitude = float(np.sqrt(2.0) * sinusoid.std())
        rest = values - sinusoid
        if still.any() and not _is_there(values, sinusoid, still, share):
            continue
        if amplitude > LARGEST * float(np.ptp(values)):
            continue
        if _measure_line(rest, share, half_width, period_s) < max(LEFT, (1.0 - LEAST_TAKEN) * line):
            values = rest
            found.append(Hum(mains_hz, amplitude))
    return values, found


def _fold(cycles: float) -> float:
    """Return the frequency at which sampling shows it, in cycles per sample."""
    return abs(cycles - round(cycles))


def _is_there(values: Array, sinusoid: Array, still: NDArray[np.bool_], share: float) -> bool:
    """Tell whether the values have the sinusoid, at its full size, while the command is still."""
    part, band = sinusoid[still], _pass_band(values, share)
    fitting = float(band[0][still] @ part) / band[1] / max(float(part @ part), 1e-300)
    size = float(part.std()) / max(float(sinusoid.std()), 1e-300)
    return THERE[0] < fitting < THERE[1] and THERE[0] < size < THERE[1]


def _find_still(command: Array | None, period_s: float) -> NDArray[np.bool_]:
    """Mark where the command has stood still for a while; nowhere if that is too short to show."""
    if command is None:
        return np.zeros(0, np.bool_)
    around = 2 * round(SETTLED_S / period_s) + 1
    change = maximum_filter1d(np.abs(np.diff(command, prepend=command[0])), around)
    still: NDArray[np.bool_] = change == 0.0
    return still if float(still.sum()) * period_s >= STILL_S else np.zeros_like(still)


def _is_commanded(command: Array, share: float) -> bool:
    """Tell whether the command itself has a visible part near a frequency."""
    taper = np.hanning(len(command))
    frequencies = np.fft.rfftfreq(4 * len(command))
    amplitudes = np.abs(np.fft.rfft((command - command.mean()) * taper, 4 * len(command)))
    near = np.abs(frequencies - share) <= NEIGHBOUR * share
    amplitude = 2.0 * float(amplitudes[near].max(initial=0.0)) / float(taper.sum())
    return amplitude > COMMANDED * float(np.ptp(command))


def _measure_line(values: Array, share: float, half_width: float, period_s: float) -> float:
    """Return by what factor the power at a frequency stands out of that beside it."""
    band = _pass_band(values, share)[0]
    quiet = band * _weigh_quiet(band, share)
    length = min(round(STEADY_S / period_s), len(values))
    parts = quiet[: len(quiet) // length * length].reshape(-1, length) * np.hanning(length)
    power = np.sum(np.abs(np.fft.rfft(parts, axis=1)) ** 2, axis=0)
    off = np.abs(np.fft.rfftfreq(length) - share)
    inside = off <= max(half_width, 1.0 / length)
    beside = ~inside & (off > 3.0 / length) & (off < (BAND[1] - 1.0) * share)
    # A motion with a period has lines everywhere: the strongest neighbours count.
    usual = float(np.quantile(power[beside], 0.9)) if beside.sum() > 8 else 0.0
    return float(power[inside].max()) / usual if usual > 0.0 else 0.0


def _pass_band(values: Array, share: float) -> tuple[Array, float]:
    """Return what lies around a frequency, and the filter's gain there."""
    band = [BAND[0] * share, min(BAND[1] * share, 0.49)]
    sections = butter(2, band, "bandpass", fs=1.0, output="sos")
    (passed,) = sosfreqz(sections, [2.0 * np.pi * share])[1]
    filtered = sosfiltfilt(sections, values, padlen=min(PADDED, len(values) - 1))
    return np.asarray(filtered), float(abs(passed) ** 2)


def _weigh_quiet(band: Array, share: float) -> Array:
    """Return weights: what moves the rig is loud for a while, and hum is there all the time."""
    level = uniform_filter1d(band**2, max(round(2.0 / share), 3))
    least = max(float(np.quantile(level, 0.2)), 1e-9 * float(level.max()))
    weights: Array = least / np.maximum(level, least) if least > 0.0 else np.ones(len(band))
    return weights


def _fit_sinusoid(values: Array, share: float, half_width: float, period_s: float) -> Array:
    """Fit a sinusoid whose amplitude and phase change slowly, mostly where the motion is quiet."""
    index = np.arange(len(values), dtype=np.float64)
    band, gain = _pass_band(values, share)
    weights = _weigh_quiet(band, share)
    frequencies = np.fft.rfftfreq(8 * len(values))
    spectrum = np.abs(np.fft.rfft(band * weights * np.hanning(len(band)), 8 * len(values)))
    spectrum[np.abs(frequencies - share) > half_width] = 0.0
    pieces = max(round(len(values) * period_s / STEADY_S), 1)
    knots = np.linspace(0.0, len(values) - 1.0, pieces + 1)
    hats = np.stack([np.interp(index, knots, row) for row in np.eye(len(knots))], axis=1)
    angle = 2.0 * np.pi * float(frequencies[np.argmax(spectrum)]) * index[:, None]
    waves = np.concatenate([hats * np.cos(angle), hats * np.sin(angle)], axis=1)
    for _ in range(3):
        fitted = np.linalg.lstsq(waves * weights[:, None], band * weights, rcond=None)[0]
        weights = _weigh_quiet(band - waves @ fitted, share)
    sinusoid: Array = waves @ fitted / gain
    return sinusoid
