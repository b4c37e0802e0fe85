"""The plant of a simulated rig: parameters and a state that advances in time."""

from __future__ import annotations

from pamctl.plant.delayed_command import advance_delayed_plant
from pamctl.plant.parameters import PlantParameters, PlantState, vented_state
from pamctl.plant.sensing import sensed_position_m, sensed_pressure_pa
from pamctl.plant.step import advance_plant

LONGEST_STEP_S = 0.5e-3
"""Two steps a tick at 1 kHz: 0.6 um from the converged solution."""


class SimulatedPlant:
    """The plant of Eq. 9, as `hal.sim.sim_rig` calls it; `state` is the true state."""

    def __init__(self, parameters: PlantParameters, state: PlantState | None = None) -> None:
        """Start from `state`; by default vented and at rest."""
        self.parameters = parameters
        self.state = vented_state(parameters) if state is None else state
        self._line = (
            CommandLine() if parameters.effects.timing.command_delay.delay_s > 0.0 else None
        )

    def advance(self, command_v: float, duration_s: float) -> None:
        """Advance under a constant valve command (V)."""
        if self._line is not None:
            self.state = self._line.advance(self.parameters, self.state, command_v, duration_s)
            return
        self.state = advance_plant(
            self.parameters, self.state, command_v, duration_s, LONGEST_STEP_S
        )

    @property
    def truth(self) -> tuple[float, float]:
        """True displacement (m) and absolute pressure (Pa)."""
        return self.state.position_m, self.state.pressure_pa

    @property
    def is_delayed(self) -> bool:
        """Whether commands are on their way to the valve: the state is not all there is."""
        return self._line is not None

    @property
    def position_m(self) -> float:
        """Displacement at the encoder, before quantisation."""
        state = self.state
        return sensed_position_m(self.parameters, state.position_m, state.sensors, state.age_s)

    @property
    def pressure_pa(self) -> float:
        """Absolute pressure at the sensor, before noise."""
        state = self.state
        return sensed_pressure_pa(
            self.parameters, state.pressure_pa, state.air, state.sensors, state.age_s
        )


class CommandLine:
    """Commands on their way to the valve; the first one acts from the start."""

    def __init__(self) -> None:
        self._now_s = 0.0
        self._written_s: list[float] = []
        self._written_v: list[float] = []
        self._arrived = 0

    def advance(
        self, p: PlantParameters, state: PlantState, command_v: float, duration_s: float
    ) -> PlantState:
        """Write a command, and advance the plant."""
        self._written_s.append(self._now_s)
        self._written_v.append(command_v)
        state, self._arrived = advance_delayed_plant(
            p,
            state,
            self._written_s,
            self._written_v,
            len(self._written_s),
            self._arrived,
            self._now_s,
            duration_s,
            LONGEST_STEP_S,
        )
        self._now_s += duration_s
        if self._arrived > 1000:  # forget commands that have arrived
            del self._written_s[: self._arrived], self._written_v[: self._arrived]
            self._arrived = 0
        return state
