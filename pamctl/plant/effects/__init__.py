"""The catalogue of effects that the paper's model leaves out.

One file an effect: its parameters (a NamedTuple whose defaults are the neutral
values), its kernel, and its description. To add one: write the file, name it in
`Effects` and in `CATALOGUE`, and call its kernel where it enters the plant. At the
neutral values the paper's model is reproduced bit for bit.
"""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects import valve_spool
from pamctl.plant.effects.description import EffectDescription
from pamctl.plant.effects.valve_spool import ValveSpool


class Effects(NamedTuple):
    """Parameters of every effect; by default none of them acts."""

    valve_spool: ValveSpool = ValveSpool()


CATALOGUE: dict[str, EffectDescription] = {
    description.name: description for description in (valve_spool.DESCRIPTION,)
}
