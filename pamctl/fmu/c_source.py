"""The plant in C: its numbers, its start, and the kernels that the interface calls."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pamctl.fmu.kernels_to_c import ARRAY, FLOAT, INT, CSource
from pamctl.plant.delayed_command import advance_delayed_plant
from pamctl.plant.parameters import PlantParameters, vented_state
from pamctl.plant.sensing import sensed_position_m, sensed_pressure_pa
from pamctl.plant.simulated import LONGEST_STEP_S
from pamctl.plant.step import advance_plant

FIRST_NUMBER = 100
"""Value reference of the first number of the plant file."""


def write_plant_source(p: PlantParameters, numbers: Mapping[str, float]) -> str:
    """Return plant.c: from the vented muscle at rest; `numbers` are shown, not used.

    Raise NotInC if a kernel, as that of an outside package's effect, cannot be written as C.
    """
    source = CSource()
    plant = source.add_constant("parameters", p)
    state = source.add_constant("start", vented_state(p))
    names: dict[str, Any] = {"LONGEST_STEP_S": repr(LONGEST_STEP_S)}
    if p.effects.timing.command_delay.delay_s > 0.0:
        types = [plant, state, ARRAY, ARRAY, INT, INT, FLOAT, FLOAT, FLOAT]
        names["ADVANCE_DELAYED"], result = source.add_kernel(advance_delayed_plant, types)
        names |= {"ADVANCED": result.name, "COMMAND_IS_DELAYED": 1}
    else:
        types = [plant, state, FLOAT, FLOAT, FLOAT]
        names["ADVANCE"], _ = source.add_kernel(advance_plant, types)
    names["SENSED_POSITION"], _ = source.add_kernel(
        sensed_position_m, [plant, FLOAT, state["sensors"], FLOAT]
    )
    names["SENSED_PRESSURE"], _ = source.add_kernel(
        sensed_pressure_pa, [plant, FLOAT, state["air"], state["sensors"], FLOAT]
    )
    names |= {"FIRST_NUMBER": FIRST_NUMBER, "NUMBERS": len(numbers)}
    shown = ", ".join(repr(float(value)) for value in numbers.values())
    table = f"static const double numbers[] = {{{shown}}};"
    defined = [f"#define {name} {value}" for name, value in names.items()]
    return "\n".join([source.text(), table, *defined, ""])
