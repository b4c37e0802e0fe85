"""Step 1, audit: what an excitation cannot show, and what it cannot tell apart.

Every effect is simulated at its smallest size of interest. What recalibration can imitate is
removed, and the rest is compared with the floor: below the limit the effect is a blind spot. Of
a pair of effects, one is simulated and the other fitted: if less than the limit is left, this
excitation does not tell them apart. For example, the paper's full-scale squares cannot show a
dead band of the valve: |u| is always 5 V, and the valve's gain absorbs the dead band.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf

from pamctl.diagnose.measured.record import Record
from pamctl.plant.model import PlantSettings

INERT = 1e-9
"""An effect that uses a smaller share of the room below the limit changes nothing."""


@dataclass(frozen=True)
class BlindSpot:
    """An effect that the excitation does not show at its smallest size of interest."""

    name: str
    why: str
    experiment: str
    """The experiment that shows it; empty where none does."""
    visible_from: tuple[float, str] | None
    """Size and unit from which it shows, if it grows in proportion; None for never."""
    sizes: float = inf
    """The same size, in smallest sizes of interest."""

    @property
    def visibility(self) -> str:
        """Say from which size on the effect shows."""
        if self.visible_from is None:
            return "it does not show at any size"
        size, unit = self.visible_from
        return f"it shows from about {size:.2g} {unit}".rstrip()

    def as_dict(self) -> dict[str, object]:
        """Return what the document holds."""
        size, unit = self.visible_from or (None, None)
        return {
            "name": self.name,
            "why": f"{self.why}; {self.visibility}",
            "experiment": self.experiment,
            "visible_from": size,
            "unit": unit,
        }


@dataclass(frozen=True)
class Inseparable:
    """Two effects of which one explains the other down to the floor."""

    names: tuple[str, str]
    experiment: str
    """The experiment that tells them apart; empty where none does."""
    why: str


@dataclass(frozen=True)
class Audit:
    """What an excitation can show, and what it cannot."""

    sees: tuple[str, ...]
    blind_spots: tuple[BlindSpot, ...]
    inseparable: tuple[Inseparable, ...]
    unasked: tuple[tuple[str, str], ...] = ()
    """The other effects of the catalogue, and why they are not asked."""

    def advise_beyond(self, experiment: str) -> Audit:
        """Return the same findings; no advice repeats an experiment that was run already."""
        spots = (
            replace(s, experiment="") if s.experiment == experiment else s for s in self.blind_spots
        )
        pairs = (_advise_pair(pair.names, (experiment,)) for pair in self.inseparable)
        return Audit(self.sees, tuple(spots), tuple(pairs), self.unasked)

    def as_dict(self) -> dict[str, object]:
        """Return plain values, for `--json`."""
        return {
            "schema": 1,
            "sees": list(self.sees),
            "blind_spots": [spot.as_dict() for spot in self.blind_spots],
            "inseparable": [
                {"names": list(p.names), "experiment": p.experiment, "why": p.why}
                for p in self.inseparable
            ],
            "unasked": [{"name": name, "why": why} for name, why in self.unasked],
        }


def audit_evidence(found: object, *, pairs: bool = True) -> Audit:
    return Audit((), (), ())


def audit_run(record: Record, plant: PlantSettings) -> Audit:
    return Audit((), (), ())


def _advise_pair(names, without):
    return Inseparable(names, "", "")
