"""The plant in C: its numbers, its start, and the functions that the interface calls."""

from __future__ import annotations

from collections.abc import Mapping

from pamctl.kernel.c_source import FLOAT, INT, NUMBERS, CSource, CType, Kernel, write_call
from pamctl.plant.parameters import PlantParameters, vented_state
from pamctl.plant.simulated import LONGEST_STEP_S, advance_delayed_plant
from pamctl.plant.step import advance_plant, sensed_position_m, sensed_pressure_pa

FIRST_NUMBER = 100
"""Value reference of the first number of the plant file."""


def write_plant_source(p: PlantParameters, numbers: Mapping[str, float]) -> str:
    """Return plant.c: from the vented muscle at rest; `numbers` are shown, not used.

    Raise NotInC if a kernel, as that of an outside package's effect, cannot be written as C.
    """
    source = CSource()
    parameters = source.add_constant("parameters", p)
    start = source.add_constant("start", vented_state(p))
    is_delayed = p.effects.timing.command_delay.delay_s > 0.0

    def add(head: str, kernel: Kernel, given: Mapping[str, CType]) -> str:
        """Add a function with this head that calls a kernel; return the type of its result."""
        name, result = source.add_kernel(kernel, [parameters, *given.values()])
        call = write_call(name, {"parameters": parameters, **given})
        source.functions.append(f"static {result.name} {head} {{ return {call}; }}\n")
        return result.name

    if is_delayed:
        advanced = add(
            "advance_plant(const PLANT *plant, Numbers written_s, Numbers written_v, "
            "long long arrived, double now_s, double duration_s)",
            advance_delayed_plant,
            {
                "*plant": start, "written_s": NUMBERS, "written_v": NUMBERS,
                "written_s.length": INT, "arrived": INT, "now_s": FLOAT, "duration_s": FLOAT,
                repr(LONGEST_STEP_S): FLOAT,
            },
        )  # fmt: skip
    else:
        advanced = add(
            "advance_plant(const PLANT *plant, double command_v, double duration_s)",
            advance_plant,
            {
                "*plant": start, "command_v": FLOAT, "duration_s": FLOAT,
                repr(LONGEST_STEP_S): FLOAT,
            },
        )  # fmt: skip
    add(
        "show_position_m(const PLANT *plant)",
        sensed_position_m,
        {
            "plant->position_m": FLOAT, "plant->sensors": start["sensors"],
            "plant->age_s": FLOAT,
        },
    )  # fmt: skip
    add(
        "show_pressure_pa(const PLANT *plant)",
        sensed_pressure_pa,
        {
            "plant->pressure_pa": FLOAT, "plant->air": start["air"],
            "plant->sensors": start["sensors"], "plant->age_s": FLOAT,
        },
    )  # fmt: skip
    defined = [
        f"#define PLANT {start.name}",
        f"#define ADVANCED {advanced}",
        *(["#define COMMAND_IS_DELAYED"] if is_delayed else []),
        f"#define FIRST_NUMBER {FIRST_NUMBER}",
        f"#define NUMBERS {len(numbers)}",
    ]
    shown = ", ".join(repr(float(value)) for value in numbers.values())
    table = f"static const double numbers[] = {{{shown}}};"
    return "\n".join([*defined, source.text(), table, ""])
