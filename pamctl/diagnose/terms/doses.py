"""What a term adds to a block's output: by tangents where they hold, else by the plant itself.

Tangents serve where the air is pushed in proportion, on records that run freely from a known start.
All other doses are driven through the plant at a size that is seen: a command that is late or cut
acts at its full size, a volume stores what it has, and what sticks does not feel a small force.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import numpy as np

from pamctl.diagnose.fitting.block_fit import Fit, find_secants
from pamctl.diagnose.fitting.drives import PRESSURE, Drive
from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.terms.grammar import Question
from pamctl.plant.model import plant_parameters
from pamctl.plant.parameters import PlantParameters
from pamctl.plant.terms.locations import LOCATIONS
from pamctl.plant.terms.operators import DRIVERS, OPERATORS, PlantTerm, Terms
from pamctl.plant.terms.tangents import (
    PressureTangent,
    answer_pushes,
    trace_shape,
)

BY_TANGENT = frozenset({"filling", "exhausting", "opening", "supply", "flow"})


class Doses:
    """Doses of terms on the drives of one block's fit."""

    def __init__(self, fitted: Fit) -> None:
        self.fitted = fitted
        self.p: PlantParameters = plant_parameters(fitted.settings)
        self.has_tangents = all(map(_runs_freely, fitted.drives))
        self._pushes: dict[tuple[str, int], Array] = {}
        self._drivers: dict[tuple[str, int], Array] = {}

    def is_linear(self, question: Question) -> bool:
        """Tell whether tangents give the question's doses."""
        return self.has_tangents and question.location.name in BY_TANGENT

    def simulate(self, question: Question, size: float) -> Array:
        """Return what each shape adds per size, by driving the plant, shape (n, p)."""
        doses = [*build_doses(question, size)]
        columns: Array = np.nan_to_num(find_secants(self.fitted, doses) / size)
        return columns

    def answer(self, question: Question, size: float) -> Array:
        """Return what each shape adds per size, shape (n, p)."""
        if not self.is_linear(question):
            return self.simulate(question, size)
        parts = []
        for index, drive in enumerate(self.fitted.drives):
            tangent, push = self._tangents[index], self._find_push(question, index, size)
            shapes = [self._trace(question, shape, index) for shape in question.list_shapes()]
            answers = answer_pushes(tangent.kept, push, np.array(shapes))
            rows = answers if drive.rows is None else answers[:, drive.rows]
            parts.append(rows / drive.deviation)
        return np.concatenate(parts, axis=1).T

    @cached_property
    def _tangents(self) -> list[PressureTangent]:
        return [
            PressureTangent(self.p, d.valve_v, d.driven, d.grid, d.start)
            for d in self.fitted.drives
        ]

    def _find_push(self, question: Question, index: int, size: float) -> Array:
        """Return what is pushed per size; `size` is that of the push that shows it."""
        key = question.location.name, index
        if key not in self._pushes:
            push = self._tangents[index].find_push(_push(question, size))
            self._pushes[key] = push / size
        return self._pushes[key]

    def _trace(self, question: Question, shape: Mapping[str, float], index: int) -> Array:
        drive = self.fitted.drives[index]
        driver = self._find_driver(question.driver, index)
        if (
            question.location.name in ("filling", "exhausting", "opening")
            and question.driver == "command"
        ):
            driver = np.abs(driver)
        return trace_shape(_make_term(question, shape, 1.0), driver, drive.step_s)

    def _find_driver(self, name: str, index: int) -> Array:
        key = name, index
        if key not in self._drivers:
            drive = self.fitted.drives[index]
            if name == "time":
                values = drive.grid.samples_s
            elif name == "command":
                values = drive.valve_v
            elif name == "pressure":
                values = drive.measured - self.p.atmospheric_pressure_pa
            else:
                values = drive.driven
            self._drivers[key] = values
        return self._drivers[key]


def _runs_freely(drive: Drive) -> bool:
    return (
        drive.block == PRESSURE
        and drive.has_position
        and not drive.is_equation
        and not drive.windows
    )


def build_doses(question: Question, size: float) -> list[dict[str, float]]:
    """Return the values of each of the question's shapes at a size, by full name."""
    doses = []
    for shape in question.list_shapes():
        named = {question.prefix + name: value for name, value in shape.items()}
        doses.append(question.fix() | named | {question.prefix + "size": size})
    return doses


def _make_term(question: Question, shape: Mapping[str, float], size: float) -> PlantTerm:
    return PlantTerm(
        size=size,
        location=float([*LOCATIONS].index(question.location.name)),
        operator=float(OPERATORS.index(question.operator)),
        driver=float(DRIVERS.index(question.driver)),
        **question.held,
        **shape,
    )


def _push(question: Question, size: float) -> Terms:
    """Return a term of constant size at the question's location."""
    term = PlantTerm(
        size=size,
        location=float([*LOCATIONS].index(question.location.name)),
        operator=float(OPERATORS.index("constant")),
    )
    return Terms()._replace(**{question.location.part: term})
