"""Which gains each law has, and between which bounds they are sought.

All on a logarithmic scale: a gain that is twice as large is as different as one half as
large. Only lambda^q enters the sliding laws, so q stays where the paper has it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from pamctl.control.law import ControllerSettings

Floats = NDArray[np.float64]

_CONTROLLER: TypeAdapter[Any] = TypeAdapter(ControllerSettings)
_DIGITS = 4


class Axis(NamedTuple):
    """One gain."""

    name: str
    low: float
    high: float
    usual: float
    """Where a search begins unless told."""


class Space(NamedTuple):
    """The gains of a law in mm, and what stays fixed."""

    fixed: dict[str, Any]
    axes: tuple[Axis, ...]

    @property
    def bounds(self) -> list[tuple[float, float]]:
        """Bounds of the search, in powers of ten."""
        return [(float(np.log10(a.low)), float(np.log10(a.high))) for a in self.axes]

    @property
    def usual(self) -> Floats:
        """The point where a search begins unless told."""
        return np.log10([a.usual for a in self.axes])

    def gains(self, point: Floats) -> dict[str, Any]:
        """Return a point (powers of ten, shape (axes,)) as a controller file has it.

        Rounded as the file will be: what is scored is what is written.
        """
        values = (
            float(f"{10.0**x:.{_DIGITS}g}") for x in np.asarray(point, dtype=np.float64).tolist()
        )
        return {**self.fixed, **{a.name: v for a, v in zip(self.axes, values, strict=True)}}

    def controller(self, point: Floats) -> Any:
        """Return a point as validated settings."""
        return _CONTROLLER.validate_python(self.gains(point))

    def point(self, gains: dict[str, Any]) -> Floats:
        """Return a controller file's gains as a point, moved inside the bounds."""
        found = [np.log10(max(float(gains[a.name]), a.low)) for a in self.axes]
        low, high = np.array(self.bounds).T
        inside: Floats = np.clip(found, low, high)
        return inside


_CUTOFFS = (Axis("lpf1_hz", 40.0, 440.0, 300.0), Axis("lpf2_hz", 10.0, 440.0, 200.0))
_SLIDING: dict[str, Any] = {"length_unit": "mm", "reaching_law": "eta_abs_s"}

SPACES: dict[str, Space] = {
    "qsmc": Space(
        {"law": "qsmc", **_SLIDING, "q": 1.75},
        (
            Axis("lambda_per_s", 5.0, 80.0, 32.0),
            Axis("kp_v_s3_per_length", 1e-9, 1e-5, 1e-7),
            Axis("eta", 1e-4, 1e2, 2.0),
            Axis("phi", 1e-1, 1e6, 10.0),
            *_CUTOFFS,
        ),
    ),
    "smc": Space(
        {"law": "smc", **_SLIDING, "q": 1.0, "model": {}},
        (
            Axis("lambda_per_s", 30.0, 3000.0, 360.0),
            Axis("kp", 1e-3, 3.0, 1.0),
            Axis("eta", 1e-3, 1e3, 2.0),
            Axis("phi", 1e2, 1e9, 1e4),
            Axis("lpf1_hz", 40.0, 440.0, 300.0),
            Axis("lpf2_hz", 0.05, 440.0, 0.2),
        ),
    ),
    "pid": Space(
        {"law": "pid", "length_unit": "mm"},
        (
            Axis("kp_v_per_length", 0.1, 100.0, 10.0),
            Axis("ki_v_per_length_s", 1e-3, 200.0, 20.0),
            Axis("kd_v_s_per_length", 1e-4, 2.0, 0.12),
            *_CUTOFFS,
        ),
    ),
}
