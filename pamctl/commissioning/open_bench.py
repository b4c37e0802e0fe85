"""The rig for `doctor` and `calibrate`: held by them alone, watched, and safe at the end."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from hal.rig import open_rig
from pamctl.commissioning.hands_on import Bench
from pamctl.processes.backends import build_clock, build_rig, hold_device
from pamctl.processes.guardian_main import keep_watchman
from pamctl.processes.interrupts import Interrupts
from pamctl.processes.keep_awake import keep_awake
from pamctl.settings.resolve import RunSettings


@contextmanager
def open_workplace(settings: RunSettings) -> Iterator[Bench]:
    """Hold the device, open the rig, and make a bench of it.

    Raises `RigError` where the device is not available, for instance because a run holds it,
    and `SignalInterrupt` when a signal ends the work.
    """
    clock = build_clock(settings, may_spin=False)
    # Nothing here is fast: the computer's clock paces the work even where a device could.
    rig = build_rig(settings, clock, by_computer=True).rig
    file = settings.rig
    with (
        Interrupts() as interrupts,
        hold_device(settings),
        keep_watchman(settings, rig),
        keep_awake(),
        open_rig(rig),
        interrupts.heed_signals(),
    ):
        yield Bench(
            rig,
            clock,
            file.calibration,
            file.limits,
            file.homing,
            file.safe_volts,
            file.record.keys,
        )
