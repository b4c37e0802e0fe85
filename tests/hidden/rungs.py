"""What a diagnosis says, and how far up a truth it reaches: place, kind, name.

Every examination states its truth as causes, and every core says what it found as `Said`; the mark
compares the two. A set-up finding is called `kind.number`, such as `skew.pressure_pa`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from typing import Literal

from hidden.examination.oracle import SURE, oracle_of

Rung = Literal["none", "set", "place", "kind", "name"]
RUNGS: tuple[Rung, ...] = ("none", "set", "place", "kind", "name")
"""`set`: one of several names at several places, of which one is true."""

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
    "friction curve": "braid_drag coulomb_friction friction_asymmetry position_friction "
                      "pressure_damping pressure_friction return_friction stribeck "
                      "viscous_asymmetry",
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


def find_twins(name: str, multiple: float, program: str, beside: float = 0.0) -> frozenset[str]:
    """Return the rivals that a program does not tell from an effect of this size.

    `beside` is what else is there, as a share of what the effect leaves: it may hide what tells a
    rival from it. Raises ValueError where the effect itself leaves less than can be seen.
    """
    rows = oracle_of(program).get(name)
    if not rows:
        return frozenset()
    sizes = sorted(map(float, rows))
    size = max((s for s in sizes if s <= multiple), default=sizes[0])
    row = {rival: left * min(multiple / size, 1.0) for rival, left in rows[f"{size:g}"].items()}
    alone = row.pop("alone")
    if alone < SURE:
        raise ValueError(f"nobody can see {name} at {multiple:g} with {program}")
    return frozenset(rival for rival, left in row.items() if left < max(beside * alone, SURE))


def carried_rung(name: str, multiple: float, program: str, beside: float = 0.0) -> Rung:
    """Return how far up the data carry an effect: to what it has in common with its twins."""
    try:
        twins = find_twins(name, multiple, program, beside)
    except ValueError:
        return "none"
    mine, places = where_of(name), {at for at, _ in where_of(name)}
    if not twins:
        return "name"
    if all(where_of(twin) & mine for twin in twins):
        return "kind"
    return "place" if all({at for at, _ in where_of(t)} & places for t in twins) else "set"


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
    noise: frozenset[str] = frozenset()
    """What is said of the columns' noise: `noise.hum`."""
    refusal: str = ""
    """Why the data are refused; empty: they are not."""
    admits: bool = False
    """It says that something is missing which it cannot name or place."""

    def words(self) -> str:
        """Return it in one line."""
        parts = [*sorted(self.names)]
        parts += [f"{{{' | '.join(sorted(group))}}}" for group in self.sets]
        parts += [f"<{' '.join(w).strip()}>" for w in sorted(self.places)]
        if self.refusal:
            return f"refused: {self.refusal}"
        return " ".join(parts) or ("something" if self.admits else "nothing")


def mark(
    causes: Collection[Cause], said: Said, ignored: Collection[str] = ()
) -> tuple[str, list[str]]:
    """Return the verdict of a case, and the false statements in it.

    right at NAME, KIND, PLACE or SET (the least of what had to be said); silent (nothing had to
    be said, and nothing was); low (a lower rung than the data carry); admitted (only that something
    is missing); missed; refused; wrong name; wrong place. `ignored` are neither asked nor false.
    """
    if said.refusal:
        return "refused", []
    names, true = said.names - frozenset(ignored), frozenset[str]()
    for cause in causes:
        true |= cause.names
    false = sorted(name for name in names if not _is_true(name, true, causes))
    if false:
        return "wrong name", false
    false = [" | ".join(sorted(g)) for g in said.sets if not g & true and not _is_near(g, causes)]
    false += [" ".join(w) for w in sorted(said.places) if not _is_at(w[0], causes)]
    if false:
        return "wrong place", false
    asked = [cause for cause in causes if cause.rung != "none"]
    reached = [_reached(cause, said) for cause in asked]
    if not asked:
        rungs = [_reached(c, said) for c in causes if _reached(c, said) != "none"]
        return (f"right at {max(rungs, key=RUNGS.index)}" if rungs else "silent"), []
    if any(r == "none" for r in reached):
        return ("admitted" if said.admits and not names else "missed"), []
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
    """Return how far up a cause was said; a set of which all are true is a name."""
    if (said.names | said.noise) & cause.names or any(g <= cause.names for g in said.sets):
        return "name"
    found = set(said.places).union(*(where_of(name) for name in said.names if "." in name))
    shared = [frozenset[Where].intersection(*map(where_of, g)) for g in said.sets]
    found = found.union(*shared)
    if found & cause.where:
        return "kind"
    places = {at for at, _ in cause.where}
    common = [set.intersection(*({at for at, _ in where_of(n)} for n in g)) for g in said.sets]
    if {at for at, _ in found}.union(*common) & places:
        return "place"
    return "set" if any(group & cause.names for group in said.sets) else "none"
