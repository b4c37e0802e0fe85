"""The rig as `doctor` and `calibrate` have it: theirs alone, watched, and safe at the end."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from hal.reservation import reserved
from hal.rig import opened
from pamctl.commissioning.hands_on import Bench
from pamctl.processes.backends import SHARED_MEMORY, clock_of, device_of, rig_of
from pamctl.processes.interrupts import Interrupts
from pamctl.processes.watchman_main import watched
from pamctl.settings.resolve import RunSettings
from pamctl.settings.rig_file import NidaqRigSettings


@contextmanager
def workplace(settings: RunSettings) -> Iterator[Bench]:
    """Hold the device, open the rig, and give it into a person's hands.

    Raises `RigError` where the device cannot be had, for instance because a run holds it, and
    `Interrupted` when a signal ends the work.
    """
    device = device_of(settings)
    clock = clock_of(settings, may_spin=False)
    settings = _on_demand(settings)
    rig = rig_of(settings, clock).rig
    file = settings.rig
    with (
        Interrupts() as interrupts,
        reserved(SHARED_MEMORY / f"pamctl-{device}.lock", device),
        watched(settings, rig),
        opened(rig),
        interrupts.heeded(),
    ):
        yield Bench(rig, clock, file.calibration, file.limits, file.homing, file.safe_volts)


def _on_demand(settings: RunSettings) -> RunSettings:
    """Let the computer's clock pace the work, whatever paces runs: nothing here is fast."""
    if not isinstance(settings.rig, NidaqRigSettings):
        return settings
    card = settings.rig.nidaq.model_copy(update={"timing": "on_demand"})
    return settings.model_copy(update={"rig": settings.rig.model_copy(update={"nidaq": card})})
