"""The force that a mechanism needs for a given motion: its equation, read from right to left.

    F = M x'' + k x + load + c x' + friction - A (P - P_atm)

Where something else moves the axis, the motion is no evidence, and the force is: what a load cell
measures minus this force is the residual of the equation. The kernels are those of the simulation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pamctl.kernel.calls import machine
from pamctl.plant.bristles import Bristles, add_up_n, advance_bristles, bristle_damping
from pamctl.plant.drive import undo_sensor
from pamctl.plant.mechanism import follow_motion, mechanism_forces
from pamctl.plant.parameters import PlantParameters, rest_state
from pamctl.plant.terms import follow_motion_term

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from pamctl.plant.paper import AxialForces
    from pamctl.plant.parameters import MechanicsState

    Array = NDArray[np.float64]


def required_force_n(
    p: PlantParameters,
    t_s: ArrayLike,
    position_m: ArrayLike,
    velocity_m_per_s: ArrayLike,
    acceleration_m_per_s2: ArrayLike,
    pressure_pa: ArrayLike | None = None,
    *,
    rest_speed_m_per_s: float = 0.0,
) -> Array:
    """Return the external force (N) that this motion and pressure need, shape (n,).

    All arguments have one value a sample, in SI. The motion is the true one, smoothed: a play of
    the encoder is not undone. `pressure_pa` is the absolute reading of the pressure sensor;
    without it no piston acts. For a muscle it is the force beside the muscle's own pull. At rest
    friction may be anything within its band: its middle is taken, and below `rest_speed_m_per_s`
    (the noise of the velocity, say) friction goes linearly from there to that of motion.
    Memories (creep, bristles) start at rest at the first sample; where the record has a gap, call
    once for each stretch. Raises ValueError for columns of different lengths or with NaN.
    """
    given = {
        "t_s": t_s,
        "position_m": position_m,
        "velocity_m_per_s": velocity_m_per_s,
        "acceleration_m_per_s2": acceleration_m_per_s2,
    }
    times, *motion = (np.ascontiguousarray(values, dtype=np.float64) for values in given.values())
    if pressure_pa is None:
        pressures = np.full(len(times), p.paper.atmospheric_pressure_pa)
    else:
        pressures = np.ascontiguousarray(pressure_pa, dtype=np.float64)
    named = dict(zip((*given, "pressure_pa"), (times, *motion, pressures), strict=True))
    for name, values in named.items():
        if values.shape != (len(times),) or not len(values):
            raise ValueError(f"{name}: shape {values.shape}, where t_s has {len(times)}")
        if not np.isfinite(values).all():
            raise ValueError(f"{name}: sample {int(np.argmin(np.isfinite(values)))} is no number")
    if pressure_pa is not None:
        pressures = undo_sensor("pressure_reading", p, pressures, times - times[0])
    columns = np.ascontiguousarray([times, *motion, pressures])
    start = rest_state(p, float(columns[1, 0]), float(columns[4, 0])).mechanics
    needed_n = np.empty(len(times))
    machine(fill_required_force)(p, start, columns, rest_speed_m_per_s, needed_n)
    return needed_n


def fill_required_force(
    p: PlantParameters,
    mechanics: MechanicsState,
    columns: Array,
    rest_speed_m_per_s: float,
    needed_n: Array,
) -> None:
    """Kernel of `required_force_n`; `columns` holds t, x, v, a and the absolute pressure."""
    bristles, memory, term = mechanics.bristles, mechanics.memory, mechanics.term
    begin_m, begin_s = columns[1, 0], columns[0, 0]
    for k in range(len(needed_n)):
        now_s, x, v, push = columns[0, k], columns[1, k], columns[2, k], columns[3, k]
        pressure_pa = columns[4, k]
        gauge_pa = pressure_pa - p.paper.atmospheric_pressure_pa
        if k:
            memory = follow_motion(
                p.effects.mechanics, memory, begin_m, x, gauge_pa, now_s - begin_s
            )
            term = follow_motion_term(p.terms, term, begin_m, x, gauge_pa, now_s - begin_s)
        forces = mechanism_forces(p, memory, term, x, gauge_pa, 0.0, v, now_s - columns[0, 0])
        bristles, held_n = friction_force(p, forces, bristles, x - begin_m, v, rest_speed_m_per_s)
        needed_n[k] = p.paper.mass_kg * push - forces.drive_n + held_n
        begin_m, begin_s = x, now_s


def friction_force(
    p: PlantParameters,
    forces: AxialForces,
    bristles: Bristles,
    way_m: float,
    velocity_m_per_s: float,
    rest_speed_m_per_s: float,
) -> tuple[Bristles, float]:
    """Return the bristles' forces (N) after a way, and all friction that opposes the motion."""
    v, presliding = velocity_m_per_s, p.effects.mechanics.presliding
    damping = forces.damping_up_n_s_per_m if v > 0.0 else forces.damping_down_n_s_per_m
    width_n = forces.upper_n - forces.lower_n
    if presliding.compliance_m_per_n <= 0.0 or width_n <= 0.0:
        half_n, middle_n = 0.5 * width_n, 0.5 * (forces.upper_n + forces.lower_n)
        share = 0.0 if v == 0.0 else 1.0 if v > 0.0 else -1.0
        if abs(v) < rest_speed_m_per_s:
            share = v / rest_speed_m_per_s
        return bristles, middle_n + share * half_n + damping * v
    bristles = advance_bristles(presliding, bristles, forces.lower_n, forces.upper_n, way_m)
    bristle_n = add_up_n(bristles)
    left_n = forces.upper_n - bristle_n if v > 0.0 else bristle_n - forces.lower_n
    damping += bristle_damping(presliding, left_n, width_n)
    return bristles, bristle_n + damping * v
