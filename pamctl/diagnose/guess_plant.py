"""First guesses of a plant's numbers from measured records, for `pamctl plant new --from`.

A guess is a regression without a simulation: the balance of forces for what moves, the balance of
air for the valve (Eq. 7 and 8). It need only be right within a factor of some three, since
`pamctl diagnose` fits it. A number that the records do not show keeps its usual value.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from pamctl.diagnose.evidence.measured_columns import SMOOTH_S, find_rates
from pamctl.diagnose.evidence.weigh import LOAD
from pamctl.diagnose.record import Record
from pamctl.plant.effects.description import ACTUATORS
from pamctl.plant.model import PlantSettings, values_of
from pamctl.plant.paper import (
    PaperParameters,
    braid_lever_m,
    force_area_m2,
    orifice_flow,
    volume_m3,
)
from pamctl.plant.parameters import ACTUATOR, parameters_of
from pamctl.plant.sample_grid import accumulate_times

Array = NDArray[np.float64]

ABOVE_HIGHEST = 1.02
"""A supply is above the highest pressure that it filled something to."""
OPEN_SHARE = 0.2
"""Samples with less flow, or speed, than this share of the largest say little."""
LEAST_SHARE = 0.01
"""A force that the balance does not show is guessed to be this share of all force."""
UNLIKE_SHARE = 0.5
"""Of the braid's friction: by so much a muscle differs from Eq. 5 before it is guessed."""
TOLD_SHARE = 0.15
"""From this on it is told, not guessed; where there is none, the balance finds up to 0.07."""
MOST_SAMPLES = 20_000
HARDLY_SEEN = f"hardly seen: {100 * LEAST_SHARE:g} % of the force"
DRY = "coulomb_friction.force_n"
BY_FORCES = "from the balance of forces over the motion"


class Guess(NamedTuple):
    """A number in SI, and where it is from."""

    value: float
    how: str
    is_bound: bool = False
    """The number may be smaller: the records hardly show it."""


class DrivenMotion(NamedTuple):
    """What the balance of forces needs of all records, each of shape (samples,)."""

    position_m: Array
    speed_m_per_s: Array
    acceleration_m_per_s2: Array
    drive_n: Array
    grip_n_per_m: Array
    """N A_b P_g of Eq. 5: the braid's damping for each 1/m of mu_k; without a braid 0."""
    friction_n_m: Array
    """The same with b theta cos(theta): its dry friction."""


def guess_numbers(
    records: Sequence[Record], actuator: str, values: Mapping[str, float]
) -> dict[str, Guess]:
    """Return what the records show of a plant's numbers, by name.

    `values` are the numbers as far as they are known (SI), such as the muscle's geometry, which
    turns a pressure into a force. Columns that no record has give no guess.
    """
    found: dict[str, Guess] = {}
    if actuator != "direct" and all(r.pressure_pa is not None for r in records):
        found |= _guess_air(records, actuator, values)
    if actuator != "chamber" and all(r.position_m is not None for r in records):
        found |= _guess_mechanics(records, actuator, values)
    return {
        name: guess._replace(value=float(f"{guess.value:.3g}")) for name, guess in found.items()
    }


FAR = 30.0
"""A stated number that is off by a larger factor is a slip; a guess may be three times off."""


def doubt_numbers(records: Sequence[Record], plant: PlantSettings) -> Iterator[str]:
    """Yield which numbers of a plant file are far from what the records show."""
    values = values_of(plant)
    for name, guess in guess_numbers(records, plant.actuator, values).items():
        stated, found = abs(values.get(name, 0.0)), abs(guess.value)
        if stated > FAR * found or (0.0 < stated < found / FAR and not guess.is_bound):
            yield (
                f"{name} is stated as {values[name]:.4g}, and the records look like "
                f"{guess.value:.3g}, {guess.how}: are the units right, of the number and of the "
                "columns?"
            )


