"""Effects of an outside package: one file each, and pamctl does not contain their names."""

import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest
from support.command_line import run_process

import pamctl

pytestmark = pytest.mark.long

FRICTION_SLOPE = '''
"""The braid rubs harder where the muscle is contracted."""

from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, EffectEntry, size
from pamctl.plant.effects.places import FrictionBand


class FrictionSlope(NamedTuple):
    """Rise of dry friction with displacement."""

    per_m: float = 0.0


def raise_friction(slope: FrictionSlope, band: FrictionBand, position_m: float) -> FrictionBand:
    factor = rise_at(slope, position_m)
    return FrictionBand(factor * band.lower_n, factor * band.upper_n)


def rise_at(slope: FrictionSlope, position_m: float) -> float:
    return 1.0 + slope.per_m * position_m


DESCRIPTION = EffectDescription(
    name="friction_slope",
    kind=FrictionSlope,
    block="mechanics",
    equation="f_lim (1 + r x)",
    parameters=(size("per_m", "1/m", 60.0, smallest=1.0, start=5.0, meaning="r"),),
    signature="an error while contracting that grows with the displacement",
    best_experiment="square-0.5",
    seen_by=("mechanics",),
    entries=(EffectEntry("friction", raise_friction, after=("coulomb_friction",)),),
)
'''
COIL_LAG = '''
"""The valve's coil follows its command late."""

from math import exp
from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, EffectEntry, EffectMemory, size


class CoilLag(NamedTuple):
    time_constant_s: float = 0.0


class Coil(NamedTuple):
    command_v: float


def start(position_m: float, pressure_pa: float) -> Coil:
    return Coil(0.0)


def follow(lag: CoilLag, memory: Coil, end: float, step_s: float) -> Coil:
    return Coil(end + (memory.command_v - end) * exp(-step_s / lag.time_constant_s))


def give(lag: CoilLag, memory: Coil) -> float:
    return memory.command_v


DESCRIPTION = EffectDescription(
    name="coil_lag",
    kind=CoilLag,
    block="pressure",
    equation="tau i' + i = u",
    parameters=(size("time_constant_s", "s", 0.02, smallest=2e-4, start=1e-3, meaning="tau"),),
    signature="after every step of the command",
    best_experiment="chirp",
    seen_by=("pressure",),
    entries=(EffectEntry("command", give, memory=EffectMemory(start, follow)),),
)
'''
ENTRY_POINTS = """[pamctl.effects]
friction_slope = friction_slope:DESCRIPTION
coil_lag = coil_lag
broken = no_such_module
"""
PLANT_FILE = "effects: {friction_slope: {per_m: 12.0}, coil_lag: {time_constant_s: 3.0e-3}}\n"

USE = """
import json, sys, warnings
from types import SimpleNamespace
with warnings.catch_warnings(record=True) as warned:
    warnings.simplefilter("always")
    import pamctl.plant.catalogue
import numpy as np
from pamctl.diagnose import diagnose
from pamctl.plant import drive
from pamctl.plant.parameters import parameters_of
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.settings.resolve import resolve
from support.made_records import ask_only, pair

command_v = np.repeat([5.0, -5.0, 0.6, -0.4], 120)
paper = parameters_of({})
on = plant_parameters(resolve(plant="mine.yaml").plant)
every_part = dict(valve_acts=True, air_acts=True, mechanics_act=True, sensors_act=True)
driven = {
    "paper": drive.drive_coupled(paper, command_v, 1e-3),
    "neutral": drive.drive_coupled(paper._replace(**every_part), command_v, 1e-3),
    "on": drive.drive_coupled(on, command_v, 1e-3),
    "slope": drive.drive_coupled(parameters_of({"friction_slope.per_m": 12.0}), command_v, 1e-3),
    "coil": drive.drive_coupled(parameters_of({"coil_lag.time_constant_s": 3e-3}), command_v, 1e-3),
}
machine = drive.machine
drive.machine = lambda kernel: SimpleNamespace(fill_until_it_fails=kernel)
plain = drive.drive_coupled(on, command_v, 1e-3)
drive.machine = machine
hidden = {"friction_slope.per_m": 12.0}
found = diagnose(*pair(**hidden), PlantSettings(), without=ask_only("friction_slope", "stribeck"))
print(json.dumps({
    "warned": [str(w.message) for w in warned],
    "position_m": {k: v.position_m.tolist() for k, v in driven.items()},
    "twins_agree": np.array_equal(np.array(plain), np.array(driven["on"])),
    "verdict": found.verdict.value,
    "named": {f.name: [j.hypothesis.name for j in f.judged] for f in found.findings},
    "fitted": {n.name: n.value for n in found.numbers},
    "plant": found.plant.model_dump()["effects"]["friction_slope"],
}))
"""


@pytest.fixture(scope="module")
def used(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What a process finds that has the package on its path."""
    site = tmp_path_factory.mktemp("site")
    (site / "friction_slope.py").write_text(FRICTION_SLOPE)
    (site / "coil_lag.py").write_text(COIL_LAG)
    info = site / "rig_of_ours-0.3.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: rig-of-ours\nVersion: 0.3\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    (site / "mine.yaml").write_text(PLANT_FILE)
    house = Path(pamctl.__file__).parents[1]
    paths = [str(site), str(house), str(house / "tests")]
    run = run_process(
        [sys.executable, "-c", USE],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        cwd=site,
    )
    assert run.returncode == 0, run.stderr
    found: dict[str, Any] = json.loads(run.stdout)
    return found


def test_outside_effects_at_neutral_values_do_not_change_the_papers_model(used):
    assert used["position_m"]["neutral"] == used["position_m"]["paper"]


def test_outside_effects_in_a_plant_file_agree_compiled_and_plain(used):
    assert used["twins_agree"]
    paper, slope, coil, on = (used["position_m"][name] for name in ("paper", "slope", "coil", "on"))
    assert max(paper) - max(slope) > 0.3e-3
    risen = [next(i for i, x in enumerate(xs) if x > 1e-3) for xs in (paper, coil)]
    assert 1 <= risen[1] - risen[0] <= 8
    assert on not in (slope, coil)


def test_diagnose_names_a_hidden_outside_effect(used):
    assert used["verdict"] == "named"
    assert [*used["named"]] == ["friction_slope"]
    assert "stribeck" in used["named"]["friction_slope"]
    assert used["fitted"]["friction_slope.per_m"] == pytest.approx(12.0, rel=0.05)
    assert used["plant"]["per_m"] == pytest.approx(12.0, rel=0.05)


def test_a_broken_outside_effect_is_left_out_with_the_name_of_its_package(used):
    (warning,) = used["warned"]
    assert warning.startswith("effect broken of rig-of-ours 0.3 is left out: no_such_module: ")
