"""What an analog converter does to a voltage: clamp it to the range and round it to a code."""

from __future__ import annotations

import math
from typing import NamedTuple


class Converter(NamedTuple):
    """An ideal bipolar 16-bit converter of a given full scale, as the PCI-6221's are."""

    full_scale_v: float
    levels: float = 65536.0


def quantise_v(converter: Converter, volts: float) -> float:
    """Return the voltage of the nearest code, at most one step below full scale."""
    full_scale_v, levels = converter
    step = 2.0 * full_scale_v / levels
    # Clamped first: a huge voltage has no integer code to be rounded to.
    if volts >= full_scale_v - step:
        return full_scale_v - step
    if volts <= -full_scale_v:
        return -full_scale_v
    return math.floor(volts / step + 0.5) * step


class Output(NamedTuple):
    """An analog output that is kept within a range; both ends are codes of its converter."""

    converter: Converter
    lowest_v: float
    highest_v: float


def make_output(converter: Converter, low_v: float, high_v: float) -> Output:
    """Return an output that reaches from the lowest to the highest code between two voltages."""
    step = 2.0 * converter.full_scale_v / converter.levels
    return Output(
        converter,
        quantise_v(converter, math.ceil(low_v / step) * step),
        quantise_v(converter, math.floor(high_v / step) * step),
    )


def nearest_output_v(output: Output, volts: float) -> float:
    """Return the voltage that an output really applies when told `volts`."""
    return min(max(quantise_v(output.converter, volts), output.lowest_v), output.highest_v)
