"""The simulated output in shared memory: it outlives its owner, as a card's does."""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from support.patience import await_true
from support.runs import AO_STEP_V

from hal.rig import RigError, open_rig
from hal.sim import SharedRegister, SimRig, SimSettings, peek_v, sensor_chain
from pamctl.plant.model import plant_parameters
from pamctl.plant.simulated import SimulatedPlant
from pamctl.processes.backends import ao_path, build_clock, build_rig
from pamctl.settings.resolve import resolve


def shared_rig(path: Path) -> SimRig:
    settings = resolve(fast=True)
    return SimRig(
        SimulatedPlant(plant_parameters(settings.plant)),
        sensor_chain(SimSettings(), settings.rig.calibration),
        safe_output_v=1.25,
        now_ns=time.monotonic_ns,
        register=SharedRegister(path, "bench0"),
    )


def test_an_output_holds_its_voltage_after_its_owner_and_can_then_be_made_safe(tmp_path):
    path = tmp_path / "bench0.ao"
    owner = (
        "import sys, time; sys.path.insert(0, sys.argv[2])\n"
        "from pathlib import Path; from test_shared_output import shared_rig\n"
        "rig = shared_rig(Path(sys.argv[1])); rig.open(); rig.write(8.0)\n"
        "print('there', flush=True); time.sleep(60)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", owner, path, Path(__file__).parents[1]],
        stdout=subprocess.PIPE,
        cwd=Path(__file__).parent,
    ) as process:
        assert process.stdout
        process.stdout.readline()
        rig = shared_rig(path)
        with pytest.raises(RigError, match=f"bench0 is held by process {process.pid}"):
            rig.open()
        rig.make_safe()
        assert f"process {process.pid}" in str(rig.safe_failure)
        process.kill()
    assert peek_v(path) == pytest.approx(8.0, abs=AO_STEP_V)
    rig.make_safe()
    assert rig.safe_failure is None
    assert peek_v(path) == pytest.approx(1.25, abs=AO_STEP_V)


def test_the_output_of_another_process_moves_the_muscle(tmp_path):
    path = tmp_path / "bench0.ao"
    with open_rig(shared_rig(path)) as rig:
        rig.write(5.0)
        at_rest = rig.read().encoder_counts
        np.memmap(path, dtype=float, mode="r+", shape=(1,))[0] = 10.0
        await_true(lambda: rig.read().encoder_counts != at_rest, "the muscle does not fill", 0.0)
    assert peek_v(path) == pytest.approx(1.25, abs=AO_STEP_V)


def test_a_run_without_a_clock_has_no_shared_output():
    settings = resolve(fast=True, overrides=["rig.sim.device=never0"])
    with open_rig(build_rig(settings, build_clock(settings, may_spin=False)).rig):
        assert not ao_path("never0").exists()
