"""Mains hum: a steady sinusoid of 50 or 60 Hz in a channel; it is fitted and taken off.

It belongs to the sensor's cable and not to the rig. A line that the command has too is the rig's.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.measured.spectrum import measure_density

MAINS_HZ = (50.0, 60.0)
OFF_HZ = 0.5
"""Mains are at most this far from their frequency."""
LINE = 10.0
"""A line stands out of the density beside it by this factor."""
LEFT = 4.0
"""A density of less, over that beside it, is no line."""
LEAST_TAKEN = 0.9
"""Share of a line that a sinusoid takes off; less is not a steady sinusoid."""
BESIDE_HZ = 2.0
"""The sinusoid is fitted to what lies this close to it: the motion is slower, most noise faster."""
LARGEST = 0.05
"""Share of the channel's span that hum may have; more would be an excitation."""
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
        line = _measure_line(values, share, half_width) if 0.04 < share < 0.48 else 0.0
        if line < LINE:
            continue
        if command is not None and _measure_line(command, share, half_width) > LEFT:
            continue
        sinusoid = _fit_sinusoid(values, share, half_width, period_s)
        amplitude = float(np.sqrt(2.0) * sinusoid.std())
        rest = values - sinusoid
        if amplitude > LARGEST * float(np.ptp(values)):
            continue
        if _measure_line(rest, share, half_width) < max(LEFT, (1.0 - LEAST_TAKEN) * line):
            values = rest
            found.append(Hum(mains_hz, amplitude))
    return values, found


def _fold(cycles: float) -> float:
    """Return the frequency at which sampling shows it, in cycles per sample."""
    return abs(cycles - round(cycles))


def _measure_line(values: Array, share: float, half_width: float) -> float:
    """Return by what factor the density at a frequency stands out of that beside it."""
    # Windows in which the possible frequencies take less than a bin, if the record is so long.
    wanted = 1 << int(np.ceil(np.log2(1.0 / half_width)))
    window = min(wanted, 1 << int(np.log2(max(len(values) / 2.0, 1.0))))
    measured = measure_density([values], window) if window >= 64 else None
    if measured is None:
        return 0.0
    density = measured[0]
    at = share * window
    near = np.abs(np.arange(len(density)) - at)
    beside = density[(near > 5.0) & (near < 16.0)]
    inside = density[near <= max(1.0, half_width * window)]
    usual = float(np.median(beside)) if len(beside) > 4 else 0.0
    return float(inside.max()) / usual if usual > 0.0 and len(inside) else 0.0


def _fit_sinusoid(values: Array, share: float, half_width: float, period_s: float) -> Array:
    """Fit a sinusoid whose amplitude and phase change slowly, beside a signal that is slow."""
    index = np.arange(len(values), dtype=np.float64)
    frequencies, spectrum = _transform(values[:, None])
    near = np.abs(frequencies - share) <= half_width
    share = float(frequencies[near][np.argmax(np.abs(spectrum[near, 0]))])
    knots = np.linspace(
        0.0, len(values) - 1.0, max(round(len(values) * period_s / STEADY_S), 1) + 1
    )
    hats = np.stack([np.interp(index, knots, row) for row in np.eye(len(knots))], axis=1)
    angle = 2.0 * np.pi * share * index[:, None]
    waves = np.concatenate([hats * np.cos(angle), hats * np.sin(angle)], axis=1)
    beside = np.abs(frequencies - share) <= BESIDE_HZ * period_s
    columns, wanted = _transform(waves)[1][beside], spectrum[beside, 0]
    fitted = np.linalg.lstsq(
        np.concatenate([columns.real, columns.imag]),
        np.concatenate([wanted.real, wanted.imag]),
        rcond=None,
    )[0]
    sinusoid: Array = waves @ fitted
    return sinusoid


def _transform(columns: Array) -> tuple[Array, NDArray[np.complex128]]:
    """Return frequencies in cycles per sample, and the spectra of the columns' curvature."""
    curvature = np.diff(columns, 2, axis=0)
    tapered = curvature * np.hanning(len(curvature))[:, None]
    frequencies: Array = np.fft.rfftfreq(len(curvature)).astype(np.float64)
    return frequencies, np.fft.rfft(tapered, axis=0)
