"""A plant that lives in a simulated rig: parameters, a state, and time that passes."""

from __future__ import annotations

from pamctl.plant.parameters import PlantParameters, PlantState, vented
from pamctl.plant.step import plant_advance

LONGEST_STEP_S = 0.5e-3
"""Two steps a tick at 1 kHz: 0.6 um from the converged solution."""


class SimulatedPlant:
    """The plant of Eq. 9 as `hal.sim` wants it."""

    def __init__(self, parameters: PlantParameters, state: PlantState | None = None) -> None:
        """Start from `state`; by default vented and at rest."""
        self._parameters = parameters
        self.state = vented(parameters) if state is None else state

    def advance(self, command_v: float, duration_s: float) -> None:
        """Let time pass under a constant valve command (V)."""
        self.state = plant_advance(
            self._parameters, self.state, command_v, duration_s, LONGEST_STEP_S
        )

    @property
    def position_m(self) -> float:
        """True displacement."""
        return self.state.position_m

    @property
    def pressure_pa(self) -> float:
        """True absolute pressure."""
        return self.state.pressure_pa
