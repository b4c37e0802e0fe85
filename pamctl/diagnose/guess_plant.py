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

from pamctl.diagnose.evidence.measured_columns import SMOOTH_S, fill_gone, find_rates
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
LEAST_SHARE_SAID = 0.15
"""Of the braid's friction: by less than this no muscle is said to differ from Eq. 5."""
NEARLY = 1.3
"""A friction of one kind that leaves no more than so many times what a mixture leaves will do."""
NEAR = 2.0
"""Samples off by more than so many medians count less: a landing, a reversal, is smoothed over."""
TINY_N = 1e-9
CREEP_S = (0.15, 1.0, 6.0)
"""Time constants of a rubber's creep: it lags, and without it the balance takes it for friction."""
ROUNDS = 6
"""In which the pressure that the motion needs is found, and which samples count less."""
LEAST_AREA_SHARE = 0.05
"""Where a muscle pulls less, near its shortest length, no pressure follows from its force."""
MOST_SAMPLES = 20_000
HARDLY_SEEN = f"hardly seen: {100 * LEAST_SHARE:g} % of the force"
DRY = "coulomb_friction.force_n"
ONE_WAY, BOTH_WAYS, BACK, DRAG = "one way", "both ways", "back", "drag"
FRICTIONS = ((BOTH_WAYS,), (ONE_WAY,), (DRY,))
"""A muscle's friction of one kind: dry both ways, as in Eq. 5, or off the braid."""
MIXTURES = ((BOTH_WAYS, DRY), (ONE_WAY, DRY), (ONE_WAY, BACK, DRAG, DRY))
"""With BACK and DRAG apart, ONE_WAY is the dry part of Eq. 5 alone."""
BY_FORCES = "from the balance of forces over the motion"


class Guess(NamedTuple):
    """A number in SI, and where it is from."""

    value: float
    how: str
    is_bound: bool = False
    """The number may be smaller: the records hardly show it."""


