"""The composition root: settings in, the parts of a run out. Backends are chosen here only."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from hal.faulty import FaultyRig
from hal.rig import Rig, RigError
from hal.sim.register import SharedRegister
from hal.sim.sim_rig import SimRig, sensor_chain
from pamctl.plant.model import plant_parameters
from pamctl.plant.simulated import SimulatedPlant
from pamctl.realtime.clock import Clock, GridClock, SampleClock, VirtualClock
from pamctl.settings.resolve import RunSettings
from pamctl.settings.rig_file import NidaqRigSettings, SimRigSettings
from pamctl.signals import Truth

SHARED_MEMORY = Path(os.environ.get("PAMCTL_SHARED_MEMORY", "/dev/shm"))
"""Where rings, simulated outputs and the locks of devices lie: gone with the next boot.

All of a PC's runs share one place, or they would not see each other's locks; tests have others.
"""

_UNKNOWN = Truth(math.nan, math.nan)


class RigParts(NamedTuple):
    """What a backend brings."""

    rig: Rig
    clock: Clock
    """What paces the loop: the rig itself where its hardware does."""
    truth: Callable[[], Truth]


def build_clock(settings: RunSettings, *, may_spin: bool) -> Clock:
    """Return the clock of the computer, which paces the run unless the rig does."""
    loop = settings.rig.loop
    period_ns = round(1e9 / loop.rate_hz)
    if settings.fast:
        return VirtualClock(period_ns)
    return GridClock(period_ns, spin_ns=round(loop.spin_us * 1e3) if may_spin else 0)


def require_backend(settings: RunSettings) -> None:
    """Load what the backend needs; raise `RigError` where its device cannot be had."""
    if isinstance(settings.rig, NidaqRigSettings):
        try:
            from hal.nidaq.on_demand import require_card
        # Whatever it is: the package reads any `.env` that it finds from here upwards.
        except Exception as error:
            raise RigError(
                f"the package nidaqmx cannot be imported: {error}",
                fix="move a broken .env or settings.ini out of this directory, or reinstall pamctl",
            ) from error
        require_card(settings.rig.nidaq)


def build_rig(settings: RunSettings, clock: Clock) -> RigParts:
    """Return the rig, not yet opened."""
    match settings.rig:
        case SimRigSettings():
            return _build_sim(settings, settings.rig, clock)
        case NidaqRigSettings() as rig:
            return _build_card(rig, clock)


def _build_card(rig: NidaqRigSettings, clock: Clock) -> RigParts:
    if rig.nidaq.timing == "on_demand":
        from hal.nidaq.on_demand import NidaqRig

        card = NidaqRig(rig.nidaq, safe_output_v=rig.safe_volts, now_ns=clock.now_ns)
        return RigParts(card, clock, lambda: _UNKNOWN)

    from hal.nidaq.hardware_timed import HardwareTimedRig

    timed = HardwareTimedRig(
        rig.nidaq,
        rate_hz=rig.loop.rate_hz,
        safe_output_v=rig.safe_volts,
        now_ns=clock.now_ns,
    )
    return RigParts(timed, SampleClock(clock, timed.await_edge), lambda: _UNKNOWN)


def _build_sim(settings: RunSettings, rig: SimRigSettings, clock: Clock) -> RigParts:
    plant = SimulatedPlant(plant_parameters(settings.plant))
    device = rig.sim.device
    sim = SimRig(
        plant,
        sensor_chain(rig.sim, rig.calibration),
        safe_output_v=rig.safe_volts,
        now_ns=clock.now_ns,
        output_delay_ticks=rig.sim.output_delay_ticks,
        seed=settings.seed,
        register=None if settings.fast else SharedRegister(ao_path(device), device),
    )
    whole = FaultyRig(sim, rig.faults) if rig.faults else sim
    return RigParts(whole, clock, lambda: Truth(plant.state.position_m, plant.state.pressure_pa))


def ao_path(device: str) -> Path:
    """Return where the output of a simulated device lies in real time."""
    return SHARED_MEMORY / f"pamctl-{device}.ao"


def device_of(settings: RunSettings) -> str:
    """Return the name of the device that a run needs for itself."""
    match settings.rig:
        case SimRigSettings():
            return settings.rig.sim.device
        case NidaqRigSettings():
            return settings.rig.nidaq.device
