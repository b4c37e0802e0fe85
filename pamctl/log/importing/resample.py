"""Put a measurement on an even time grid, if the user asks for it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pamctl.log.importing.imported_log import nominal_period_s
from pamctl.log.importing.plausibility import GAP_PERIODS

Floats = NDArray[np.float64]


def resample_columns(
    t_s: Floats, quantities: Mapping[str, Floats], rate_hz: float
) -> tuple[Floats, dict[str, Floats]]:
    """Return times at `rate_hz` from the first time on, and the quantities at these times.

    Measured values are interpolated linearly, the valve command is held. Grid points within a gap
    are left out and count as missed.
    """
    # Include the last row if only rounding keeps it off the grid.
    count = int(np.floor((t_s[-1] - t_s[0]) * rate_hz * (1 + 1e-12) + 1e-9)) + 1
    grid = t_s[0] + np.arange(count) / rate_hz
    before = np.clip(np.searchsorted(t_s, grid, side="right") - 1, 0, len(t_s) - 2)
    step = np.diff(t_s)
    in_gap = step[before] > GAP_PERIODS * max(nominal_period_s(t_s), 1.0 / rate_hz)
    on_edge = (grid == t_s[before]) | (grid >= t_s[before + 1])
    kept = grid[~in_gap | on_edge]
    return kept, {
        name: _interpolate_at(kept, t_s, values, name) for name, values in quantities.items()
    }


def _interpolate_at(grid: Floats, t_s: Floats, values: Floats, name: str) -> Floats:
    if name == "valve_v":
        held: Floats = values[np.searchsorted(t_s, grid, side="right") - 1]
        return held
    return np.interp(grid, t_s, values)
