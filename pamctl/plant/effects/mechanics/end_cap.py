"""The ends of the muscle are not cylindrical: a part of the length neither fills nor pulls."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from pamctl.plant.effects.description import AsTerm, EffectDescription, EffectEntry, size

if TYPE_CHECKING:
    from pamctl.plant.parameters import PaperParameters


class EndCap(NamedTuple):
    """Length that neither fills nor pulls."""

    length_m: float = 0.0


def shorten_muscle(cap: EndCap, numbers: PaperParameters) -> PaperParameters:
    """Return the plant's numbers with the active part of L_0."""
    return numbers._replace(rest_length_m=numbers.rest_length_m - cap.length_m)


DESCRIPTION = EffectDescription(
    name="end_cap",
    kind=EndCap,
    block="mechanics",
    equation="L = L_0 - l_e - x in V(x), A(x) and theta",
    parameters=(
        size("length_m", "m", 0.02, smallest=1e-3, start=3e-3, meaning="l_e, lost length"),
    ),
    signature="a static error: a function of the displacement, multiplied by the pressure",
    best_experiment="fill-and-hold",
    seen_by=("mechanics", "pressure"),
    entries=(EffectEntry("numbers", shorten_muscle),),
    actuators=("muscle",),
    as_terms=(AsTerm("force", "curve", "position"), AsTerm("pull", "curve", "position")),
)
