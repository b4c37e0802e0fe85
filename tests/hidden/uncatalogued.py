"""Truths that no catalogue has, and where each acts: for the reach of described terms.

Six are in the rig's own equations. The others are done to what goes into the rig and comes out of
it: a valve whose null is off, one that moves at a limited rate, an encoder that is not concentric,
a pressure sensor that is not straight.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hidden.excitations import PROGRAMS, Excitation
from hidden.rig import HiddenRig, Record, hidden_rig
from hidden.sensors import ENCODER_STEP_M

Run = Callable[[HiddenRig, Excitation], Record]
Place = tuple[str, str]
"""Location and driver of a term; an empty driver is any."""


@dataclass(frozen=True)
class Uncatalogued:
    """A truth, and the places and drivers that say it rightly."""

    name: str
    block: str
    right: tuple[Place, ...]
    effect: str = ""
    """Of the rig's own equations, at three times the smallest size of interest."""
    run: Run | None = None

    def record(self, program: str, seed: int) -> tuple[list[Record], list[Record]]:
        """Return the records for the fit, and those to judge by."""
        rig = hidden_rig({self.effect: 3.0} if self.effect else {}, seed=seed)

        def measure(excitations: Sequence[Excitation]) -> list[Record]:
            run = self.run or (lambda rig, excitation: rig.run(excitation).record)
            return [run(rig, excitation) for excitation in excitations]

        train, held_out = PROGRAMS[program](seed)
        return measure(train), measure(held_out)


def _with_valve(change: Callable[[np.ndarray], np.ndarray]) -> Run:
    """Run a rig whose valve gets other volts than those that are recorded."""

    def run(rig: HiddenRig, excitation: Excitation) -> Record:
        assert excitation.volts is not None
        moved = replace(excitation, volts=change(excitation.volts))
        record = rig.run(moved).record
        plain = np.round(excitation.volts * 65536.0 / 20.0) * 20.0 / 65536.0
        kept = np.round(record.t_s * 1e3 - 1e-6).astype(int).clip(0, len(plain) - 1)
        return replace(record, valve_v=plain[kept])

    return run


def _limit_rate(volts: np.ndarray, step_v: float) -> np.ndarray:
    moved = volts.copy()
    for k in range(1, len(moved)):
        moved[k] = moved[k - 1] + np.clip(volts[k] - moved[k - 1], -step_v, step_v)
    return moved


def _turn_off_centre(rig: HiddenRig, excitation: Excitation) -> Record:
    record = rig.run(excitation).record
    assert record.position_m is not None
    shown = record.position_m + 60e-6 * np.sin(2.0 * np.pi * record.position_m / 6.3e-3)
    return replace(record, position_m=np.floor(shown / ENCODER_STEP_M + 0.5) * ENCODER_STEP_M)


def _bend_sensor(rig: HiddenRig, excitation: Excitation) -> Record:
    record = rig.run(excitation).record
    assert record.pressure_pa is not None
    share = (record.pressure_pa - 101.3e3) / 340e3
    return replace(record, pressure_pa=record.pressure_pa + 4.0 * 3e3 * share * (1.0 - share))


UNCATALOGUED = (
    Uncatalogued("position_dependent_friction", "mechanics", (("braid_friction", "position"),),
                 "position_dependent_friction"),
    Uncatalogued("hysteretic_spring", "mechanics", (("force", "position"),), "hysteretic_spring"),
    Uncatalogued("second_spring", "mechanics", (("force", "position"),), "second_spring"),
    Uncatalogued("wearing_friction", "mechanics", (("braid_friction", "time"),),
                 "wearing_friction"),
    Uncatalogued("supply_ripple", "pressure", (("supply", "time"),), "supply_ripple"),
    Uncatalogued("valve_gain_wobble", "pressure",
                 (("opening", "time"),), "valve_gain_wobble"),
    Uncatalogued("null_offset", "pressure", (("command", ""),),
                 run=_with_valve(lambda v: v + 0.07)),
    Uncatalogued("slew_limit", "pressure", (("command", "command"),),
                 run=_with_valve(lambda v: _limit_rate(v, 1.3))),
    Uncatalogued("off_centre_encoder", "mechanics", (("encoder", "position"),),
                 run=_turn_off_centre),
    Uncatalogued("bent_sensor", "pressure", (("pressure_sensor", "pressure"),), run=_bend_sensor),
)  # fmt: skip
