"""The backend over the real libcomedi, where it is installed, above a kernel that is not there.

The stand-in of the library holds the backend to a reading of the library. This holds it to the
library itself: its structures, its results, its parser of calibration files.
"""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from standin.standin import KERNEL_SONAME, Card, library, require_compiler
from support.command_line import run_process
from support.installing import alone, apt_install

from hal.comedi import libcomedi

DRIVE = """
import json, sys, time
from hal.comedi.comedi_rig import ComediRig
from hal.comedi.comedi_backend import ComediSettings
from hal.rig import RigError, open_rig

settings = ComediSettings(calibration_file=sys.argv[1])
rig, second = (ComediRig(settings, safe_output_v=1.25) for _ in range(2))
with open_rig(rig):
    told = {"extra": rig.describe().extra, "vented_v": rig.read().pressure_v}
    told["applied_v"] = rig.write(7.0)
    time.sleep(0.3)
    told["counts"] = rig.read().encoder_counts
    try:
        second.open()
    except RigError as error:
        told["refused"] = error.code
    second.make_safe()
    told["left_to_the_owner"] = second.safe_failure.code
try:
    ComediRig(ComediSettings(), safe_output_v=1.25).open()
except RigError as error:
    told["uncalibrated"] = str(error)
print(json.dumps(told))
"""


def has_libcomedi() -> bool:
    loads = f"import ctypes; ctypes.CDLL({libcomedi.SONAME!r})"
    done = subprocess.run([sys.executable, "-c", loads], capture_output=True, timeout=60)
    return done.returncode == 0


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """What lets a process drive a card of its own through the real library."""
    if not has_libcomedi():
        with alone():
            apt_install("libcomedi0")
    if not has_libcomedi():
        pytest.skip("no libcomedi on this computer: apt install libcomedi0")
    require_compiler()
    card = Card(tmp_path / "registers", "comedi0")
    card.registers.ai_gain, card.registers.ao_gain = 0.95, 0.98
    card.calibrate()
    return {
        **os.environ,
        "LD_PRELOAD": str(library(KERNEL_SONAME)),
        "STANDIN_DEVICE": str(card.path),
        "PAMCTL_PERMIT_STAND_IN": "1",
        "PYTHONPATH": os.pathsep.join(sys.path),
    }


def test_the_rig_works_through_the_real_library(
    environment: dict[str, str], tmp_path: Path
) -> None:
    done = run_process(
        [sys.executable, "-c", DRIVE, str(tmp_path / "registers.calibration")], env=environment
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout.splitlines()[-1])
    extra = told["extra"]
    assert Path(extra["library"]).parent != library(KERNEL_SONAME).parent
    assert (extra["driver_name"], extra["product_type"]) == ("stand_in", "pci-6221")
    assert extra["driver_version"] == "0.7.76"
    assert extra["reads_in_one_call"]
    assert extra["input_volts_coefficients"][1] == pytest.approx(10.0 / 65536.0 / 0.95)
    assert extra["output_code_coefficients"][1] == pytest.approx(65536.0 / 20.0 / 0.98)
    assert told["vented_v"] == pytest.approx(0.215, abs=3e-4)
    assert told["applied_v"] == pytest.approx(7.0, abs=3e-4)
    assert told["counts"] > 1000
    assert told["refused"] == errno.EBUSY
    assert told["left_to_the_owner"] == errno.EACCES
    assert "/var/lib/comedi/calibrations/stand_in_pci-6221_comedi0" in told["uncalibrated"]
