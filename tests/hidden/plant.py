"""A hidden rig behind the wires of a simulated one, so that pamctl's own loop can drive it."""

from __future__ import annotations

import numpy as np

from hidden.equations.advance import at_rest
from hidden.equations.machine_code import prepare_passage
from hidden.rig import HiddenRig, needed_step_s


class HiddenPlant:
    """A plant for `hal.sim.SimRig`: time passes under a command, and it is read."""

    def __init__(self, rig: HiddenRig, longest_run_s: float = 600.0) -> None:
        """Start vented and at rest; noise and steps are the simulated rig's own."""
        self._rig = rig
        self._state = at_rest(rig.truth, 0.0)
        self._rest_m = self._state.geared_m if rig.sensors.encoder_homed else 0.0
        self._times = np.zeros(round(longest_run_s / 1e-4))
        self._volts = np.zeros_like(self._times)
        self._written = 0
        step_s = rig.step_s or needed_step_s(rig.truth)
        self._call = prepare_passage(rig.truth, self._state, self._times, self._volts, step_s)

    def advance(self, command_v: float, duration_s: float) -> None:
        """Let time pass under a constant valve command (V)."""
        now = self._state.t_s
        self._times[self._written] = now
        self._volts[self._written] = command_v
        self._written += 1
        for name, value in (
            ("since", now),
            ("until", now + duration_s),
            ("written", self._written),
        ):
            self._call.put(name, value)
        self._call.run()
        self._state = self._call.get("state")

    @property
    def position_m(self) -> float:
        """What the encoder is turned to."""
        return float(self._rig.sensors.encoder_scale * (self._state.geared_m - self._rest_m))

    @property
    def pressure_pa(self) -> float:
        """Absolute, as the sensor would show it without noise."""
        sensors, atmosphere = self._rig.sensors, self._rig.truth.atmosphere_pa
        gauge = sensors.pressure_gain * (self._state.sensed_pa - atmosphere)
        return float(atmosphere + gauge + sensors.pressure_offset_pa)