class DrivenMotion(NamedTuple):
    """What the balance of forces needs of all records, of shape (samples,) if not said."""

    position_m: Array
    speed_m_per_s: Array
    acceleration_m_per_s2: Array
    drive_n: Array
    grip_per_m: Array
    """N A_b P_g of Eq. 5 over the drive, 1/m: of the braid's damping; without a braid 0."""
    friction_m: Array
    """The same with b theta cos(theta), m: of its dry friction."""
    creep_m: Array
    """How far a muscle is ahead of what follows it in CREEP_S, of shape (samples, times)."""


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

    Of a muscle it has the rubber's creep and the braid's friction too.
    """
    motions = [m for record in records if (m := _find_motion(record, actuator, values)) is not None]
    if not motions:
        return {}
    motion = DrivenMotion(*(np.concatenate(rows) for rows in zip(*motions, strict=True)))
    speed = np.abs(motion.speed_m_per_s)
    if not speed.any():
        return {}
    moves = speed > OPEN_SHARE * np.quantile(speed, 0.99)
    motion = DrivenMotion(*(row[moves] for row in motion))
    scale, sizes, _ = _choose_balance(motion) if actuator == "muscle" else _balance(motion, (DRY,))
    least = LEAST_SHARE * float(np.sqrt(np.mean(motion.drive_n**2)))
    found = {}
    for name in ("mass_kg", "damping_n_s_per_m", "stiffness_n_per_m"):
        amount, how = sizes[name] * scale[name], BY_FORCES
        if amount < least:
            if actuator == "muscle":
                continue
            how = HARDLY_SEEN
        if name == "stiffness_n_per_m" and actuator != "muscle":
            how += "; write 0 if there is no spring"
        found[name] = Guess(max(amount, least) / scale[name], how, amount < least)
    if actuator == "muscle":
        found |= _guess_braid(sizes, least / scale[BOTH_WAYS])
        for name in (LOAD, DRY):
            if sizes.get(name, 0.0) > least:
                found[name] = Guess(sizes[name], BY_FORCES)
    return found


class Balance(NamedTuple):
    """A balance of forces: by name each term's RMS per unit, N, and its size; the rest's mean."""

    scale: dict[str, float]
    sizes: dict[str, float]
    left_n: float


def _choose_balance(motion: DrivenMotion) -> Balance:
    """Return a balance with the best friction of one kind, or a mixture that leaves far less."""
    simple = min((_balance(motion, kind) for kind in FRICTIONS), key=lambda b: b.left_n)
    found = [simple, *(_balance(motion, mixture) for mixture in MIXTURES)]
    most_n = NEARLY * min(balance.left_n for balance in found)
    return next(balance for balance in found if balance.left_n <= most_n)


def _balance(motion: DrivenMotion, friction: Sequence[str]) -> Balance:
    """Balance the forces with a friction.

    The braid's friction follows from the pressure that the motion needs. The measured one has in
    it all that the balance lacks: by it, friction would explain a part of that.
    """
    x, v, a, drive, grip_per_m, friction_m, creep_m = motion
    contracts, needed, weight, ones = v > 0.0, drive, np.ones(len(x)), np.ones(len(x))
    for _ in range(ROUNDS):
        rub = needed * friction_m
        drag = np.where(contracts, needed * grip_per_m * v, 0.0)
        pull = np.where(contracts, rub, 0.0)
        terms = {
            "mass_kg": a, "damping_n_s_per_m": v, "stiffness_n_per_m": x, LOAD: ones,
            "lift": -ones, **{f"creep {n}": row for n, row in enumerate(creep_m.T)},
            DRY: np.sign(v), BOTH_WAYS: 2.0 * pull - rub, BACK: pull - rub, DRAG: drag,
            ONE_WAY: pull if DRAG in friction else pull + drag,
        }  # fmt: skip
        scale = {name: float(np.sqrt(np.mean(row**2))) or 1.0 for name, row in terms.items()}
        absent = {DRY, BOTH_WAYS, ONE_WAY, BACK, DRAG} - {*friction}
        names = [name for name in terms if name not in absent]
        table = np.column_stack([terms[name] / scale[name] for name in names])
        amounts, _ = nnls(table * weight[:, None], drive * weight)
        needed = np.maximum(table @ amounts, 0.0)
        rest = np.abs(drive - table @ amounts)
        near = NEAR * float(np.median(rest)) + TINY_N
        weight = np.sqrt(near / np.maximum(rest, near))
    sizes = {name: float(amount) / scale[name] for name, amount in zip(names, amounts, strict=True)}
    return Balance(scale, sizes, float(np.mean(rest)))


def _guess_braid(sizes: Mapping[str, float], least_per_m: float) -> dict[str, Guess]:
    """Return mu_k, and by what the braid differs from Eq. 5."""
    mu_k = sizes.get(BOTH_WAYS, 0.0) + sizes.get(ONE_WAY, 0.0)
    if mu_k < least_per_m:
        return {"kinetic_friction_per_m": Guess(least_per_m, HARDLY_SEEN, is_bound=True)}
    back, drag = (1.0, -1.0) if BOTH_WAYS in sizes else (0.0, 0.0)
    if DRAG in sizes:
        back, drag = min(sizes[BACK] / mu_k, 1.0), sizes[DRAG] / mu_k - 1.0
    found = {"kinetic_friction_per_m": Guess(mu_k, BY_FORCES)}
    if back > LEAST_SHARE_SAID:
        found["return_friction.share"] = Guess(back, BY_FORCES)
    if drag < -LEAST_SHARE_SAID:
        found["braid_drag.share"] = Guess(drag, BY_FORCES)
    return found


def _find_motion(record: Record, actuator: str, values: Mapping[str, float]) -> DrivenMotion | None:
    rates = _differentiate(record, np.asarray(record.position_m))
    position_m = rates["smooth"]
    grip = friction = np.zeros_like(position_m)
    creep = np.zeros((len(position_m), len(CREEP_S)))
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
        areas_m2 = np.array([force_area_m2(p, x) for x in position_m])
        drive = gauge * areas_m2
        if actuator == "muscle":
            grip = values["braid_count"] * values["braid_contact_area_m2"] / areas_m2
            grip[areas_m2 < LEAST_AREA_SHARE * np.nanmax(areas_m2)] = 0.0
            shortest_m = p.rest_length_m - p.braid_length_m
            reachable = np.maximum(position_m, shortest_m)
            friction = grip * np.array([braid_lever_m(p, x) for x in reachable])
            creep = np.column_stack([_lag(record, position_m, tau_s) for tau_s in CREEP_S])
    every = max(1, len(drive) // MOST_SAMPLES)
    rows = (position_m, rates["speed"], rates["push"], drive, grip, friction)
    good = np.all([np.isfinite(row) for row in rows], axis=0)
    first_s, last_s = record.t_s[0] + 0.5 * SMOOTH_S, record.t_s[-1] - 0.5 * SMOOTH_S
    good &= (first_s < record.t_s) & (record.t_s < last_s)  # at the ends less is smoothed
    return DrivenMotion(*(row[good][::every] for row in (*rows, creep)))


def _lag(record: Record, position_m: Array, tau_s: float) -> Array:
    """Return how far the position is ahead of one that follows it in `tau_s`."""
    from scipy.signal import lfilter  # a second to import

    x = fill_gone(position_m, ~np.isfinite(position_m))
    kept = float(np.exp(-np.median(np.diff(record.t_s)) / tau_s))
    follows, _ = lfilter([1.0 - kept], [1.0, -kept], x, zi=[kept * x[0]])
    return np.asarray(x - follows)


def _differentiate(record: Record, column: Array) -> dict[str, Array]:
    steps = np.diff(record.t_s)
    return find_rates(column, float(np.median(steps)), SMOOTH_S, accumulate_times(steps))