def _guess_air(
    records: Sequence[Record], actuator: str, values: Mapping[str, float]
) -> dict[str, Guess]:
    """Return supply and valve gain from d(P V)/dt = R T K u Psi.

    The gain follows from the exhaust, whose other side is the atmosphere, if there is one; then
    the supply from what came in.
    """
    highest = max(float(np.nanquantile(np.asarray(r.pressure_pa), 0.999)) for r in records)
    tank = Guess(
        ABOVE_HIGHEST * highest, f"{ABOVE_HIGHEST:g} times the highest pressure in the records"
    )
    if any(r.valve_v is None for r in records):
        return {"tank_pressure_pa": tank}
    p = _paper_numbers(actuator, {**values, "tank_pressure_pa": tank.value})
    tables = [_tabulate_flow(record, p) for record in records]
    command, pressure, growth = (np.concatenate(rows) for rows in zip(*tables, strict=True))
    flow = _flow_per_gain(p, command, pressure)
    out = command < 0.0
    large = np.abs(flow) > OPEN_SHARE * np.nanmax(np.abs(flow))
    use = large & out if (large & out).sum() > OPEN_SHARE * large.sum() else large
    gain = float(np.nanmedian(growth[use] / flow[use])) if use.any() else 0.0
    if not gain > 0.0:
        return {"tank_pressure_pa": tank}
    into = large & ~out
    if (use & out).any() and into.any():
        came = growth[into] / (gain * command[into] * p.specific_energy_j_per_kg)
        needed = float(np.nanmedian(came)) / p.choked_flow_s_per_m
        if needed > tank.value:
            tank = Guess(needed, "from the pressure's rise, by the gain of the exhaust")
    gained = Guess(gain, "from the command and the change of the pressure")
    return {"tank_pressure_pa": tank, "valve_gain_m2_per_v": gained}


def _paper_numbers(actuator: str, values: Mapping[str, float]) -> PaperParameters:
    return parameters_of({**values, ACTUATOR: float(ACTUATORS.index(actuator))}).paper


