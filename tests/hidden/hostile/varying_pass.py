"""A rig that may change while it runs, read at any instant: each channel has its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hidden.equations.machine_code import prepare_passage, settle
from hidden.equations.truth import State, Truth
from hidden.excitations import Excitation
from hidden.sensors import AO_STEP_V

Array = NDArray[np.float64]
Reader = Callable[[int, State], tuple[float, float]]
"""(tick, state) -> (pressure in Pa, position in m) as the loop's sensors show them."""


@dataclass(frozen=True)
class Passed:
    """What was there: the commands of the ticks, and the state at the asked instants."""

    volts: Array
    sensed_pa: Array
    geared_m: Array
    """Both at their own instants."""
    rest_m: float


def run_varying(
    truth_at: Callable[[float], Truth],
    excitation: Excitation,
    tick_s: Array,
    pressure_s: Array,
    position_s: Array,
    read: Reader,
    step_s: float,
) -> Passed:
    """Move the rig under the commands of the ticks, from rest and vented.

    A command acts from its tick on. `pressure_s` and `position_s` are the instants at which the
    file's values were really there; before the start and after the last tick the rig is as then.
    """
    start = truth_at(0.0)
    state = settle(start, excitation.rest_v, step_s)
    end_s = float(tick_s[-1])
    instants = np.unique(np.clip(np.concatenate([tick_s, pressure_s, position_s]), 0.0, end_s))
    ticks = {float(t): k for k, t in enumerate(tick_s)}
    loop = _Loop(excitation)
    volts = np.zeros(len(tick_s))
    seen = np.zeros((2, len(instants)))
    call = prepare_passage(start, state, np.ascontiguousarray(tick_s), volts, step_s)
    rest_m = float(state.geared_m)
    for i, now in enumerate(instants):
        seen[:, i] = state.sensed_pa, state.geared_m
        tick = ticks.get(float(now))
        if tick is not None:
            dt = float(tick_s[tick] - tick_s[tick - 1]) if tick else 1e-3
            volts[tick] = loop.choose_volts(tick, float(now), dt, *read(tick, state))
            call.put("written", tick + 1)
        if i + 1 < len(instants):
            call.put("p", truth_at(float(now)))
            call.put("since", float(now))
            call.put("until", float(instants[i + 1]))
            call.run()
            state = call.get("state")
    at = [np.searchsorted(instants, np.clip(t, 0.0, end_s)) for t in (pressure_s, position_s)]
    return Passed(volts, seen[0][at[0]], seen[1][at[1]], rest_m)


class _Loop:
    """Asks for a voltage: the excitation's own, or a PID's on what it reads."""

    def __init__(self, excitation: Excitation) -> None:
        self._asked = excitation
        self._total = self._slope = self._slow = 0.0
        self._before = 0.0
        self._began = False

    def choose_volts(
        self, k: int, t_s: float, dt: float, pressure: float, position: float
    ) -> float:
        asked = self._asked
        if asked.volts is not None:
            return round(float(asked.volts[k]) / AO_STEP_V) * AO_STEP_V
        assert asked.wanted_m is not None
        if not self._began:
            self._before, self._slow, self._began = position, pressure, True
        proportional, integral, derivative, damping = asked.gains
        self._slope += dt / 8e-3 * ((position - self._before) / dt - self._slope)
        self._slow += dt / 50e-3 * (pressure - self._slow)
        self._before = position
        if t_s < asked.rest_s:
            return round(asked.rest_v / AO_STEP_V) * AO_STEP_V
        error = float(asked.wanted_m[k]) - position
        u = proportional * error + integral * self._total - derivative * self._slope
        u -= damping * (pressure - self._slow)
        if abs(u) < 5.0:
            self._total += error * dt
        return round(min(max(u, -5.0), 5.0) / AO_STEP_V) * AO_STEP_V
