"""The encoder's scale is wrong: strip, mounting angle, elastic carrier."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, size


class EncoderScale(NamedTuple):
    """Shown displacement over the true one."""

    scale: float = 1.0


DESCRIPTION = EffectDescription(
    name="encoder_scale",
    block="sensors",
    equation="x_m = s x",
    parameters=(
        size(
            "scale",
            "1",
            1.1,
            smallest=0.004,
            start=1.01,
            meaning="s, shown over true displacement",
            neutral=1.0,
            low=0.9,
        ),
    ),
    signature="an error in proportion to the displacement, at any pressure and speed",
    best_experiment="square",
    parts=("sensors",),
    seen_by=("mechanics", "pressure"),
)
