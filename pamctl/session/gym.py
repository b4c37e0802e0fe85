"""A Gymnasium environment: learn to move the simulated muscle along a reference.

    env = pamctl.gym.MuscleEnv("paper", pamctl.Sine(offset_mm=12, amplitude_mm=3, frequency_hz=1))
    observation, info = env.reset(seed=1)
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())

`gymnasium.make("pamctl/Muscle-v0", plant="paper")` makes the same one. The plant, its converters
and its noise are those of the simulated rig. There is no homing: the zeros are known.
Needs the package gymnasium: `pip install gymnasium`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hal.calibration import output_v, position_m, pressure_pa, quantise_v, valve_v
from hal.sim import SimSettings, sensed_counts, sensed_pressure_v, sensor_chain
from pamctl.base.errors import ExitCode
from pamctl.control.course import Course
from pamctl.control.experiment import ExperimentSettings, plan_experiment
from pamctl.kernel.calls import prepare
from pamctl.plant.model import plant_parameters
from pamctl.plant.parameters import vented_state
from pamctl.plant.simulated import OnTheWay, SimulatedPlant
from pamctl.session.experiment_form import FORMS, ExperimentForm
from pamctl.session.pamctl_error import PamctlError, require_package, translate_errors
from pamctl.session.simulated_rig import AskedSection, resolve_session
from pamctl.signals import Reference

if TYPE_CHECKING:
    import gymnasium

    from pamctl.plant.model import PlantSettings
else:
    gymnasium = require_package("gymnasium")

Observation = NDArray[np.float32]

OBSERVED = (
    "position_mm",
    "pressure_kpa",
    "reference_mm",
    "reference_velocity_mm_per_s",
    "reference_next_mm",
    "valve_v",
)
"""The observation: two sensor readings (absolute pressure), three numbers of the reference, the
last now and at the next step, and the last valve command."""
_HIGHEST = np.array([1e3, 1e4, 1e3, 1e5, 1e3, 10.0], dtype=np.float32)
FULL_V = 5.0
"""The valve command of an action of 1; positive fills."""
TRIP_REWARD = -100.0
MM, KPA = 1e3, 1e-3


class MuscleEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """The muscle follows a reference; the reward of a step is minus the error's size in mm.

    The action is the valve command over 5 V, shape (1,), held for `step_s`. The episode is
    truncated at the end of the reference, and terminated beyond the rig's limits of stroke or
    pressure, with a reward of -100 more. `info` holds `error_m` and `t_s`.
    """

    metadata = {"render_modes": []}  # noqa: RUF012  (the name and form that gymnasium demands)

    def __init__(
        self,
        plant: AskedSection | PlantSettings = "paper",
        reference: ExperimentForm | None = None,
        *,
        step_s: float = 0.01,
        duration_s: float = 10.0,
        overrides: tuple[str, ...] = (),
        render_mode: str | None = None,
    ) -> None:
        """`plant` and `overrides` are those of `pamctl.simulate`.

        Without a `reference`, each episode draws another random motion of `duration_s` up to 1 Hz.
        `step_s` is a whole number of the loop's periods. Raises `PamctlError`.
        """
        with translate_errors():
            settings, _ = resolve_session(plant, "qsmc", "sim", 0, overrides)
        rig = settings.rig
        self._period_s = 1.0 / rig.loop.rate_hz
        self._ticks = round(step_s / self._period_s)
        if self._ticks < 1 or not math.isclose(self._ticks * self._period_s, step_s):
            fix = f"give a multiple of the period of {self._period_s:g} s"
            raise PamctlError(f"step_s {step_s:g} is no number of ticks; {fix}", ExitCode.USAGE)
        self.render_mode = render_mode
        self._plant = SimulatedPlant(plant_parameters(settings.plant), prepare=prepare)
        assert isinstance(rig.device_settings, SimSettings)
        self._chain = sensor_chain(rig.device_settings, rig.calibration)
        zero = self._chain.zero
        self._homed = zero._replace(encoder_zero_counts=float(math.floor(zero.encoder_zero_counts)))
        self._stroke_m = (rig.limits.stroke_low_mm / MM, rig.limits.stroke_high_mm / MM)
        self._limit_pa = rig.limits.pressure_pa
        self._reference, self._duration_s = reference, duration_s
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = gymnasium.spaces.Box(-_HIGHEST, _HIGHEST, dtype=np.float32)

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin with the vented muscle at rest; `seed` is of the noise and the drawn reference."""
        super().reset(seed=seed)
        self._course = _plan_course(self._reference or self._draw_reference())
        self._step, self._valve_v = 0, 0.0
        self._plant.put(vented_state(self._plant.parameters), OnTheWay())
        self._measure()
        self._now = _require_reference(self._course.at(0.0))
        self._next = self._course.at(self._step_s)
        return self._observe()

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Hold the valve command for a step; return what is measured at its end."""
        asked_v = FULL_V * min(1.0, max(-1.0, float(np.asarray(action).reshape(-1)[0])))
        self._valve_v = self._output(asked_v)
        self._plant.advance(self._valve_v, self._step_s)
        self._measure()
        self._step += 1
        ahead = self._next
        if ahead is not None:
            self._now, self._next = ahead, self._course.at((self._step + 1) * self._step_s)
        observation, info = self._observe()
        low_m, high_m = self._stroke_m
        is_inside = low_m <= self._read_m <= high_m and self._read_pa <= self._limit_pa
        reward = -abs(info["error_m"]) * MM + (0.0 if is_inside else TRIP_REWARD)
        return observation, reward, not is_inside, is_inside and self._next is None, info

    @property
    def _step_s(self) -> float:
        return self._ticks * self._period_s

    def _draw_reference(self) -> ExperimentForm:
        seed = int(self.np_random.integers(1 << 31))
        drawn: ExperimentForm = FORMS["random"](
            offset_mm=11.8, amplitude_mm=5.0, high_hz=1.0, duration_s=self._duration_s, seed=seed
        )
        return drawn

    def _output(self, asked_v: float) -> float:
        """Return the valve command that the output's converter realises."""
        chain = self._chain
        volts = quantise_v(chain.output_converter, output_v(chain.calibration, asked_v))
        return valve_v(chain.calibration, volts)

    def _observe(self) -> tuple[Observation, dict[str, Any]]:
        now = self._now
        ahead_m = now.reference_m if self._next is None else self._next.reference_m
        observation = np.array(
            [
                self._read_m * MM,
                self._read_pa * KPA,
                now.reference_m * MM,
                now.reference_velocity_m_per_s * MM,
                ahead_m * MM,
                self._valve_v,
            ],
            dtype=np.float32,
        )
        info = {"error_m": self._read_m - now.reference_m, "t_s": self._step * self._step_s}
        return np.clip(observation, -_HIGHEST, _HIGHEST), info

    def _measure(self) -> None:
        """Read the sensors as the homed rig does."""
        chain, noise = self._chain, float(self.np_random.standard_normal())
        counts = sensed_counts(chain, self._plant.position_m)
        sensor_v = sensed_pressure_v(chain, self._plant.pressure_pa, noise)
        self._read_m = position_m(chain.calibration, self._homed, counts)
        self._read_pa = pressure_pa(chain.calibration, self._homed, sensor_v)


def _plan_course(reference: ExperimentForm) -> Course:
    from pydantic import TypeAdapter

    adapter: TypeAdapter[Any] = TypeAdapter(ExperimentSettings)
    plan = plan_experiment(adapter.validate_python(reference.to_data()))
    return Course(plan.segments, None, plan.cues)


def _require_reference(reference: Reference | None) -> Reference:
    """Refuse an experiment of the valve: there is nothing to follow."""
    if reference is None or math.isnan(reference.reference_m):
        fix = "give a motion of the muscle, such as pamctl.Sine"
        raise PamctlError(f"this reference moves the valve; {fix}", ExitCode.USAGE)
    return reference


gymnasium.register("pamctl/Muscle-v0", entry_point="pamctl.session.gym:MuscleEnv")
