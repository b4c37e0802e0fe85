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


class MuscleSine(SineForm):
    """A sine: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["sine"]


class ValveSine(SineForm):
    """A sine: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_sine"]


class MuscleMultisine(MultisineForm):
    """Many tones at once: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["multisine"]


class ValveMultisine(MultisineForm):
    """Many tones at once: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_multisine"]


class MuscleChirp(ChirpForm):
    """A tone of changing frequency: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["chirp"]


class ValveChirp(ChirpForm):
    """A tone of changing frequency: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_chirp"]


class MuscleRandom(RandomForm):
    """Random motion within a band: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["random"]


class ValveRandom(RandomForm):
    """Random motion within a band: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_random"]


class MuscleRoundedSquare(RoundedSquareForm):
    """A square wave with rounded transitions: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["rounded_square"]


class ValveRoundedSquare(RoundedSquareForm):
    """A square wave with rounded transitions: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_rounded_square"]


class MuscleTriangle(TriangleForm):
    """A triangle wave with rounded corners: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["triangle"]


class ValveTriangle(TriangleForm):
    """A triangle wave with rounded corners: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_triangle"]


class MuscleRamps(RampsForm):
    """Ramps from level to level: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["ramps"]


class ValveRamps(RampsForm):
    """Ramps from level to level: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_ramps"]


class MuscleStaircase(StaircaseForm):
    """Smooth steps from level to level: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["staircase"]


class ValveStaircase(StaircaseForm):
    """Smooth steps from level to level: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_staircase"]


class MuscleTable(TableForm):
    """Points of a CSV or MAT file, joined smoothly: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["table"]


class ValveTable(TableForm):
    """Points of a CSV or MAT file, joined smoothly: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_table"]


class MuscleMove(MoveForm):
    """From rest to rest, within a sequence: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["move"]


class ValveMove(MoveForm):
    """From rest to rest, within a sequence: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_move"]


StandingForm = (
    MuscleSine
    | ValveSine
    | MuscleMultisine
    | ValveMultisine
    | MuscleChirp
    | ValveChirp
    | MuscleRandom
    | ValveRandom
    | MuscleRoundedSquare
    | ValveRoundedSquare
    | MuscleTriangle
    | ValveTriangle
    | MuscleRamps
    | ValveRamps
    | MuscleStaircase
    | ValveStaircase
    | MuscleTable
    | ValveTable
)
"""The forms that make an experiment alone."""
