"""A law's search space as points on logarithmic scales.

A factor of 2 is as large a step as a factor of 1/2. The law's record holds its gains and their
bounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pamctl.control.law import GainAxis, SearchSpace
from pamctl.control.law_registry import find_law, read_controller

Floats = NDArray[np.float64]

_DIGITS = 4


def _round_gains(gains: dict[str, Any]) -> dict[str, Any]:
    return {
        name: _round_gains(value) if isinstance(value, dict) else float(f"{value:.{_DIGITS}g}")
        for name, value in gains.items()
    }


@dataclass(frozen=True)
class GainSpace:
    """The search space of a law."""

    space: SearchSpace

    @property
    def axes(self) -> tuple[GainAxis, ...]:
        """The axes of the search."""
        return self.space.axes

    @property
    def bounds(self) -> list[tuple[float, float]]:
        """Bounds of the search, in powers of ten."""
        return [(float(np.log10(a.low)), float(np.log10(a.high))) for a in self.axes]

    @property
    def usual(self) -> Floats:
        """The point where a search begins by default."""
        return np.log10([a.usual for a in self.axes])

    def gains(self, point: Floats) -> dict[str, Any]:
        """Return a point (powers of ten, shape (axes,)) as a gains file has it.

        The gains are rounded as the file will be: what is scored is what is written.
        """
        values = (10.0 ** np.asarray(point, dtype=np.float64)).tolist()
        numbers = dict(zip((a.name for a in self.axes), values, strict=True))
        return {**self.space.fixed, **_round_gains(self.space.to_gains(numbers))}

    def controller(self, point: Floats) -> Any:
        """Return a point as validated settings."""
        return read_controller(self.gains(point))

    def point(self, gains: dict[str, Any]) -> Floats:
        """Return a gains file's keys as a point, moved inside the bounds."""
        numbers = self.space.from_gains(gains)
        found = [np.log10(max(numbers[a.name], a.low)) for a in self.axes]
        low, high = np.array(self.bounds).T
        inside: Floats = np.clip(found, low, high)
        return inside


def find_space(law: str, compensate: Sequence[str] = ()) -> GainSpace:
    """Return the space of an installed law; raise ValueError where it has none.

    Each of its gains also undoes the effects of `compensate`.
    """
    space = find_law(law).search
    if space is None:
        raise ValueError(
            f"the law {law!r} defines no search space; gains that exist can be scored with --check"
        )
    if compensate:
        space = space._replace(fixed={**space.fixed, "compensate": list(compensate)})
    return GainSpace(space)
