"""What no known effect explains, fitted as a table: a force or a flow without a name.

The table of the mechanics is a force over displacement and load; that of the pressure block is
a flow over opening and pressure. It is fitted through the simulation like any number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pamctl.diagnose.fitting.block_fit import rms
from pamctl.diagnose.fitting.drives import MECHANICS, Drive, stack_residuals
from pamctl.diagnose.measured.record import Array
from pamctl.plant.model import CorrectionSettings, FlowSettings, PlantSettings, PullSettings

ROUNDS = 6
STIFFNESS = 1e-3
"""Cost of a bend of the table, over what the data say of a usual node."""


def fit_correction_table(drives: Sequence[Drive], plant: PlantSettings) -> PlantSettings:
    """Fit a block's table on drives, from zeros or from the table that the plant has already.

    Gauss-Newton steps. Bends have a small cost, so that a node without samples follows its
    neighbours.
    """
    grid = _TableGrid.from_drives(drives, plant)
    nodes = grid.start
    settings = grid.with_nodes(plant, nodes)
    residual = stack_residuals(drives, settings)
    for _ in range(ROUNDS):
        slope = np.column_stack(
            [
                (stack_residuals(drives, grid.with_nodes(plant, nodes + step)) - residual)
                / grid.step
                for step in grid.step * np.eye(len(nodes))
            ]
        )
        bends = grid.second_differences
        square = slope.T @ slope
        cost = STIFFNESS * np.trace(square) / len(nodes) * (bends.T @ bends)
        change = -np.linalg.solve(square + cost, slope.T @ residual + cost @ nodes)
        for shorter in (1.0, 0.3, 0.1):
            tried = grid.with_nodes(plant, nodes + shorter * change)
            left = stack_residuals(drives, tried)
            if rms(left) < rms(residual):
                break
        else:
            return settings
        gained = 1.0 - rms(left) / rms(residual)
        nodes, settings, residual = nodes + shorter * change, tried, left
        if gained < 0.01:
            break
    return settings


@dataclass(frozen=True)
class _TableGrid:
    """The nodes of a block's table."""

    block: str
    first: Array
    second: Array
    step: float
    """Step of a node for a derivative: small but visible."""
    start: Array

    @classmethod
    def from_drives(cls, drives: Sequence[Drive], plant: PlantSettings) -> _TableGrid:
        """Lay the grid over the range of the drives, or keep the grid that the plant has."""
        block = drives[0].block
        known = plant.correction and (
            plant.correction.pull if block == MECHANICS else plant.correction.flow
        )
        step = 0.1 if block == MECHANICS else 1e-6
        if known:
            table = known.table()
            first, second = np.array(table.first), np.array(table.second)
            return cls(block, first, second, step, np.array(table.values))
        measured = np.concatenate([d.measured for d in drives])
        if block == MECHANICS:
            position_m = np.concatenate([d.position_m for d in drives])
            load = np.concatenate([d.load for d in drives])
            first, second = _make_even_lines(position_m, 6), _make_even_lines(load, 6)
        else:
            # Finest near null, where valves differ most from their formula.
            widest_v = max(float(np.max(np.abs(d.valve_v))) for d in drives)
            even = np.linspace(-1.0, 1.0, 9)
            first, second = widest_v * even * np.abs(even), _make_even_lines(measured, 4)
        return cls(block, first, second, step, np.zeros(len(first) * len(second)))

    @property
    def second_differences(self) -> Array:
        """Matrix of second differences along both axes, and a tenth of each node itself."""
        rows, columns = len(self.first), len(self.second)
        along = np.kron(np.diff(np.eye(rows), 2, axis=0), np.eye(columns))
        across = np.kron(np.eye(rows), np.diff(np.eye(columns), 2, axis=0))
        return np.vstack([along, across, 0.1 * np.eye(rows * columns)])

    def with_nodes(self, plant: PlantSettings, nodes: Array) -> PlantSettings:
        """Return the plant with these nodes (N, or kg/s)."""
        rows = nodes.reshape(len(self.first), len(self.second)).tolist()
        first, second = self.first.tolist(), self.second.tolist()
        own: dict[str, object]
        if self.block == MECHANICS:
            own = {"pull": PullSettings(displacement_m=first, load=second, pull_n=rows)}
        else:
            own = {"flow": FlowSettings(opening_v=first, pressure_pa=second, flow_kg_per_s=rows)}
        correction = (plant.correction or CorrectionSettings()).model_copy(update=own)
        return plant.model_copy(update={"correction": correction})


def _make_even_lines(values: Array, lines: int) -> Array:
    low, high = np.quantile(values, [0.001, 0.999])
    return np.linspace(low, max(high, low + 1e-9), lines)
