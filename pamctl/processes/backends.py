"""The composition root: settings in, the parts of a run out.

A backend is reached here through its record (`hal/backend.py`), and never by its name.
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from hal.backend import BuiltRig, RigRequest
from hal.reservation import hold_reservation
from hal.rig import Rig, RigError
from pamctl.realtime.clock import Clock, GridClock, SampleClock, VirtualClock
from pamctl.signals import Truth

if TYPE_CHECKING:
    from hal.backend import Plant
    from pamctl.plant.simulated import SimulatedPlant
    from pamctl.settings.resolve import RunSettings
    from pamctl.settings.rig_file import RigFile

SHARED_MEMORY = Path(os.environ.get("PAMCTL_SHARED_MEMORY", "/dev/shm"))
"""Where rings, simulated outputs and the locks of devices lie: gone with the next boot.

All runs of a PC share one place, so that they see each other's locks. Tests use another place.
"""

_FEWEST_OPEN_FILES = 32
_MOST_OPEN_FILES = 4096
_UNKNOWN = Truth(math.nan, math.nan)


class RigParts(NamedTuple):
    """What a backend brings."""

    rig: Rig
    clock: Clock
    """What paces the loop: the rig itself where its hardware does."""
    truth: Callable[[], Truth]
    """The plant's true state where it is simulated; NaN where it is real."""


def build_clock(settings: RunSettings, *, may_spin: bool) -> Clock:
    """Return the clock of the computer, which paces the run unless the rig does."""
    loop = settings.rig.loop
    period_ns = round(1e9 / loop.rate_hz)
    if settings.fast:
        return VirtualClock(period_ns)
    return GridClock(period_ns, spin_ns=round(loop.spin_us * 1e3) if may_spin else 0)


def require_open_files() -> None:
    """Raise this process's limit of open files to what a run may need; raise `RigError`.

    A process that cannot open a pipe half-way through a start could not end it in good order.
    """
    if sys.platform != "linux":
        return
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or soft >= _MOST_OPEN_FILES:
        return
    most = _MOST_OPEN_FILES if hard == resource.RLIM_INFINITY else min(hard, _MOST_OPEN_FILES)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
    if most < _FEWEST_OPEN_FILES:
        raise RigError(
            f"this process may open only {most} files, and a run needs {_FEWEST_OPEN_FILES}; "
            f"raise the limit with `ulimit -n {_MOST_OPEN_FILES}`"
        )


def require_backend(rig: RigFile) -> None:
    """Load what the backend needs; raise `RigError` where driver or device is missing."""
    rig.record.require(rig.device_settings)


def build_rig(
    settings: RunSettings,
    clock: Clock,
    *,
    by_computer: bool = False,
    plant: SimulatedPlant | None = None,
) -> RigParts:
    """Return the rig, not yet opened; `by_computer`: paced by `clock` whatever the file says.

    A simulated rig moves `plant`, by default one in plain Python.
    """
    from hal.faulty import FaultyRig
    from pamctl.plant.model import plant_parameters
    from pamctl.plant.simulated import SimulatedPlant

    file = settings.rig
    plant = plant or SimulatedPlant(plant_parameters(settings.plant))
    built = _build(file, clock.now_ns, plant, settings.seed, settings.fast, by_computer)
    rig = FaultyRig(built.rig, file.faults_to_inject) if file.faults_to_inject else built.rig
    pace = clock if built.await_edge is None else SampleClock(clock, built.await_edge)
    if file.record.is_simulated:
        return RigParts(rig, pace, lambda: Truth(*plant.truth))
    return RigParts(rig, pace, lambda: _UNKNOWN)


def build_safe_rig(file: RigFile) -> Rig:
    """Return a rig that is made safe and never opened: guardians need no plant for that."""
    return _build(file, time.monotonic_ns, _Nothing()).rig


class _Nothing:
    """What a rig moves that nobody opens."""

    position_m = pressure_pa = math.nan

    def advance(self, command_v: float, duration_s: float) -> None:
        pass


def _build(
    file: RigFile,
    now_ns: Callable[[], int],
    plant: Plant,
    seed: int = 0,
    is_private: bool = False,
    by_computer: bool = False,
) -> BuiltRig:
    return file.record.build(
        RigRequest(
            settings=file.device_settings,
            calibration=file.calibration,
            safe_volts=file.safe_volts,
            rate_hz=file.loop.rate_hz,
            now_ns=now_ns,
            plant=plant,
            seed=seed,
            output_file=None if is_private else ao_path(device_of(file)),
            by_computer=by_computer,
        )
    )


def ao_path(device: str) -> Path:
    """Return where the output of a simulated device lies in real time."""
    return SHARED_MEMORY / f"pamctl-{device}.ao"


def device_of(rig: RigFile) -> str:
    """Return the name of the device that a run needs for itself."""
    return rig.record.device(rig.device_settings)


@contextmanager
def secure_device(file: RigFile) -> Iterator[Rig]:
    """Hold the device within the block, and make it safe before anything else is done.

    The run before may have died with the valve open. The rig is not opened. Raises `RigError`
    where the device cannot be had.
    """
    rig = build_safe_rig(file)
    with hold_device(file):
        rig.make_safe()
        if rig.safe_failure is not None:
            raise rig.safe_failure
        yield rig


@contextmanager
def hold_device(rig: RigFile) -> Iterator[None]:
    """Hold the device of a rig within the block; raise `RigError` if another process does."""
    device = device_of(rig)
    with hold_reservation(SHARED_MEMORY / f"pamctl-{device}.lock", device):
        yield


def new_ring_path() -> Path:
    """Return a new name in shared memory; the next start looks there for runs that died."""
    return SHARED_MEMORY / f"pamctl-{os.getpid()}-{time.time_ns()}.ring"


def make_plant(settings: RunSettings) -> SimulatedPlant | None:
    """Return the plant of a simulated rig as machine code; None where the clock does not wait."""
    if settings.fast or not settings.rig.record.is_simulated:
        return None
    from pamctl.kernel.calls import prepare
    from pamctl.plant.model import plant_parameters
    from pamctl.plant.simulated import SimulatedPlant

    return SimulatedPlant(plant_parameters(settings.plant), prepare=prepare)
