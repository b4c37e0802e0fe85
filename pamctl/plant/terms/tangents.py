"""The air's answer to a small push at one location, step by step along a drive.

Between two samples the pressure P answers a push b and its own deviation in proportion:

    dP[k + 1] = kept[k] dP[k] + push[k]

Both factors come from the plant's own drive, which is put back on its course at every other sample:
once with the pressure moved, once with a term of constant size. The answer to any driver is then a
filter, a hundred times as cheap as another drive. The mechanics have no such answer: while the
muscle sticks, a small push moves nothing, and a large one does.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pamctl.kernel.calls import machine
from pamctl.plant.drive import Restarts, SampleGrid, drive_pressure, undo_sensor
from pamctl.plant.parameters import PlantParameters, rest_state
from pamctl.plant.terms.operators import PlantTerm, TermMemory, Terms, follow_value, shape_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

MOVED_PA = 50.0
"""By how much the pressure is moved to see what is kept of it."""


@dataclass(frozen=True, eq=False)
class PressureTangent:
    """The pressure block along a drive; arrays as for `drive_pressure`."""

    p: PlantParameters
    command_v: Array
    position_m: Array
    grid: SampleGrid
    start_pa: float
    """Absolute pressure at the start, at which everything has settled."""

    @cached_property
    def kept(self) -> Array:
        """What is kept of a moved pressure from each sample to the next, shape (n - 1,)."""
        moved = self._step_from(self._plain, self._course_pa + MOVED_PA)
        return (moved - self._course_pa[1:]) / MOVED_PA

    def find_push(self, terms: Terms) -> Array:
        """Return what a term of constant size pushes between samples (Pa), shape (n - 1,)."""
        own = self._plain.terms or Terms()
        merged = [new if new.size else old for new, old in zip(terms, own, strict=True)]
        pushed = self._plain._replace(terms=Terms(*merged))
        return self._step_from(pushed, self._course_pa) - self._course_pa[1:]

    @cached_property
    def _plain(self) -> PlantParameters:
        """The plant on the branches of one with terms, and behind ideal sensors."""
        return self.p._replace(
            valve_acts=True, air_acts=True, sensors_act=False, terms=self.p.terms or Terms()
        )

    @cached_property
    def _true_m(self) -> Array:
        return undo_sensor("position_reading", self.p, self.position_m, self.grid.samples_s)

    @cached_property
    def _course_pa(self) -> Array:
        return self._drive(self._plain, np.zeros(0, dtype=np.int64), np.zeros(0))

    def _step_from(self, p: PlantParameters, begins_pa: Array) -> Array:
        """Return the pressure one sample after each of these."""
        ends_pa = np.empty(len(begins_pa) - 1)
        for first in (0, 1):
            rows = np.arange(first, len(begins_pa), 2)
            ends_pa[first::2] = self._drive(p, rows, begins_pa[rows])[first + 1 :: 2]
        return ends_pa

    def _drive(self, p: PlantParameters, rows: NDArray[np.int64], begins_pa: Array) -> Array:
        start = rest_state(p, float(self._true_m[0]), self.start_pa)
        again = Restarts(rows, begins_pa, np.zeros(len(rows)))
        return drive_pressure(
            p, self.command_v, self._true_m, self.grid, start=start, restarts=again
        ).true_pressure_pa


def trace_shape(term: PlantTerm, driver: Array, step_s: Array) -> Array:
    """Return a term's shape along a driver, without its size, shape (n,)."""
    shape = np.empty(len(driver))
    machine(fill_shape)(term, np.ascontiguousarray(driver), step_s, shape)
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
    machine(fill_answers)(kept, push, shapes, answers)
    return answers


def fill_answers(kept: Array, push: Array, shapes: Array, answers: Array) -> None:
    """Kernel of `answer_pushes`."""
    for i in range(len(shapes)):
        answer = 0.0
        for k in range(len(kept)):
            answer = kept[k] * answer + push[k] * 0.5 * (shapes[i, k] + shapes[i, k + 1])
            answers[i, k + 1] = answer
