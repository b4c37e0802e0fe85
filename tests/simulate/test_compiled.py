"""The machine-code twins of the kernels give the same values, and are never stale.

That whole runs are the same to the bit: `test_closed_loop.py`.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import pytest

import pamctl.compiled
from pamctl.compiled import compile_kernel
from pamctl.control.filters import LowPass, low_pass, prime_filter
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.paper.valve import orifice_flow, valve_flow


def test_a_twin_returns_the_kernels_own_values_and_types() -> None:
    found = compile_kernel(low_pass)(prime_filter(0.3), 0.1, 1.0)
    assert found == low_pass(prime_filter(0.3), 0.1, 1.0)
    assert type(found[1]) is LowPass


def test_a_kernel_has_one_twin() -> None:
    assert compile_kernel(low_pass) is compile_kernel(low_pass)


def test_a_kernel_that_another_one_calls_can_be_called_from_python_too() -> None:
    """The cache keeps both kinds of its code apart."""
    p = plant_parameters(PlantSettings()).paper
    for kernel in (valve_flow, orifice_flow):
        assert compile_kernel(kernel)(p, 2.0, 2e5) == kernel(p, 2.0, 2e5)


def test_a_twin_raises_where_the_kernel_does() -> None:
    """Numba's default would be a silent infinity."""
    p = plant_parameters(PlantSettings())
    for flow in (orifice_flow, compile_kernel(orifice_flow)):
        with pytest.raises(ZeroDivisionError):
            flow(p.paper, 0.0, 1e5)


def test_compiling_does_not_change_the_plain_function() -> None:
    before = valve_flow.__globals__["orifice_flow"]
    compile_kernel(valve_flow)
    assert valve_flow.__globals__["orifice_flow"] is before
    assert type(before).__name__ == "function"


# --- the cache --------------------------------------------------------------------------------

PACKAGE = Path(pamctl.compiled.__file__).parent


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A copy of all our sources."""
    only_sources = shutil.ignore_patterns("__pycache__")
    shutil.copytree(PACKAGE, tmp_path / "pamctl", ignore=only_sources)
    shutil.copytree(PACKAGE.parent / "hal", tmp_path / "hal", ignore=only_sources)
    return tmp_path


def digest(checkout: Path) -> str:
    """What a copy's own `compiled.py` says of the sources of the closed loop with qSMC."""
    spec = importlib.util.spec_from_file_location(
        "compiled_of_a_copy", checkout / "pamctl" / "compiled.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return str(module.hash_sources("pamctl.simulate.closed_loop", "pamctl.control.qsmc"))


def test_the_cache_is_keyed_by_every_source_that_a_kernel_can_depend_on(checkout: Path) -> None:
    """Kernels call each other across files: numba by itself would keep a caller's stale code."""
    unchanged = digest(checkout)
    assert unchanged == digest(checkout)
    seen = {unchanged}
    for changed in (
        "pamctl/plant/paper/valve.py",
        "pamctl/plant/effects/valve/valve_spool.py",
        "pamctl/control/qsmc.py",
        "hal/calibration.py",
    ):
        with (checkout / changed).open("a") as source:
            source.write("# another line\n")
        seen.add(digest(checkout))
    assert len(seen) == 5


def test_sources_that_no_kernel_uses_do_not_change_the_cache(checkout: Path) -> None:
    before = digest(checkout)
    for changed in ("pamctl/cli/rig/run.py", "pamctl/log/writer.py"):
        with (checkout / changed).open("a") as source:
            source.write("# another line\n")
    assert digest(checkout) == before


class Compiled(NamedTuple):
    risen_pa: float
    compiled_now: int


ONE_STEP = """
from pamctl.compiled import compile_kernel
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.paper.pressure import pressure_step

p = plant_parameters(PlantSettings()).paper
twin = compile_kernel(pressure_step)
pressure_pa = begin_pa = p.atmospheric_pressure_pa
for _ in range(50):
    pressure_pa = twin(p, pressure_pa, pressure_pa, 1.0, 0.0, 0.0, 0.5e-3)
print(pressure_pa - begin_pa, sum(twin.stats.cache_misses.values()))
"""


def one_step(checkout: Path, cache: Path) -> Compiled:
    """Fill the muscle for 25 ms in a process of its own."""
    run = subprocess.run(
        [sys.executable, "-c", ONE_STEP],
        env={**os.environ, "XDG_CACHE_HOME": str(cache), "PYTHONPATH": str(checkout)},
        cwd=checkout,
        capture_output=True,
        text=True,
        check=True,
    )
    risen_pa, misses = run.stdout.split()
    return Compiled(float(risen_pa), int(misses))


@pytest.mark.long
def test_the_next_process_finds_the_machine_code_unless_a_called_kernel_changed(
    checkout: Path, tmp_path: Path
) -> None:
    cache = tmp_path / "cache"
    first = one_step(checkout, cache)
    again = one_step(checkout, cache)
    assert (first.compiled_now, again.compiled_now) == (1, 0)
    assert again.risen_pa == first.risen_pa
    assert {folder.name[:8] for folder in (cache / "pamctl").iterdir()} == {"kernels-"}

    # `pressure_step` is in pressure.py, which stays as it is.
    valve = checkout / "pamctl" / "plant" / "paper" / "valve.py"
    half = valve.read_text().replace("p.valve_gain_m2_per_v * abs(", "0.5 * abs(1e-6 * ")
    assert half != valve.read_text()
    valve.write_text(half)
    after = one_step(checkout, cache)
    assert after.compiled_now == 1
    assert 0.0 < after.risen_pa < 0.8 * first.risen_pa


# --- who must do without ------------------------------------------------------------------------


def test_the_loop_process_imports_nothing_heavy() -> None:
    """It starts fast, and no page fault of compiled code can delay a tick."""
    heavy = {"numba", "llvmlite", "scipy", "numpy", "nidaqmx", "mcap", "matplotlib"}
    code = f"import sys, pamctl.processes.loop_main; print(sorted({heavy} & sys.modules.keys()))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def test_a_new_version_removes_the_machine_code_that_nobody_ran_for_a_month(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    old, recent, other = (
        tmp_path / "pamctl" / name for name in ("kernels-a", "kernels-b", "ahead")
    )
    for folder, age_days in ((old, 31), (recent, 29), (other, 400)):
        folder.mkdir(parents=True)
        (folder / "kernel.nbc").write_bytes(b"code")
        used_s = time.time() - age_days * 86_400
        os.utime(folder, (used_s, used_s))
    find_cache = pamctl.compiled._find_cache.__wrapped__
    assert find_cache("b") == recent  # known: marked as used, nothing is removed
    assert old.is_dir()
    find_cache("c")
    assert not old.exists()
    assert recent.is_dir()
    assert other.is_dir()
