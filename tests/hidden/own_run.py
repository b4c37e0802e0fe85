"""A hidden rig behind the wires of a simulated one, so that pamctl's own loop can drive it."""

from __future__ import annotations

import numpy as np
from support.runs import run, run_settings

from hidden.equations.motion import at_rest, prepare_passage
from hidden.rig import HiddenRig, Record, needed_step_s
from pamctl.signals import Phase


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


DRIVER_OFFSET_V = 5.0
"""AO 5 V is a closed valve (DESIGN 4: command)."""


def own_run(rig: HiddenRig, experiment: str, seed: int) -> Record:
    """Run an open-loop experiment to its end; read the ticks as `pamctl.log.signals` does."""
    noise_v = rig.sensors.pressure_noise_pa * 6.43e-6  # of a sensor of 6.43 mV/kPa
    settings = run_settings(
        f"experiment.seed={seed}",
        f"rig.sim.sensor_noise_v={noise_v}",
        experiment=experiment,
        seed=rig.seed + seed,
    )
    ticks = run(settings, plant=HiddenPlant(rig)).journal.ticks
    rows = np.array(
        [
            (r.timing.t_s, r.outcome.applied_v - DRIVER_OFFSET_V,
             r.measurement.pressure_pa, r.measurement.position_m)
            for r in ticks
            if r.reference.phase == Phase.OPEN_LOOP
        ]
    )  # fmt: skip
    t_s = rows[:, 0] - rows[0, 0]
    return Record(f"{experiment}-{seed}", t_s, rows[:, 1], rows[:, 2], rows[:, 3])
