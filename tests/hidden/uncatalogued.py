"""Truths beyond the searched catalogue, and where each acts: for the reach of described terms.

Some are in the rig's own equations. Others change its numbers while it runs: at an instant, or
evenly. The rest are done to what goes into the rig and comes out of it: a valve whose null is off,
an encoder that is not concentric, a pressure sensor that is not straight. A few have a name in the
catalogue that only a term leads to: the study of the terms leaves the names out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hidden.equations.truth import Truth
from hidden.excitations import PROGRAMS, Excitation
from hidden.hostile.file_of_lab import record_of
from hidden.hostile.lab import Lab
from hidden.rig import HiddenRig, Record, hidden_rig
from hidden.sensors import ENCODER_STEP_M

Run = Callable[[HiddenRig, Excitation], Record]
Place = tuple[str, str]
"""Location and driver of a term; an empty driver is any."""


@dataclass(frozen=True)
class Uncatalogued:
    """A truth, and the places and drivers that say it rightly."""

    name: str
    right: tuple[Place, ...]
    effect: str = ""
    """Of the rig's own equations, at three times the smallest size of interest."""
    run: Run | None = None
    called: str = ""
    """The effect of the catalogue that has its equation, if one does; only a term leads to it."""

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


def _over_time(change: Callable[[Truth, float], Truth]) -> Run:
    """Run a rig whose truth follows the time since a record began."""

    def run(rig: HiddenRig, excitation: Excitation) -> Record:
        return record_of(rig, Lab(), excitation, 0.0, lambda t_s: change(rig.truth, t_s))

    return run


def _times(number: str, share: float, begins_s: float = 0.0) -> Run:
    """Run a rig one of whose numbers changes by a share: in each second, or once at an instant."""

    def change(truth: Truth, t_s: float) -> Truth:
        times = float(t_s >= begins_s) if begins_s else t_s
        return truth._replace(**{number: getattr(truth, number) * (1.0 + share * times)})

    return _over_time(change)


def _on_position(show: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Run:
    """Run a rig whose encoder shows a function of position and time."""

    def run(rig: HiddenRig, excitation: Excitation) -> Record:
        record = rig.run(excitation).record
        assert record.position_m is not None
        shown = show(record.position_m, record.t_s)
        return replace(record, position_m=np.floor(shown / ENCODER_STEP_M + 0.5) * ENCODER_STEP_M)

    return run


def _on_pressure(show: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Run:
    """Run a rig whose pressure sensor shows a function of gauge pressure and time."""

    def run(rig: HiddenRig, excitation: Excitation) -> Record:
        record = rig.run(excitation).record
        assert record.pressure_pa is not None
        return replace(record, pressure_pa=101.3e3 + show(record.pressure_pa - 101.3e3, record.t_s))

    return run


def _bend(gauge_pa: np.ndarray) -> np.ndarray:
    share = gauge_pa / 340e3
    return gauge_pa + 4.0 * 3e3 * share * (1.0 - share)


def _in_truth(name: str, right: Place, called: str = "") -> Uncatalogued:
    return Uncatalogued(name, (right,), name, called=called)


OFF_CENTRE = _on_position(lambda x, t: x + 60e-6 * np.sin(2.0 * np.pi * x / 6.3e-3))

UNCATALOGUED = (
    # --- in the rig's own equations
    _in_truth("position_dependent_friction", ("braid_friction", "position"),
              "position_friction"),
    _in_truth("hysteretic_spring", ("force", "position"), "spring_hysteresis"),
    _in_truth("second_spring", ("force", "position")),
    _in_truth("wearing_friction", ("braid_friction", "time")),
    _in_truth("friction_with_pressure", ("braid_friction", "pressure")),
    _in_truth("drag_along_stroke", ("damping", "position")),
    _in_truth("pull_along_stroke", ("pull", "position")),
    _in_truth("supply_ripple", ("supply", "time"), "supply_ripple"),
    _in_truth("valve_gain_wobble", ("opening", "time")),
    _in_truth("slewing_driver", ("command", "command"), "valve_slew"),
    _in_truth("swelling_hose", ("volume", "pressure")),
    # --- numbers that change while it runs
    Uncatalogued("supply_falls", (("supply", "time"),),
                 run=_times("supply_pa", -0.009)),
    Uncatalogued("supply_jumps", (("supply", "time"),),
                 run=_times("supply_pa", -0.03, 1.37)),
    Uncatalogued("exhaust_clogs", (("exhausting", "time"),),
                 run=_times("vent_gain", -0.02)),
    Uncatalogued("valve_opens_wider", (("opening", "time"),),
                 run=_times("valve_m2_per_v", 0.06, 1.73)),
    Uncatalogued("spring_softens", (("stiffness", "time"),),
                 run=_times("stiffness", -0.009), called="drift"),
    Uncatalogued("damping_grows", (("damping", "time"),),
                 run=_times("damping", 0.08)),
    Uncatalogued("load_is_hung_on", (("force", "time"),),
                 run=_over_time(lambda p, t_s: p._replace(load_n=1.7 if t_s >= 1.31 else 0.0))),
    # --- on what goes in and comes out
    Uncatalogued("null_offset", (("command", ""),),
                 run=_with_valve(lambda v: v + 0.07), called="null_offset"),
    Uncatalogued("null_jumps", (("command", "time"),),
                 run=_with_valve(lambda v: v + 0.06 * (np.arange(len(v)) >= 1610))),
    Uncatalogued("null_creeps", (("command", "time"),),
                 run=_with_valve(lambda v: v + 0.025e-3 * np.arange(len(v)))),
    Uncatalogued("slew_limit", (("command", "command"),),
                 run=_with_valve(lambda v: _limit_rate(v, 1.3)), called="valve_slew"),
    Uncatalogued("off_centre_encoder", (("encoder", "position"),), run=OFF_CENTRE),
    Uncatalogued("slipping_encoder", (("encoder", "time"),),
                 run=_on_position(lambda x, t: x + 70e-6 * (t >= 1.43))),
    Uncatalogued("bent_sensor", (("pressure_sensor", "pressure"),),
                 run=_on_pressure(lambda g, t: _bend(g))),
    Uncatalogued("drifting_sensor", (("pressure_sensor", "time"),),
                 run=_on_pressure(lambda g, t: g + 0.8e3 * t)),
)  # fmt: skip