def _tabulate_flow(record: Record, p: PaperParameters) -> tuple[Array, Array, Array]:
    """Return command (V), pressure (Pa) and d(P V)/dt (W), each of shape (samples,)."""
    command, pressure = np.asarray(record.valve_v), np.asarray(record.pressure_pa)
    position = np.zeros(len(command)) if record.position_m is None else record.position_m
    air = pressure * np.array([volume_m3(p, x) for x in np.asarray(position)])
    every = max(1, len(command) // MOST_SAMPLES)
    rows = (command, pressure, _differentiate(record, air)["speed"])
    good = np.all([np.isfinite(row) for row in rows], axis=0)
    command, pressure, growth = (row[good][::every] for row in rows)
    return command, pressure, growth


def _flow_per_gain(p: PaperParameters, command_v: Array, pressure_pa: Array) -> Array:
    """Return R T u Psi, the growth of P V per unit of the valve's gain, W/(m^2/V)."""
    flow = [
        u * orifice_flow(p, max(p.tank_pressure_pa, pressure), pressure)
        if u > 0.0
        else u * orifice_flow(p, pressure, min(p.atmospheric_pressure_pa, pressure))
        for u, pressure in zip(command_v, pressure_pa, strict=True)
    ]
    return p.specific_energy_j_per_kg * np.array(flow)


def _guess_mechanics(
    records: Sequence[Record], actuator: str, values: Mapping[str, float]
) -> dict[str, Guess]:
    """Return what the balance of forces shows: M a + c v + k x + F_c sign(v) + F_0 = drive.

    Of a muscle it has the braid's friction too: what Eq. 5 says while it contracts, and what other
    muscles have, friction while it lengthens and none that grows with speed.
    """
    motions = [m for record in records if (m := _find_motion(record, actuator, values)) is not None]
    if not motions:
        return {}
    motion = DrivenMotion(*(np.concatenate(rows) for rows in zip(*motions, strict=True)))
    speed = motion.speed_m_per_s
    moves = np.abs(speed) > OPEN_SHARE * np.quantile(np.abs(speed), 0.99)
    x, v, a, drive, grip, friction = (row[moves] for row in motion)
    up, ones = v > 0.0, np.ones(len(x))
    forces = {
        "mass_kg": a, "damping_n_s_per_m": v, "stiffness_n_per_m": x, DRY: np.sign(v),
        LOAD: ones, "lift": -ones, "kinetic_friction_per_m": np.where(up, friction, 0.0),
        "return": np.where(up, 0.0, -friction), "drag": np.where(up, grip * v, 0.0),
    }  # fmt: skip
    shown = {name: row for name, row in forces.items() if row.any()}
    scale = {name: float(np.sqrt(np.mean(row**2))) for name, row in shown.items()}
    table = np.column_stack([row / scale[name] for name, row in shown.items()])
    amounts = dict(zip(shown, nnls(table, drive)[0], strict=True))
    least = LEAST_SHARE * float(np.sqrt(np.mean(drive**2)))
    found = {}
    for name in ("mass_kg", "damping_n_s_per_m", "stiffness_n_per_m"):
        amount, how = float(amounts[name]), BY_FORCES
        if amount < least:
            if actuator == "muscle":
                continue
            how = HARDLY_SEEN
        if name == "stiffness_n_per_m" and actuator != "muscle":
            how += "; write 0 if there is no spring"
        found[name] = Guess(max(amount, least) / scale[name], how, amount < least)
    sizes = {name: amount / scale[name] for name, amount in amounts.items()}
    if amounts.get("kinetic_friction_per_m", 0.0) > least:
        found |= _guess_braid(sizes)
    elif "kinetic_friction_per_m" in amounts:
        small = least / scale["kinetic_friction_per_m"]
        found["kinetic_friction_per_m"] = Guess(small, HARDLY_SEEN, is_bound=True)
    for name in (LOAD, DRY) if actuator == "muscle" else ():
        if amounts[name] > least:
            found[name] = Guess(float(sizes[name]), BY_FORCES)
    return found


def _guess_braid(sizes: Mapping[str, float]) -> dict[str, Guess]:
    """Return mu_k, and what differs from Eq. 5 by more than half: no guess is better."""
    contracting, how = sizes["kinetic_friction_per_m"], BY_FORCES
    back, drag = sizes["return"] / contracting, sizes["drag"] / contracting - 1.0
    if TOLD_SHARE < back <= UNLIKE_SHARE:
        how += f"; about {back:.1f} of it acts while the muscle lengthens, too little to guess "
        how += "return_friction.share"
    found = {"kinetic_friction_per_m": Guess(float(contracting), how)}
    if back > UNLIKE_SHARE:
        found["return_friction.share"] = Guess(float(min(back, 1.0)), BY_FORCES)
    if drag < -UNLIKE_SHARE:
        found["braid_drag.share"] = Guess(float(drag), BY_FORCES)
    return found


def _find_motion(record: Record, actuator: str, values: Mapping[str, float]) -> DrivenMotion | None:
    rates = _differentiate(record, np.asarray(record.position_m))
    position_m = rates["smooth"]
    grip = friction = np.zeros(len(position_m))
    p = _paper_numbers(actuator, values)
    gauge = None if record.pressure_pa is None else record.pressure_pa - p.atmospheric_pressure_pa
    if actuator == "direct":
        area_m2 = values.get("piston.area_m2", 0.0)
        pushes = [] if gauge is None or not area_m2 else [area_m2 * gauge]
        pushes += [] if record.force_n is None else [record.force_n]
        if not pushes:
            return None
        drive = np.sum(pushes, axis=0)
    else:
        if gauge is None:
            return None
        drive = gauge * np.array([force_area_m2(p, x) for x in position_m])
        if actuator == "muscle":
            grip = values["braid_count"] * values["braid_contact_area_m2"] * gauge
            shortest_m = p.rest_length_m - p.braid_length_m
            reachable = np.maximum(position_m, shortest_m)
            friction = grip * np.array([braid_lever_m(p, x) for x in reachable])
    every = max(1, len(drive) // MOST_SAMPLES)
    rows = (position_m, rates["speed"], rates["push"], drive, grip, friction)
    good = np.all([np.isfinite(row) for row in rows], axis=0)
    return DrivenMotion(*(row[good][::every] for row in rows))


def _differentiate(record: Record, column: Array) -> dict[str, Array]:
    steps = np.diff(record.t_s)
    return find_rates(column, float(np.median(steps)), SMOOTH_S, accumulate_times(steps))
