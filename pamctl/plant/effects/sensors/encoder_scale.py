"""The encoder's scale is wrong: strip, mounting angle, elastic carrier."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from pamctl.plant.effects.description import AsTerm, EffectDescription, EffectEntry, size

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


class EncoderScale(NamedTuple):
    """Ratio of shown to true displacement."""

    scale: float = 1.0


def scale_position_m(encoder: EncoderScale, position_m: float) -> float:
    """Return the displacement that is shown."""
    return encoder.scale * position_m


def undo_scale_m(
    encoder: EncoderScale, position_m: Array, times_s: Array, atmosphere_pa: float
) -> Array:
    """Return the displacement that a correct scale would show."""
    return position_m / encoder.scale


DESCRIPTION = EffectDescription(
    name="encoder_scale",
    kind=EncoderScale,
    block="sensors",
    equation="x_m = s x",
    parameters=(
        size(
            "scale",
            "1",
            1.1,
            smallest=0.004,
            start=1.01,
            meaning="s, ratio of shown to true displacement",
            neutral=1.0,
            low=0.9,
        ),
    ),
    signature="an error in proportion to the displacement, at any pressure and speed",
    best_experiment="square-1",
    seen_by=("mechanics", "pressure"),
    entries=(
        EffectEntry(
            "position_reading", scale_position_m, after=("encoder_backlash",), undo=undo_scale_m
        ),
    ),
    as_terms=(AsTerm("encoder", "gain", "position"),),
)
