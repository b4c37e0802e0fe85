"""What analog converters do to a voltage: clamp it to their range and round it to a code."""

from __future__ import annotations

import math
from typing import NamedTuple


class Converter(NamedTuple):
    """An ideal bipolar 16-bit converter of a given full scale, as the PCI-6221's are."""

    full_scale_v: float
    levels: float = 65536.0


def converted_v(converter: Converter, volts: float) -> float:
    """Return the voltage of the nearest code; half a step below full scale at the most."""
    full_scale_v = converter.full_scale_v
    step = 2.0 * full_scale_v / converter.levels
    # Clamped first: a code beyond every integer could not be rounded to one.
    code = math.floor(min(max(volts, -full_scale_v), full_scale_v) / step + 0.5)
    return min(code, 0.5 * converter.levels - 1.0) * step
