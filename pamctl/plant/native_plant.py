"""The simulated plant as machine code: the same numbers, some twenty times faster.

A loop in real time has a fraction of a period for it. The kernels are those of `SimulatedPlant`.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

from pamctl.compiled_ahead.layout import WORD_BYTES, Block, construct, store
from pamctl.compiled_ahead.library import KernelLibrary
from pamctl.plant.parameters import PlantParameters, PlantState, vented_state
from pamctl.plant.sensing import sensed_position_m, sensed_pressure_pa
from pamctl.plant.simulated import LONGEST_STEP_S, SimulatedPlant
from pamctl.plant.step import advance_plant


class SensedPlant(NamedTuple):
    """A plant after a step, and what its sensors show."""

    state: PlantState
    position_m: float
    pressure_pa: float


class PlantInput(NamedTuple):
    """What acts on the plant, and for how long."""

    command_v: float
    duration_s: float


def advance_and_sense(p: PlantParameters, state: PlantState, given: PlantInput) -> SensedPlant:
    """Kernel: advance under a constant command, and read the sensors."""
    state = advance_plant(p, state, given.command_v, given.duration_s, LONGEST_STEP_S)
    return SensedPlant(
        state,
        sensed_position_m(p, state.position_m, state.sensors, state.age_s),
        sensed_pressure_pa(p, state.pressure_pa, state.air, state.sensors, state.age_s),
    )


class PlantWords:
    """Where everything lies."""

    def __init__(self, parameters: PlantParameters) -> None:
        """Lay out for plants like this one. Raises `NotFlat`."""
        vented = vented_state(parameters)
        self.parameters: Block[PlantParameters] = Block(parameters, 0)
        self.given: Block[PlantInput] = Block(PlantInput(0.0, 0.0), self.parameters.end)
        self.sensed: Block[SensedPlant] = Block(SensedPlant(vented, 0.0, 0.0), self.given.end)
        self.words = self.sensed.end

    def write_glue(self) -> tuple[str, dict[str, Any]]:
        """Return the source of the function between words and kernel, and the types it names."""
        types: dict[type, str] = {}
        lines = [
            "def glue(ints, floats):",
            f"    p = {construct(self.parameters, types)}",
            f"    sensed = {construct(self.sensed, types)}",
            f"    given = {construct(self.given, types)}",
            "    after = kernel(p, sensed.state, given)",
            *(f"    {line}" for line in store(self.sensed, "after.")),
        ]
        return "\n".join(lines) + "\n", {name: kind for kind, name in types.items()}


class NativePlant(SimulatedPlant):
    """A `SimulatedPlant` that machine code advances."""

    def __init__(self, library: KernelLibrary, parameters: PlantParameters) -> None:
        """Use a library that was built from `PlantWords` of such parameters; start vented."""
        self._layout = PlantWords(parameters)
        self._words = bytearray(self._layout.words * WORD_BYTES)
        self._layout.parameters.write(self._words, parameters)
        self._native, self._arguments = library.bind(self._words, self._words)
        self._put_given = struct.Struct("<dd").pack_into
        self._given_at = self._layout.given.begin * WORD_BYTES
        self._get_number = struct.Struct("<d").unpack_from
        self._shown_at = (self._layout.sensed.end - 2) * WORD_BYTES
        places = [leaf.path for leaf in self._layout.sensed.leaves]
        begin = self._layout.sensed.begin
        self._true_at = [
            (begin + places.index(f"state.{name}")) * WORD_BYTES
            for name in ("position_m", "pressure_pa")
        ]
        super().__init__(parameters)

    @property
    def state(self) -> PlantState:
        """The true state."""
        return self._layout.sensed.read(self._words).state

    @state.setter
    def state(self, state: PlantState) -> None:
        p = self.parameters
        shown_m = sensed_position_m(p, state.position_m, state.sensors, state.age_s)
        shown_pa = sensed_pressure_pa(p, state.pressure_pa, state.air, state.sensors, state.age_s)
        self._layout.sensed.write(self._words, SensedPlant(state, shown_m, shown_pa))

    def advance(self, command_v: float, duration_s: float) -> None:
        """Advance under a constant valve command (V)."""
        self._put_given(self._words, self._given_at, command_v, duration_s)
        if self._native(*self._arguments):
            # Nothing was changed: plain Python says what is wrong.
            self.state = advance_plant(
                self.parameters, self.state, command_v, duration_s, LONGEST_STEP_S
            )

    @property
    def position_m(self) -> float:
        """Displacement at the encoder, before quantisation."""
        number: float = self._get_number(self._words, self._shown_at)[0]
        return number

    @property
    def pressure_pa(self) -> float:
        """Absolute pressure at the sensor, before noise."""
        number: float = self._get_number(self._words, self._shown_at + WORD_BYTES)[0]
        return number

    @property
    def truth(self) -> tuple[float, float]:
        """True displacement (m) and absolute pressure (Pa)."""
        position_at, pressure_at = self._true_at
        get, words = self._get_number, self._words
        return get(words, position_at)[0], get(words, pressure_at)[0]
