"""A drive whose plant, inputs or reading differ from what plant file and record say.

All later steps see a drive like any other: fits, floors and the search run upon a corrected set-up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Any

import numpy as np

from pamctl.diagnose.fitting.drives import MECHANICS, Drive
from pamctl.diagnose.measured.record import Array
from pamctl.plant.parameters import PaperParameters, PlantParameters

PIECES = 32
"""Pieces of a record in which a drifting number is constant."""
OVERLAP_S = 0.05
"""A piece starts so much earlier, at the output reached there: spool and speed settle in it."""


@dataclass(frozen=True)
class PlantChange:
    """A number of the plant that differs from the plant file, always or for a part of a record."""

    name: str
    amount: float
    """Relative for the plant's own numbers; for a number of an effect in its unit."""
    drift_over_s: float = 0.0
    """Above 0: grows from nothing at the start to `amount` after this time."""
    after_s: float = 0.0
    """Above 0: acts from this instant on."""

    def amount_at(self, t_s: float) -> float:
        """Return the amount at a time since the record's start."""
        if self.drift_over_s > 0.0:
            return self.amount * t_s / self.drift_over_s
        return self.amount if t_s >= self.after_s else 0.0


@dataclass(frozen=True)
class AlteredDrive(Drive):
    """A drive with a changed plant, and with a reading that is scaled or late."""

    changes: tuple[PlantChange, ...] = ()
    late_s: float = 0.0
    """The output's column is late by so much."""
    late_per_s: float = 0.0
    """How much later it becomes in each second."""
    gain: float = 1.0
    """Ratio of shown to true output."""
    shown_above: float = 0.0
    """Shown minus true output at every value: a gauge sensor with another atmosphere added."""

    def simulate_with(self, p: PlantParameters) -> Array:
        """Simulate the block as the altered set-up would show it."""
        if any(c.drift_over_s or c.after_s for c in self.changes):
            simulated = self._simulate_pieces(p)
        else:
            simulated = self._simulate_constant(p, 0.0)
        if self.late_s or self.late_per_s:
            t_s = np.concatenate([[0.0], np.cumsum(self.step_s)])
            simulated = np.interp(t_s - self.late_s - self.late_per_s * t_s, t_s, simulated)
        if self.gain != 1.0:
            simulated = self.gain * simulated
        return simulated + self.shown_above if self.shown_above else simulated

    def _simulate_constant(self, p: PlantParameters, t_s: float) -> Array:
        changed = p
        for change in self.changes:
            changed = change_plant(changed, change.name, change.amount_at(t_s))
        drive: Drive = self
        at_atmosphere = self.block != MECHANICS and self.start == p.atmospheric_pressure_pa
        if at_atmosphere and changed.atmospheric_pressure_pa != p.atmospheric_pressure_pa:
            drive = replace(self, start=changed.atmospheric_pressure_pa)
            drive.__dict__["grid"] = self.grid
        return Drive.simulate_with(drive, changed)

    def _simulate_pieces(self, p: PlantParameters) -> Array:
        """Simulate piece by piece; each starts where the one before was, a little earlier."""
        n = len(self.measured)
        t_s = np.concatenate([[0.0], np.cumsum(self.step_s)])
        cuts = {0, n}
        for change in self.changes:
            if change.drift_over_s:
                cuts |= {int(c) for c in np.linspace(0, n, PIECES + 1)}
            elif change.after_s:
                cuts.add(int(np.searchsorted(t_s, change.after_s)))
        edges = sorted(c for c in cuts if 0 <= c <= n)
        overlap = round(OVERLAP_S / float(np.median(self.step_s)))
        simulated: Array = np.zeros(n)
        for begin, end in pairwise(edges):
            first = max(begin - overlap, 0)
            start = self.start if not first else float(simulated[first])
            piece = replace(
                self,
                step_s=self.step_s[first : max(end - 1, first)],
                valve_v=self.valve_v[first:end],
                driven=self.driven[first:end],
                measured=self.measured[first:end],
                usable=None,
                part=None,
                start=start,
            )
            middle_s = 0.5 * float(t_s[begin] + t_s[end - 1])
            simulated[begin:end] = piece._simulate_constant(p, middle_s)[begin - first :]
        return simulated


def alter(drive: Drive, **changes: Any) -> AlteredDrive:
    """Return a drive with an altered set-up; an altered drive keeps what it has."""
    if isinstance(drive, AlteredDrive):
        return replace(drive, **changes)
    known = {f.name: getattr(drive, f.name) for f in fields(Drive)}
    return AlteredDrive(**{**known, **changes})


def add_change(drive: Drive, change: PlantChange) -> AlteredDrive:
    """Return the drive with one more change of the plant."""
    before = drive.changes if isinstance(drive, AlteredDrive) else ()
    return alter(drive, changes=(*before, change))


def change_plant(p: PlantParameters, name: str, amount: float) -> PlantParameters:
    """Return the plant with a number changed; a plant's own number by a share."""
    if amount == 0.0:
        return p
    if "." in name:
        return _change_effect(p, name, amount)
    return p._replace(paper=_change_paper(p.paper, name, 1.0 + amount))


def _change_paper(paper: PaperParameters, name: str, factor: float) -> PaperParameters:
    if name == "braid_turns":
        return paper._replace(volume_scale=paper.volume_scale / factor**2)
    if name == "kinetic_friction_per_m":
        return paper._replace(friction_area_m=paper.friction_area_m * factor)
    if name == "temperature_k":
        root = math.sqrt(factor)
        return paper._replace(
            specific_energy_j_per_kg=paper.specific_energy_j_per_kg * factor,
            choked_flow_s_per_m=paper.choked_flow_s_per_m / root,
            unchoked_flow_s_per_m=paper.unchoked_flow_s_per_m / root,
        )
    if name == "heat_capacity_ratio":
        return _change_gamma(paper, factor)
    return paper._replace(**{name: getattr(paper, name) * factor})


def _change_gamma(paper: PaperParameters, factor: float) -> PaperParameters:
    gamma = max(factor / paper.inverse_gamma, 1.001)
    critical = (2.0 / (gamma + 1.0)) ** (gamma / (gamma - 1.0))
    unchoked = math.sqrt(2.0 * gamma / ((gamma - 1.0) * paper.specific_energy_j_per_kg))
    return paper._replace(
        inverse_gamma=1.0 / gamma,
        critical_ratio=critical,
        choked_flow_s_per_m=unchoked
        * critical ** (1.0 / gamma)
        * math.sqrt(1.0 - critical ** ((gamma - 1.0) / gamma)),
        unchoked_flow_s_per_m=unchoked,
    )


_ACTING: dict[str, dict[str, Any]] = {
    "valve": {"valve_acts": True},
    "air": {"air_acts": True},
    "mechanics": {"mechanics_act": True},
    "sensors": {"sensors_act": True},
}


def _change_effect(p: PlantParameters, name: str, amount: float) -> PlantParameters:
    """Return the plant with a number of an effect moved by an amount in its unit."""
    effect, number = name.split(".")
    for part in p.effects._fields:
        group = getattr(p.effects, part)
        if effect in group._fields:
            numbers = getattr(group, effect)
            moved = numbers._replace(**{number: getattr(numbers, number) + amount})
            effects = p.effects._replace(**{part: group._replace(**{effect: moved})})
            return p._replace(effects=effects, **_ACTING[part])
    raise KeyError(name)
