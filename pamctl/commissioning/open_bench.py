"""The rig as `doctor` and `calibrate` have it: theirs alone, watched, and safe at the end."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from hal.reservation import hold_reservation
from hal.rig import open_rig
from pamctl.commissioning.hands_on import Bench
from pamctl.processes.backends import SHARED_MEMORY, build_clock, build_rig, device_of
from pamctl.processes.interrupts import Interrupts
from pamctl.processes.watchman_main import keep_watchman
from pamctl.settings.resolve import RunSettings
from pamctl.settings.rig_file import NidaqRigSettings


@contextmanager
def open_workplace(settings: RunSettings) -> Iterator[Bench]:
    """Hold the device, open the rig, and give it into a person's hands.

    Raises `RigError` where the device cannot be had, for instance because a run holds it, and
    `Interrupted` when a signal ends the work.
    """
    device = device_of(settings)
    clock = build_clock(settings, may_spin=False)
    settings = _pace_on_demand(settings)
    rig = build_rig(settings, clock).rig
    file = settings.rig
    with (
        Interrupts() as interrupts,
        hold_reservation(SHARED_MEMORY / f"pamctl-{device}.lock", device),
        keep_watchman(settings, rig),
        open_rig(rig),
        interrupts.heed_signals(),
    ):
        yield Bench(rig, clock, file.calibration, file.limits, file.homing, file.safe_volts)


def _pace_on_demand(settings: RunSettings) -> RunSettings:
    """Let the computer's clock pace the work, whatever paces runs: nothing here is fast."""
    if not isinstance(settings.rig, NidaqRigSettings):
        return settings
    card = settings.rig.nidaq.model_copy(update={"timing": "on_demand"})
    return settings.model_copy(update={"rig": settings.rig.model_copy(update={"nidaq": card})})
