"""Each form in both units: `kind: sine` for the muscle, `kind: valve_sine` for the valve."""

from __future__ import annotations

from typing import Literal

from pamctl.control.references.forms import (
    IN_MM,
    IN_VOLTS,
    ChirpForm,
    MoveForm,
    MultisineForm,
    RampsForm,
    RandomForm,
    RoundedSquareForm,
    SineForm,
    StaircaseForm,
    TableForm,
    TriangleForm,
)


class MuscleSineSettings(SineForm):
    """A sine: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["sine"]


class ValveSineSettings(SineForm):
    """A sine: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_sine"]


class MuscleMultisineSettings(MultisineForm):
    """Many tones at once: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["multisine"]


class ValveMultisineSettings(MultisineForm):
    """Many tones at once: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_multisine"]


class MuscleChirpSettings(ChirpForm):
    """A tone of changing frequency: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["chirp"]


class ValveChirpSettings(ChirpForm):
    """A tone of changing frequency: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_chirp"]


class MuscleRandomSettings(RandomForm):
    """Random motion within a band: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["random"]


class ValveRandomSettings(RandomForm):
    """Random motion within a band: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_random"]


class MuscleRoundedSquareSettings(RoundedSquareForm):
    """A square wave with rounded transitions: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["rounded_square"]


class ValveRoundedSquareSettings(RoundedSquareForm):
    """A square wave with rounded transitions: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_rounded_square"]


class MuscleTriangleSettings(TriangleForm):
    """A triangle wave with rounded corners: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["triangle"]


class ValveTriangleSettings(TriangleForm):
    """A triangle wave with rounded corners: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_triangle"]


class MuscleRampsSettings(RampsForm):
    """Ramps from level to level: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["ramps"]


class ValveRampsSettings(RampsForm):
    """Ramps from level to level: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_ramps"]


class MuscleStaircaseSettings(StaircaseForm):
    """Smooth steps from level to level: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["staircase"]


class ValveStaircaseSettings(StaircaseForm):
    """Smooth steps from level to level: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_staircase"]


class MuscleTableSettings(TableForm):
    """Points of a CSV or MAT file, joined smoothly: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["table"]


class ValveTableSettings(TableForm):
    """Points of a CSV or MAT file, joined smoothly: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_table"]


class MuscleMoveSettings(MoveForm):
    """From rest to rest, within a sequence: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["move"]


class ValveMoveSettings(MoveForm):
    """From rest to rest, within a sequence: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_move"]


StandingForm = (
    MuscleSineSettings
    | ValveSineSettings
    | MuscleMultisineSettings
    | ValveMultisineSettings
    | MuscleChirpSettings
    | ValveChirpSettings
    | MuscleRandomSettings
    | ValveRandomSettings
    | MuscleRoundedSquareSettings
    | ValveRoundedSquareSettings
    | MuscleTriangleSettings
    | ValveTriangleSettings
    | MuscleRampsSettings
    | ValveRampsSettings
    | MuscleStaircaseSettings
    | ValveStaircaseSettings
    | MuscleTableSettings
    | ValveTableSettings
)
"""The forms that make an experiment alone."""
