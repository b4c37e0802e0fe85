"""The Gymnasium environment: valid by its own checker, and the simulated rig's own motion."""

import warnings

import numpy as np
import pytest

import pamctl

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.utils.env_checker import check_env  # noqa: E402

from hal.calibration import valve_v  # noqa: E402
from pamctl.plant.model import plant_parameters  # noqa: E402
from pamctl.plant.simulated import SimulatedPlant  # noqa: E402
from pamctl.session.gym import MuscleEnv  # noqa: E402
from pamctl.settings.resolve import resolve  # noqa: E402

SINE = pamctl.Sine(offset_mm=10, amplitude_mm=3, frequency_hz=1, cycles=2)


def test_it_passes_gymnasiums_own_checker():
    with warnings.catch_warnings():
        # It cannot try another way of drawing, as there is none.
        warnings.filterwarnings("ignore", message=".*render.*")
        check_env(gymnasium.make("pamctl/Muscle-v0", reference=SINE).unwrapped)


@pytest.mark.parametrize("delay_s", [0.0, 0.0035])
def test_its_muscle_moves_as_the_simulated_rigs_plant(delay_s):
    """Plain Python's plant, tick by tick, is the other side; the encoder has steps of 3.2 um."""
    effects = {"command_delay": {"delay_s": delay_s}} if delay_s else {}
    keys = {"base": "paper", "effects": effects}
    env = MuscleEnv(keys, SINE, overrides=("rig.sim.sensor_noise_v=0",))
    settings = resolve()
    model = type(settings.plant).model_validate(keys)
    plant = SimulatedPlant(plant_parameters(model))
    env.reset(seed=1)
    for step in range(60):
        share = 0.6 * np.sin(0.3 * step)
        observation, *_ = env.step(np.array([share], np.float32))
        for _ in range(10):
            plant.advance(float(observation[5]), 1e-3)
        assert observation[0] == pytest.approx(plant.position_m * 1e3, abs=2 * 3.2e-3)
        assert observation[1] == pytest.approx(plant.pressure_pa * 1e-3, abs=0.5)
        assert observation[5] == pytest.approx(5.0 * share, abs=1e-3)
    assert plant.position_m > 1e-3


def test_an_episode_ends_with_its_reference_and_seeds_repeat_it():
    env = MuscleEnv(duration_s=0.5)
    courses = []
    for seed in (1, 1, 2):
        seen, _ = env.reset(seed=seed)
        rewards, references = [], [seen[2]]
        while True:
            seen, reward, terminated, truncated, info = env.step(np.zeros(1, np.float32))
            assert reward == pytest.approx(-abs(info["error_m"]) * 1e3)
            rewards.append(reward)
            references.append(seen[2])
            if terminated or truncated:
                break
        assert truncated
        assert not terminated
        courses.append((rewards, references))
    assert courses[0] == courses[1]
    assert courses[0][1] != courses[2][1]


def test_beyond_the_stroke_the_episode_is_over():
    env = MuscleEnv(reference=SINE, overrides=("rig.limits.stroke_high_mm=5",))
    env.reset(seed=1)
    for _ in range(1000):
        *_, reward, terminated, truncated, _ = env.step(np.ones(1, np.float32))
        if terminated:
            break
    assert terminated
    assert not truncated
    assert reward < -100


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"reference": pamctl.ValveSine(amplitude_v=1, frequency_hz=1)}, "moves the valve"),
        ({"step_s": 0.0015}, "is no number of ticks"),
        ({"plant": "papr"}, "did you mean 'paper'"),
    ],
)
def test_what_cannot_be_learnt_on_is_refused(options, line):
    with pytest.raises(pamctl.PamctlError, match=line):
        MuscleEnv(**options).reset()  # type: ignore[arg-type]


def test_the_valve_command_is_what_the_converter_can_output():
    env = MuscleEnv(reference=SINE)
    env.reset(seed=0)
    observation, *_ = env.step(np.array([0.123456], np.float32))
    one_step_v = abs(
        valve_v(env._chain.calibration, 20 / 65536) - valve_v(env._chain.calibration, 0)
    )
    assert abs(observation[5] - 5 * 0.123456) <= 0.51 * one_step_v
