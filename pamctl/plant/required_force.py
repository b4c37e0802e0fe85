"""The force that a mechanism needs for a given motion: Eq. 6 read the other way.

Where a stiff drive imposes the motion, the force is the answer and the motion is the input. A
simulation of the motion would integrate the noise of the force; this only balances it.
"""

from __future__ import annotations

from functools import cache
from math import exp, isinf
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pamctl.compiled import compile_kernel
from pamctl.plant.chains import depends_on_speed
from pamctl.plant.correction_tables import interpolate_table
from pamctl.plant.effects.mechanics.presliding import ELASTO_PLASTIC, Presliding
from pamctl.plant.mechanism import follow_motion, mechanism_forces
from pamctl.plant.parameters import MechanicsState, MechanismParameters, PlantParameters, rest_state

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Array = NDArray[np.float64]


class Motion(NamedTuple):
    """A measured motion, one value a sample; all arrays have shape (n,)."""

    position_m: Array
    velocity_m_per_s: Array
    acceleration_m_per_s2: Array
    step_s: Array
    """Time from the sample before; the first is not used."""
    resting_m_per_s: float
    """At a slower speed the direction of the motion is unknown, and dry friction takes any value
    in its band."""


class RequiredForce(NamedTuple):
    """The force on a direct actuator (N), shape (n,): between both at rest, equal in motion."""

    lower_n: Array
    upper_n: Array


def find_required_force(p: PlantParameters, motion: Motion, load_n: Array) -> RequiredForce:
    """Return the force that a direct mechanism needs for a motion: M a + friction + springs.

    `load_n` is the measured force; only a correction table looks it up. Effects with a memory
    follow the measured motion from a rest at its first position.
    """
    state = rest_state(p, float(motion.position_m[0]), p.paper.atmospheric_pressure_pa)
    rows = np.empty((len(RequiredForce._fields), len(load_n)))
    _get_twin(run_required_force)(p, state.mechanics, motion, load_n, rows)
    return RequiredForce(*rows)


def run_required_force(
    p: PlantParameters, state: MechanicsState, motion: Motion, load_n: Array, rows: Array
) -> None:
    """Kernel of `find_required_force`."""
    memory, bristle_n, age_s = state.memory, state.bristle_n, 0.0
    e = p.effects.mechanics
    for k in range(rows.shape[1]):
        x, v = motion.position_m[k], motion.velocity_m_per_s[k]
        way_m = 0.0
        if k:
            begin_m, step_s = motion.position_m[k - 1], motion.step_s[k]
            memory = follow_motion(e, memory, begin_m, x, 0.0, step_s)
            age_s += step_s
            way_m = x - begin_m
        extra_n = interpolate_table(p.correction.pull, x, load_n[k])
        with_effects = MechanismParameters(p.paper, e, p.direct, extra_n)
        forces = mechanism_forces(with_effects, memory, x, 0.0, v, age_s)
        lower_n, upper_n = forces.lower_n, forces.upper_n
        if abs(v) <= motion.resting_m_per_s and depends_on_speed(e):
            lower_n, upper_n = forces.rest_lower_n, forces.rest_upper_n
        damping = forces.damping_up_n_s_per_m if v > 0.0 else forces.damping_down_n_s_per_m
        if e.presliding.compliance_m_per_n > 0.0 and upper_n > lower_n:
            bristle_n = bend_bristle_n(e.presliding, bristle_n, way_m, lower_n, upper_n)
            lower_n = upper_n = bristle_n
        elif v > motion.resting_m_per_s:
            lower_n = upper_n
        elif v < -motion.resting_m_per_s:
            upper_n = lower_n
        need_n = p.paper.mass_kg * motion.acceleration_m_per_s2[k] + damping * v - forces.drive_n
        rows[0, k] = need_n + lower_n
        rows[1, k] = need_n + upper_n


def bend_bristle_n(
    presliding: Presliding, bristle_n: float, way_m: float, lower_n: float, upper_n: float
) -> float:
    """Return a bristle's force after a distance; an unloaded one (infinite) starts from zero."""
    held = min(max(0.0 if isinf(bristle_n) else bristle_n, lower_n), upper_n)
    left_n = upper_n - held if way_m > 0.0 else held - lower_n
    spring_n = abs(way_m) / presliding.compliance_m_per_n
    if presliding.form == ELASTO_PLASTIC:
        gained_n = min(spring_n, left_n)
    else:
        gained_n = left_n * (1.0 - exp(-spring_n / (upper_n - lower_n)))
    return held + gained_n if way_m > 0.0 else held - gained_n


@cache
def _get_twin(kernel: Callable[..., None]) -> Callable[..., None]:
    return compile_kernel(kernel)
