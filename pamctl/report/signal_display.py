"""How a measured signal and its gap to a model are shown: users think in mm, µm and kPa."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

LARGE_GAP = 1e4
"""A gap of more of its units is shown in the unit of the signal: 20 mm, not 2e+04 µm."""


class SignalDisplay(NamedTuple):
    """Its title, and the units of itself and of a gap with their factors from SI."""

    title: str
    unit: str
    factor: float
    gap_unit: str
    gap_factor: float

    @property
    def short(self) -> str:
        """The title without its detail, in a sentence."""
        return self.title.split(",")[0].lower()

    def choose_unit(self, largest: float) -> tuple[float, str]:
        """Return factor and unit for all gaps of a signal; `largest` is the largest of them, SI.

        A large one is shown as the signal is: one unit on the whole page.
        """
        if largest * self.gap_factor < LARGE_GAP:
            return self.gap_factor, self.gap_unit
        return self.factor, self.unit


SIGNAL_DISPLAYS: Mapping[str, SignalDisplay] = {
    "position_m": SignalDisplay("Displacement", "mm", 1e3, "µm", 1e6),
    "pressure_pa": SignalDisplay("Pressure, absolute", "kPa", 1e-3, "kPa", 1e-3),
    "force_n": SignalDisplay("Force", "N", 1.0, "N", 1.0),
}


def spell_figure(value: float) -> str:
    """Return a figure with three digits, and a large one without a power of ten."""
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"
