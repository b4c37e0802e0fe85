"""Whether a column's volts can be the command, -5..5 V, and what a map makes of a driver's own."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from pamctl.log.importing.column_map import ValveMap
from pamctl.log.importing.headers import UNITS

if TYPE_CHECKING:
    from pamctl.log.importing.measured_table import Floats

Doubt = tuple[str, str, dict[str, Any]]
"""What is doubtful; the column's name, and its keys in a map, that would mend it."""


def doubt_command(part: ValveMap, values: Floats) -> Iterator[Doubt]:
    """Yield what is doubtful of a command's finite values in V, at most once."""
    if not len(values):
        return
    low, high = float(values.min()), float(values.max())
    if is_switched(values) or (low == high and high > 4.0):
        yield (
            "a valve that switches? The file does not say which level fills. In the map, gain and "
            "offset must turn the level that fills into 5 V, the one that exhausts into -5 V, and "
            "one that closes into 0 V",
            "",
            {},
        )
    elif low >= -0.05 and high < 10.5 and (high > 5.05 or 4.0 < np.median(values) < 6.0):
        yield (
            "are these the driver's 0..10 V, where 5 V closes and more fills? The command is "
            "-5..5 V; map it with offset: -5.0",
            "",
            {"offset": part.offset - 5.0 / UNITS["valve_v"][part.unit]},
        )
    elif 5.05 < max(-low, high) < 10.5 and low < -2.5:
        yield (
            "are these the driver's -10..10 V? The command is -5..5 V; map it with gain: 0.5, or "
            "another column is the command",
            "",
            {"gain": 0.5 * part.gain, "offset": 0.5 * part.offset},
        )
    elif max(-low, high) > 5.05:
        within = "the command is within -5..5 V; gain and offset in the map turn it into that"
        yield f"{within}, or another column is the command", "", {}


def is_switched(volts: Floats) -> bool:
    """Tell whether a voltage, shape (n,), is switched: 0 V and one or two levels, maybe noisy."""
    low, high = np.quantile(volts, (0.002, 0.998))
    if high < 3.0 or abs(low) > 0.05 * high:
        return False
    counts = np.histogram(volts, 40, (low - 0.0625 * high, high + 0.0625 * high))[0]
    busy = counts > 0.01 * len(volts)
    levels = np.count_nonzero(np.diff(busy.astype(np.int8), prepend=0) == 1)
    return bool(levels <= 3 and busy.sum() <= 2 * levels and counts[busy].sum() > 0.95 * len(volts))
