"""Numbers at the edge of what a float holds are refused where they are written, or do no harm."""

import os
from collections.abc import Iterator
from copy import deepcopy
from itertools import product
from typing import Any

import pytest
from support.command_line import run_pamctl

from hal.calibration import CalibrationSettings
from hal.rig import RigError
from hal.sim import SimRig, SimSettings, sensor_chain
from pamctl.base.errors import ConfigError
from pamctl.processes.backends import SHARED_MEMORY
from pamctl.settings import envelope
from pamctl.settings.build import build_program, build_tick_setup
from pamctl.settings.envelope import find_excesses
from pamctl.settings.resolve import RUN, RawSettings, resolve, settings_to_data, validate_settings

EDGES = ("1e-320", "1e308", "-1e308", "-0.0", ".nan", "99999999999999999999")
PLANTS = {"plant": ("paper", "paper-valve109")}
CONTROLLERS = {"controller": ("qsmc", "smc", "pid")}
RIGS = {"rig": ("sim", "pci6221", "pci6221-comedi")}
EXPERIMENTS = {"experiment": ("tracking-2", "sine", "diagnosis", "multisine", "ramps", "sequence")}


def numbers_in(data: Any, at: str) -> Iterator[str]:
    """Name every number of a resolved section; of list items of one form, the first's."""
    parts = data.items() if isinstance(data, dict) else first_of_each_form(data)
    for name, value in parts:
        if isinstance(value, dict | list):
            yield from numbers_in(value, f"{at}.{name}")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield f"{at}.{name}"


def first_of_each_form(parts: list[Any]) -> list[tuple[int, Any]]:
    """Return the place and the part that come first of each form: its fields have one model."""
    firsts: dict[Any, tuple[int, Any]] = {}
    for place, part in enumerate(parts):
        form: Any = type(part)
        if isinstance(part, dict):
            form = (part.get("kind"), part.get("wave"), *sorted(part))
        firsts.setdefault(form, (place, part))
    return list(firsts.values())


def shorten(data: Any) -> Any:
    """Let each part of a program last half a second at most: all of it is sampled."""
    if isinstance(data, list):
        return [shorten(item) for item in data]
    if not isinstance(data, dict):
        return data
    lasting = data.get("duration_s") if "wave" in data else None
    return {
        key: min(value, 0.5) if key == "duration_s" and lasting else shorten(value)
        for key, value in data.items()
    }


@pytest.mark.long
@pytest.mark.parametrize(
    "kinds", [PLANTS, CONTROLLERS, RIGS, EXPERIMENTS], ids=["plant", "controller", "rig", "motion"]
)
def test_every_number_of_every_section_is_refused_at_the_edge_or_can_be_used(kinds, monkeypatch):
    monkeypatch.setattr(envelope, "_MOST_SAMPLES", 200)  # each is computed alike
    ((section, names),) = kinds.items()
    seen: set[str] = set()
    for name in names:
        chosen: dict[str, Any] = {section: name}
        data = shorten(settings_to_data(resolve(**chosen)))
        # Files of one section share most of their models: a number is asked once.
        new = [key for key in numbers_in(data[section], section) if key not in seen]
        seen |= {*new} if section != "experiment" else set()
        for key, edge in product(new, EDGES):
            changed = RawSettings(deepcopy(data))
            try:
                changed.override(f"{key}={edge}")
                settings = validate_settings(RUN, changed)
            except ConfigError:
                continue
            build_tick_setup(settings)
            build_program(settings)
            find_excesses(settings)


@pytest.mark.parametrize(
    "change",
    [
        "plant.parameters.braid_turns=1e-320",
        "plant.parameters.braid_turns=1e308",
        "plant.parameters.gas_constant_j_per_kg_k=1e-320",
        "plant.parameters.damping_n_s_per_m=1e308",
        "plant.parameters.stiffness_n_per_m=1e308",
        "plant.effects.cubic_stiffness.n_per_m3=1e308",
        "rig.calibration.encoder_m_per_count=1e-320",
        "rig.calibration.driver_gain=1e-320",
        "rig.sim.output_full_scale_v=1e-320",
        "rig.limits.patience_s=1e308",
        "rig.limits.sample_age_s=1e308",
        "rig.limits.missed_ticks=1e308",
        "rig.limits.tracking_error_mm=1e308",
        "rig.limits.speed_mm_per_s=1e308",
        "rig.limits.slew_v_per_s=1e308",
        "rig.limits.pressure_model_pa=1e308",
        "rig.limits.pressure_model_memory_s=1e-320",
        "rig.limits.pressure_model_step_s=1e308",
        "controller.model.parameters.mass_kg=1e-320",
    ],
)
def test_a_number_that_breaks_the_model_or_switches_a_guard_off_is_refused_with_its_bound(
    change, tmp_path
):
    law = ("--controller", "smc") if change.startswith("controller") else ()
    log = tmp_path / "run.mcap"
    done = run_pamctl("run", "--fast", "--duration", 0.01, *law, "--set", change, "--log", log)
    assert done.returncode == 78, done.stderr
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith(f"--set {change}: ")
    assert "must be at " in line or "must be less " in line
    assert not log.exists()


class RunawayPlant:
    """A plant whose numbers leave what a float holds."""

    def __init__(self, pressure_pa: float, position_m: float, error: Exception | None) -> None:
        self.pressure_pa, self.position_m, self.error = pressure_pa, position_m, error

    def advance(self, command_v: float, duration_s: float) -> None:
        if self.error is not None:
            raise self.error


@pytest.mark.parametrize(
    "plant",
    [
        RunawayPlant(float("nan"), 0.0, None),
        RunawayPlant(1e5, float("inf"), None),
        RunawayPlant(1e5, 0.0, OverflowError("math range error")),
        RunawayPlant(1e5, 0.0, ValueError("math domain error")),
    ],
)
def test_a_simulated_plant_that_runs_away_is_an_error_of_the_rig(plant):
    now_ns = iter(range(0, 10**9, 10**6))
    chain = sensor_chain(SimSettings(), CalibrationSettings())
    rig = SimRig(plant, chain, safe_output_v=0.0, now_ns=lambda: next(now_ns))
    rig.open()
    with pytest.raises(RigError, match="left the range of numbers"):
        rig.read()
    rig.close()


@pytest.mark.parametrize("ending", ["lock", "ao"])
def test_a_pipe_where_a_device_is_locked_is_one_line_and_no_wait(ending, tmp_path):
    device = f"pipe{os.getpid()}"
    pipe = SHARED_MEMORY / f"pamctl-{device}.{ending}"
    os.mkfifo(pipe)
    try:
        change = ("--set", f"rig.sim.device={device}")
        done = run_pamctl("run", "--duration", 0.1, *change, "--log", tmp_path / "run.mcap")
    finally:
        for path in SHARED_MEMORY.glob(f"pamctl-{device}.*"):
            path.unlink()
    assert done.returncode == 69
    assert f"{pipe}: it is not a regular file" in done.stderr
    assert "Traceback" not in done.stderr
