"""Each form in both units: `kind: sine` for the muscle, `kind: valve_sine` for the valve."""

from __future__ import annotations

from typing import Literal

from pamctl.control.references.forms import (
    IN_MM,
    IN_VOLTS,
    Chirp,
    Move,
    Multisine,
    Ramps,
    Random,
    RoundedSquare,
    Sine,
    Staircase,
    Table,
    Triangle,
)


class MuscleSine(Sine):
    """A sine: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["sine"]


class ValveSine(Sine):
    """A sine: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_sine"]


class MuscleMultisine(Multisine):
    """Many tones at once: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["multisine"]


class ValveMultisine(Multisine):
    """Many tones at once: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_multisine"]


class MuscleChirp(Chirp):
    """A tone of changing frequency: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["chirp"]


class ValveChirp(Chirp):
    """A tone of changing frequency: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_chirp"]


class MuscleRandom(Random):
    """Random motion within a band: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["random"]


class ValveRandom(Random):
    """Random motion within a band: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_random"]


class MuscleRoundedSquare(RoundedSquare):
    """A square wave with rounded transitions: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["rounded_square"]


class ValveRoundedSquare(RoundedSquare):
    """A square wave with rounded transitions: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_rounded_square"]


class MuscleTriangle(Triangle):
    """A triangle wave with rounded corners: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["triangle"]


class ValveTriangle(Triangle):
    """A triangle wave with rounded corners: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_triangle"]


class MuscleRamps(Ramps):
    """Ramps from level to level: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["ramps"]


class ValveRamps(Ramps):
    """Ramps from level to level: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_ramps"]


class MuscleStaircase(Staircase):
    """Smooth steps from level to level: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["staircase"]


class ValveStaircase(Staircase):
    """Smooth steps from level to level: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_staircase"]


class MuscleTable(Table):
    """Points of a CSV or MAT file, joined smoothly: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["table"]


class ValveTable(Table):
    """Points of a CSV or MAT file, joined smoothly: of the valve, in open loop."""

    model_config = IN_VOLTS
    SI = 1.0
    IS_VALVE = True
    kind: Literal["valve_table"]


class MuscleMove(Move):
    """From rest to rest, within a sequence: of the muscle, in closed loop."""

    model_config = IN_MM
    kind: Literal["move"]


class ValveMove(Move):
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
