"""Stub."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pamctl.control.excitation import ProgramSettings
from pamctl.diagnose.deciding.separation import Separation


@dataclass(frozen=True)
class DecidingProgram:
    """The chosen program, and what is expected of it."""

    program: ProgramSettings
    explanations: tuple[str, ...]
    separations: tuple[Separation, ...]
    pressure_pa: float
    """Highest absolute pressure of all explanations."""
    low_m: float
    high_m: float
    duration_s: float
    drawn: int
    """Programs that were drawn."""
    inside: int
    """Those that stay within the limits."""
    limits_from: str

    @property
    def sureness(self) -> float:
        """The surest refutation; above 1, this program alone should refute an explanation."""
        return max(s.sureness for s in self.separations)

    @property
    def promises(self) -> bool:
        """Some explanation is refuted if another is true."""
        return self.sureness > 1.0

    @property
    def nearest(self) -> Separation:
        """The pair that is separated least."""
        return min(self.separations, key=lambda s: s.residual_over_floor)

    def to_experiment(self) -> dict[str, Any]:
        """Return the keys of the experiment file, with the forecast in it."""
        forecast = {
            "pairs": [
                {
                    "true": s.true,
                    "refuted": s.refuted,
                    "block": s.block,
                    "residual_over_floor": float(f"{s.residual_over_floor:.4g}"),
                }
                for s in self.separations
            ],
            "pressure_kpa": round(1e-3 * self.pressure_pa, 1),
            "low_mm": round(1e3 * self.low_m, 2),
            "high_mm": round(1e3 * self.high_m, 2),
        }
        keys = self.program.model_dump(mode="json", exclude_none=True)
        return {**keys, "forecast": forecast}


def choose_deciding_program(explanations, records, *, programs=0, seed=0):
    return None
