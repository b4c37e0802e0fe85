"""The air's answer to a small push at one location, step by step along a drive.

Between two samples the pressure P answers a push b and its own deviation in proportion:

    dP[k + 1] = kept[k] dP[k] + push[k]

Both factors come from the plant's own steps, each started from the drive's state: one step with the
pressure moved, one with a term of constant size. The answer to any driver is then a filter, a
hundred times as cheap as another drive. The mechanics have no such answer: while the muscle sticks,
a small push moves nothing, and a large one does.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from pamctl.compiled import compile_kernel
from pamctl.plant.drive import DriveSteps, SampleGrid, build_steps, undo_sensor
from pamctl.plant.parameters import PlantParameters, PlantState, rest_state
from pamctl.plant.step import pressure_block_step
from pamctl.plant.terms.operators import PlantTerm, TermMemory, Terms, follow_value, shape_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

MOVED_PA = 50.0
"""By how much the output is moved to see what is kept of it."""


def find_pressure_tangent(
    p: PlantParameters,
    terms: Terms,
    command_v: Array,
    position_m: Array,
    grid: SampleGrid,
    start: PlantState | None = None,
) -> tuple[Array, Array]:
    """Return what is kept and pushed (Pa) between samples, each of shape (n - 1,).

    `terms` holds the push: a term of constant size. Other arguments as for `drive_pressure`.
    """
    true_m = undo_sensor("position_reading", p, position_m, grid.samples_s)
    plain, pushed = _pair(p, terms)
    if start is None:
        start = rest_state(plain, float(true_m[0]), p.paper.atmospheric_pressure_pa)
    else:
        start = rest_state(plain, start.position_m, start.pressure_pa)
    cut = build_steps(plain, command_v, grid)
    ends_m = np.interp(cut.ends_s, grid.samples_s, true_m)
    rows = np.zeros((2, len(command_v) - 1))
    _get_twin(run_pressure_tangent)(plain, pushed, start, cut, ends_m, rows)
    return rows[0], rows[1]


def _pair(p: PlantParameters, terms: Terms) -> tuple[PlantParameters, PlantParameters]:
    """Return the plant without and with the push, both on the same branches."""
    own = Terms() if p.terms is None else p.terms
    merged = [new if new.size else old for new, old in zip(terms, own, strict=True)]
    general = p._replace(valve_acts=True, air_acts=True, mechanics_act=True, terms=own)
    return general, general._replace(terms=Terms(*merged))


def run_pressure_tangent(
    p: PlantParameters,
    pushed: PlantParameters,
    state: PlantState,
    steps: DriveSteps,
    positions_m: Array,
    rows: Array,
) -> None:
    """Kernel of `find_pressure_tangent`."""
    here_pa, valve, air, age_s = state.pressure_pa, state.valve, state.air, state.age_s
    for k in range(rows.shape[1]):
        moved_pa, push_pa = here_pa + MOVED_PA, here_pa
        moved_valve, moved_air, push_valve, push_air = valve, air, valve, air
        for j in range(steps.first[k], steps.first[k + 1]):
            x, end_m, h = positions_m[j], positions_m[j + 1], steps.step_s[j]
            middle_m, volts = 0.5 * (x + end_m), steps.command_v[j]
            here_pa, valve, air = pressure_block_step(
                p, here_pa, valve, air, volts, x, middle_m, end_m, age_s, h
            )
            moved_pa, moved_valve, moved_air = pressure_block_step(
                p, moved_pa, moved_valve, moved_air, volts, x, middle_m, end_m, age_s, h
            )
            push_pa, push_valve, push_air = pressure_block_step(
                pushed, push_pa, push_valve, push_air, volts, x, middle_m, end_m, age_s, h
            )
            age_s += h
        rows[0, k] = (moved_pa - here_pa) / MOVED_PA
        rows[1, k] = push_pa - here_pa


def trace_shape(term: PlantTerm, driver: Array, step_s: Array) -> Array:
    """Return a term's shape along a driver, without its size, shape (n,)."""
    shape = np.empty(len(driver))
    _get_twin(fill_shape)(term, np.ascontiguousarray(driver), step_s, shape)
    return shape


def fill_shape(term: PlantTerm, driver: Array, step_s: Array, shape: Array) -> None:
    """Kernel of `trace_shape`."""
    memory = TermMemory(0.0, 0.0)
    for k in range(len(driver)):
        begin = driver[k - 1] if k else driver[0]
        memory = follow_value(term, memory, begin, driver[k], step_s[max(k - 1, 0)])
        shape[k] = shape_of(term, driver[k], memory)


def answer_pushes(kept: Array, push: Array, shapes: Array) -> Array:
    """Return the output's answer to pushes that follow these shapes, both of shape (m, n)."""
    answers = np.zeros_like(shapes)
    _get_twin(fill_answers)(kept, push, shapes, answers)
    return answers


def fill_answers(kept: Array, push: Array, shapes: Array, answers: Array) -> None:
    """Kernel of `answer_pushes`."""
    for i in range(len(shapes)):
        answer = 0.0
        for k in range(len(kept)):
            answer = kept[k] * answer + push[k] * 0.5 * (shapes[i, k] + shapes[i, k + 1])
            answers[i, k + 1] = answer


@cache
def _get_twin(kernel: Callable[..., None]) -> Callable[..., None]:
    return compile_kernel(kernel)
