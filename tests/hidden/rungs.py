"""What a diagnosis says, and how far up a truth it reaches: place, kind, name.

Every examination states its truth as causes, and every core says what it found as `Said`; the mark
compares the two. A set-up finding is called `kind.number`, such as `skew.pressure_pa`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from typing import Literal

from hidden.examination.oracle import SURE
from hidden.examination.scoring import oracle_of

Rung = Literal["none", "place", "kind", "name"]
RUNGS: tuple[Rung, ...] = ("none", "place", "kind", "name")

Where = tuple[str, str]
"""A place and a kind; an empty kind is not said."""

PLACES = frozenset({
    "valve", "supply", "chamber", "friction", "force", "pressure_sensor", "encoder",
})  # fmt: skip
"""From the command to the opening; what flows in; the air; what resists motion; what pulls and
what pulls back; what shows the pressure; what shows the displacement."""
KINDS = frozenset({"curve", "memory", "lag", "time"})
"""A static law of what drives it; one that remembers reversals; one that is late; one of time."""

_BY_PLACE = {
    "valve curve": "valve_deadband valve_asymmetry valve_saturation valve_curve valve_leak "
                   "null_offset discharge_ratio",
    "valve lag": "valve_spool valve_slew command_delay",
    "valve memory": "valve_hysteresis",
    "valve time": "drift",
    "chamber curve": "chamber_leak dead_volume polytropic discharge_ratio",
    "chamber lag": "line_restriction polytropic",
    "supply curve": "supply_droop",
    "supply lag": "supply_droop",
    "supply time": "supply_ripple",
    "friction curve": "coulomb_friction friction_asymmetry position_friction pressure_damping "
                      "pressure_friction return_friction stribeck viscous_asymmetry",
    "friction memory": "presliding spring_hysteresis coulomb_friction return_friction",
    "force curve": "bladder_threshold braid_stretch cubic_stiffness end_cap external_load "
                   "moving_mass piston",
    "force lag": "creep",
    "force memory": "creep spring_hysteresis presliding",
    "encoder curve": "encoder_scale",
    "encoder memory": "encoder_backlash",
    "pressure_sensor curve": "pressure_sensor_gain pressure_sensor_offset",
    "pressure_sensor lag": "pressure_sensor_lag",
}  # fmt: skip
NAMES: dict[str, frozenset[Where]] = {}
for _where, _names in _BY_PLACE.items():
    for _name in _names.split():
        _place, _kind = _where.split()
        NAMES[_name] = NAMES.get(_name, frozenset()) | {(_place, _kind)}

_OF_NUMBER = {
    "valve_v": "valve", "pressure_pa": "pressure_sensor", "position_m": "encoder",
    "valve_gain": "valve", "exhaust": "valve", "tank_pressure": "supply", "supply": "supply",
    "atmospheric": "chamber", "temperature": "chamber", "leak": "chamber", "volume": "chamber",
    "friction": "friction", "damping": "friction", "contact": "friction",
}  # fmt: skip
_OF_FINDING = {
    "skew": "lag", "clock_rate": "lag", "decimated_command": "lag", "filtered": "lag",
    "drift": "time", "change_at_instant": "time",
}  # fmt: skip


def where_of(name: str) -> frozenset[Where]:
    """Return the places and kinds of an effect, or of a set-up finding."""
    if name in NAMES:
        return NAMES[name]
    kind, _, number = name.partition(".")
    if number == "command":
        return frozenset({("valve", _OF_FINDING.get(kind, "curve"))})
    place = next((at for word, at in _OF_NUMBER.items() if word in number), "force")
    return frozenset({(place, _OF_FINDING.get(kind, "curve"))})


@dataclass(frozen=True)
class Cause:
    """One thing that is really there."""

    what: str
    where: frozenset[Where]
    rung: Rung
    """How far up the data carry; `none`: it need not be said, but it may."""
    names: frozenset[str] = frozenset()
    """Each of these is right; empty: nothing has a name for it."""


def named_cause(name: str, rung: Rung = "name", *equal: str) -> Cause:
    """Return the cause that an effect of the catalogue is."""
    return Cause(name, where_of(name), rung, frozenset({name, *equal}))


def carried_rung(name: str, multiple: float, program: str, beside: float = 0.0) -> Rung:
    """Return how far up the data carry an effect: from what a rival leaves of it (`oracle.json`).

    What is beside it, as a share of what it leaves itself, may hide what tells a rival from it.
    What such rivals have in common with it, kind or place, can still be said.
    """
    rows = oracle_of(program).get(name)
    if not rows:
        return "name"
    size = max(
        (float(s) for s in rows if float(s) <= multiple), default=float(min(rows, key=float))
    )
    row = {rival: left * multiple / size for rival, left in rows[f"{size:g}"].items()}
    alone = row.pop("alone")
    if alone < SURE:
        return "none"
    near = [rival for rival, left in row.items() if left < max(beside * alone, SURE)]
    mine, places = where_of(name), {at for at, _ in where_of(name)}
    if not near:
        return "name"
    if all(where_of(rival) & mine for rival in near):
        return "kind"
    return "place" if all({at for at, _ in where_of(r)} & places for r in near) else "none"


@dataclass(frozen=True)
class Said:
    """What a core says of a case."""

    names: frozenset[str] = frozenset()
    """Said as names."""
    sets: tuple[frozenset[str], ...] = ()
    """One of each is true, it says."""
    places: frozenset[Where] = frozenset()
    """Said without a name."""
    numbers: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    """Value, and its interval."""
    refusal: str = ""
    """Why the data are refused; empty: they are not."""
    seconds: float = 0.0

    def words(self) -> str:
        """Return it in one line."""
        parts = [*sorted(self.names)]
        parts += [f"{{{' | '.join(sorted(group))}}}" for group in self.sets]
        parts += [f"<{' '.join(w).strip()}>" for w in sorted(self.places)]
        return " ".join(parts) or (f"refused: {self.refusal}" if self.refusal else "nothing")


def mark(
    causes: Collection[Cause], said: Said, ignored: Collection[str] = ()
) -> tuple[str, list[str]]:
    """Return the verdict of a case, and the false statements in it.

    right at NAME, KIND or PLACE (the least of what had to be said), or silent where nothing had to
    be; low (said, but at a lower rung than the data carry); missed; refused; wrong name; wrong
    place. `ignored` are findings that are neither asked for nor false.
    """
    if said.refusal:
        return "refused", []
    names = said.names - frozenset(ignored)
    true = frozenset[str]().union(*(cause.names for cause in causes))
    false = sorted(name for name in names if not _is_true(name, true, causes))
    if false:
        return "wrong name", false
    astray = [group for group in said.sets if not group & true and not _is_near(group, causes)]
    false = [" | ".join(sorted(group)) for group in astray]
    false += [" ".join(w) for w in sorted(said.places) if not _is_at(w[0], causes)]
    if false:
        return "wrong place", false
    asked = [cause for cause in causes if cause.rung != "none"]
    if not asked:
        return ("right at " + ("name" if names else "place")) if said.words() != "nothing" and (
            names or said.sets or said.places) else "silent", []  # fmt: skip
    reached = [_reached(cause, said) for cause in asked]
    if any(r == "none" for r in reached):
        return "missed", []
    if any(RUNGS.index(r) < RUNGS.index(c.rung) for r, c in zip(reached, asked, strict=True)):
        return "low", []
    return f"right at {min(reached, key=RUNGS.index)}", []


def _is_true(name: str, true: frozenset[str], causes: Iterable[Cause]) -> bool:
    """Tell whether a name is one of the truths; a finding is true where its place and kind are."""
    if name in true:
        return True
    return "." in name and any(where_of(name) & cause.where for cause in causes)


def _is_at(place: str, causes: Iterable[Cause]) -> bool:
    return any(place == at for cause in causes for at, _ in cause.where)


def _is_near(group: frozenset[str], causes: Iterable[Cause]) -> bool:
    return any(_is_at(at, causes) for name in group for at, _ in where_of(name))


def _reached(cause: Cause, said: Said) -> Rung:
    """Return how far up a cause was said."""
    if said.names & cause.names:
        return "name"
    found = set(said.places).union(*(where_of(name) for name in said.names if "." in name))
    if found & cause.where or any(group & cause.names for group in said.sets):
        return "kind"
    found = found.union(*(where_of(name) for group in said.sets for name in group))
    return "place" if {at for at, _ in found} & {at for at, _ in cause.where} else "none"
