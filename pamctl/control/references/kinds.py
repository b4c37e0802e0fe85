"""Each form in both units: `kind: sine` for the muscle, `kind: valve_sine` for the valve."""

from __future__ import annotations

from typing import Literal

from pamctl.control.references.forms import (
    ChirpForm,
    InVolts,
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

    kind: Literal["sine"]


class ValveSineSettings(SineForm, InVolts):
    """A sine: of the valve, in open loop."""

    kind: Literal["valve_sine"]


class MuscleMultisineSettings(MultisineForm):
    """Many tones at once: of the muscle, in closed loop."""

    kind: Literal["multisine"]


class ValveMultisineSettings(MultisineForm, InVolts):
    """Many tones at once: of the valve, in open loop."""

    kind: Literal["valve_multisine"]


class MuscleChirpSettings(ChirpForm):
    """A tone of changing frequency: of the muscle, in closed loop."""

    kind: Literal["chirp"]


class ValveChirpSettings(ChirpForm, InVolts):
    """A tone of changing frequency: of the valve, in open loop."""

    kind: Literal["valve_chirp"]


class MuscleRandomSettings(RandomForm):
    """Random motion within a band: of the muscle, in closed loop."""

    kind: Literal["random"]


class ValveRandomSettings(RandomForm, InVolts):
    """Random motion within a band: of the valve, in open loop."""

    kind: Literal["valve_random"]


class MuscleRoundedSquareSettings(RoundedSquareForm):
    """A square wave with rounded transitions: of the muscle, in closed loop."""

    kind: Literal["rounded_square"]


class ValveRoundedSquareSettings(RoundedSquareForm, InVolts):
    """A square wave with rounded transitions: of the valve, in open loop."""

    kind: Literal["valve_rounded_square"]


class MuscleTriangleSettings(TriangleForm):
    """A triangle wave with rounded corners: of the muscle, in closed loop."""

    kind: Literal["triangle"]


class ValveTriangleSettings(TriangleForm, InVolts):
    """A triangle wave with rounded corners: of the valve, in open loop."""

    kind: Literal["valve_triangle"]


class MuscleRampsSettings(RampsForm):
    """Ramps from level to level: of the muscle, in closed loop."""

    kind: Literal["ramps"]


class ValveRampsSettings(RampsForm, InVolts):
    """Ramps from level to level: of the valve, in open loop."""

    kind: Literal["valve_ramps"]


class MuscleStaircaseSettings(StaircaseForm):
    """Smooth steps from level to level: of the muscle, in closed loop."""

    kind: Literal["staircase"]


class ValveStaircaseSettings(StaircaseForm, InVolts):
    """Smooth steps from level to level: of the valve, in open loop."""

    kind: Literal["valve_staircase"]


class MuscleTableSettings(TableForm):
    """Points of a CSV or MAT file, joined smoothly: of the muscle, in closed loop."""

    kind: Literal["table"]


class ValveTableSettings(TableForm, InVolts):
    """Points of a CSV or MAT file, joined smoothly: of the valve, in open loop."""

    kind: Literal["valve_table"]


class MuscleMoveSettings(MoveForm):
    """From rest to rest, within a sequence: of the muscle, in closed loop."""

    kind: Literal["move"]


class ValveMoveSettings(MoveForm, InVolts):
    """From rest to rest, within a sequence: of the valve, in open loop."""

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
