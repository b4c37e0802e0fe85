"""A drive whose plant, inputs or reading differ from what plant file and record say.

All later steps see a drive like any other: fits, floors and the search run upon a corrected set-up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from pamctl.bounded_memory import BoundedMemory
from pamctl.diagnose.fitting.drives import MECHANICS, Drive, smooth_signal
from pamctl.diagnose.measured.record import Array
from pamctl.plant.drive import Restarts
from pamctl.plant.parameters import PaperParameters, PlantParameters

PIECES = 64
"""Pieces of a record in which a drifting number is constant."""
FEWEST_WINDOWS, MOST_CUTS = 16, 128
"""Windows of a record from which pieces end where windows do; and pieces then, at most."""
OVERLAP_S = 0.05
"""A piece starts so much earlier, at the output reached there: spool and speed settle in it."""
_CUTS: BoundedMemory[tuple[Array]] = BoundedMemory(20_000_000)
"""Parts of columns: each simulation of a record cuts the same ones, and they share their grids."""


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
    filtered_hz: float = 0.0
    """Above 0: the column was filtered forwards and backwards, with this cutoff."""
    reads_gauge: bool = False
    """The pressure sensor measures against the true atmosphere; the plant file's was added."""

    def simulate_with(self, p: PlantParameters) -> Array:
        """Simulate the block as the altered set-up would show it."""
        if any(c.drift_over_s or c.after_s for c in self.changes):
            simulated = self._simulate_pieces(p)
        else:
            simulated = self._simulate_constant(p, 0.0)
        return self.show_output(simulated)

    def show_output(self, true: Array) -> Array:
        """Return a simulated output as the record's column shows it: late, filtered and scaled."""
        shown = true
        if self.late_s or self.late_per_s:
            t_s = self.times_s
            shown = interpolate_smoothly(t_s - self.late_s - self.late_per_s * t_s, t_s, shown)
        if self.filtered_hz:
            shown = smooth_signal(shown, self.step_s, self.filtered_hz)
        return shown if self.gain == 1.0 else self.gain * shown

    def without_filter(self) -> Drive:
        """Return the drive as its sensor showed it."""
        return replace(self, filtered_hz=0.0) if self.filtered_hz else self

    @cached_property
    def _restarts(self) -> Restarts:
        """The true states at which windows start, behind a scaled reading."""
        shown = super()._restarts
        return shown._replace(outputs=shown.outputs / self.gain, rates=shown.rates / self.gain)

    def _simulate_constant(self, p: PlantParameters, t_s: float) -> Array:
        changed = p
        for change in self.changes:
            changed = change_plant(changed, change.name, change.amount_at(t_s))
        raised_pa = changed.atmospheric_pressure_pa - p.atmospheric_pressure_pa
        if self.block == MECHANICS or not raised_pa:
            return Drive.simulate_with(self, changed)
        shown_pa = -raised_pa if self.reads_gauge else 0.0
        vents = self.start == p.atmospheric_pressure_pa
        true = replace(self, start=self.start + raised_pa if vents else self.start - shown_pa)
        starts = self._restarts
        starts = starts._replace(outputs=starts.outputs - shown_pa)
        true.__dict__.update(grid=self.grid, _restarts=starts)
        return Drive.simulate_with(true, changed) + shown_pa

    def _simulate_pieces(self, p: PlantParameters) -> Array:
        """Simulate piece by piece; each starts where the one before was, a little earlier."""
        n = len(self.measured)
        t_s = self.times_s
        cuts = {0, n}
        for change in self.changes:
            if change.drift_over_s:
                cuts |= self._cut_drift()
            elif change.after_s:
                cuts.add(int(np.searchsorted(t_s, change.after_s)))
        edges = sorted(c for c in cuts if 0 <= c <= n)
        overlap = max(round(OVERLAP_S / float(np.median(self.step_s))), 2)
        simulated: Array = np.zeros(n)
        starts = {*self._restarts.rows.tolist()}
        for begin, end in pairwise(edges):
            first = begin if begin in starts else max(begin - overlap, 0)
            # An equation looks at the motion on both sides.
            last = min(end + overlap, n) if self.is_equation else end
            piece = self._cut_piece(first, last, simulated)
            middle_s = 0.5 * float(t_s[begin] + t_s[end - 1])
            whole = piece._simulate_constant(p, middle_s)
            simulated[begin:end] = whole[begin - first : end - first]
        return simulated

    def _cut_drift(self) -> set[int]:
        """Return where pieces begin; windows that start anew need no overlap, so there are more."""
        n, starts = len(self.measured), self._restarts.rows
        if len(starts) > FEWEST_WINDOWS:
            return {*starts[:: -(-len(starts) // MOST_CUTS)].tolist()}
        return {int(c) for c in np.linspace(0, n, PIECES + 1)}

    def _cut_piece(self, first: int, last: int, simulated: Array) -> AlteredDrive:
        """Return the samples [first, last); it goes on from what was simulated before."""
        late_s, pressed_pa = self.acts_after_s, self.pressed_pa
        begins_s = float(self.times_s[first])
        piece = replace(
            self,
            step_s=_cut(self.step_s, first, max(last - 1, first)),
            valve_v=self.valve_v[first:last],
            driven=self.driven[first:last],
            measured=self.measured[first:last],
            pressed_pa=None if pressed_pa is None else pressed_pa[first:last],
            acts_after_s=None if late_s is None else _cut(late_s, first, last),
            held_v=float(self.valve_v[first - 1]) if first else self.held_v,
            bend=None if self.bend is None else (self.bend[0] - begins_s, self.bend[1]),
            usable=None,
            part=None,
            windows=(),
            start=float(simulated[first]) if first else self.start,
            is_remembered=False,  # the velocity at its start would have to be part of the key
        )
        piece.__dict__["_restarts"] = self._cut_restarts(first, last, simulated)
        return piece

    def _cut_restarts(self, first: int, last: int, simulated: Array) -> Restarts:
        """Return the restarts within a piece; its own start has a velocity too."""
        whole = self._restarts
        inside = slice(*np.searchsorted(whole.rows, (first, last)))
        rows, values, rates = whole.rows[inside] - first, whole.outputs[inside], whole.rates[inside]
        if first and not (len(rows) and rows[0] == 0):
            around = slice(first - 1, first + 2)  # a piece overlaps the one before
            rate = _find_slope(self.times_s[around], simulated[around])
            rows = np.concatenate([np.zeros(1, dtype=np.int64), rows])
            values, rates = np.append(simulated[first], values), np.append(rate, rates)
        return Restarts(rows, values, rates)


def _cut(column: Array, first: int, last: int) -> Array:
    """Return a part of a column: the same array each time."""
    key, made_from = (id(column), first, last), (column,)
    (part,) = _CUTS.recall(key, made_from, lambda: (column[first:last],))
    return part


def _find_slope(t_s: Array, values: Array) -> float:
    """Return the slope at the middle of three samples, of the parabola through them."""
    before_s, after_s = float(t_s[1] - t_s[0]), float(t_s[2] - t_s[1])
    before, after = (values[1] - values[0]) / before_s, (values[2] - values[1]) / after_s
    return float((before * after_s + after * before_s) / (before_s + after_s))


def interpolate_smoothly(at_s: Array, t_s: Array, values: Array) -> Array:
    """Return a signal between its samples, by cubics with the slopes of their neighbours.

    A line would cut the crests of an oscillation with few samples in a period. Outside the
    samples it is the first or the last one.
    """
    slopes = np.gradient(values, t_s)
    left = np.clip(np.searchsorted(t_s, at_s, "right") - 1, 0, len(t_s) - 2)
    right, length_s = left + 1, np.diff(t_s)[left]
    share = np.clip((at_s - t_s[left]) / length_s, 0.0, 1.0)
    rest = 1.0 - share
    ends = (1.0 + 2.0 * share) * rest**2 * values[left] + (3.0 - 2.0 * share) * share**2 * values[
        right
    ]
    bends = share * rest * length_s * (rest * slopes[left] - share * slopes[right])
    return np.asarray(ends + bends)


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
