"""NI-DAQmx itself: find driver and card, turn what they report into `RigError` and counts."""

from __future__ import annotations

import ctypes
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from nidaqmx.constants import BusType
from nidaqmx.errors import DaqError, DaqNotFoundError, DaqNotSupportedError, DaqWarning
from nidaqmx.errors import Error as DriverError
from nidaqmx.system import Device, System

from hal.driver_library import find_loaded_library, refuse_stand_in
from hal.nidaq.card_settings import NidaqSettings
from hal.nidaq.driver_errors import INSTALL, ON_DEMAND, fix_of
from hal.rig import RigError

STAND_IN_SERIAL = 0xDECAF
"""Serial number of the driver that stands in for a card in this project's tests."""
LIBRARY = "libnidaqmx.so"
"""The driver's C library, which the package loads."""

_TIMED_BUSES = (BusType.PCI, BusType.PCIE, BusType.PXI, BusType.PXIE)

_LEFT_OUT = ("Status Code:", "Task Name:")

NO_DRIVER = (DaqNotFoundError, DaqNotSupportedError)
"""Errors of a computer without NI-DAQmx."""
FAILURES = (DriverError, ctypes.ArgumentError, OSError, ValueError)
"""Errors of a call. ArgumentError: ctypes refuses an argument. OSError: the library cannot be
loaded. ValueError: a count is not a number."""


def require_card(settings: NidaqSettings) -> Mapping[str, object]:
    """Load the driver and find the card; return their versions and names for `describe`.

    Raises `RigError` where one is missing, or where the card is the tests' stand-in.
    """
    with raise_rig_errors(f"looking for {settings.device}"):
        version = System.local().driver_version
        device = Device(settings.device)
        serial = int(device.serial_num)
        bus = device.bus_type
        identity = {
            "library": find_loaded_library(LIBRARY),
            "driver_version": ".".join(map(str, version)),
            "product_type": str(device.product_type),
            "serial_number": f"{serial:X}",
        }
    if settings.timing == "hardware_timed" and bus not in _TIMED_BUSES:
        raise RigError(
            f"{settings.device} is a {identity['product_type']} on {bus.name}: "
            "no hardware-timed single points there",
            fix=ON_DEMAND,
        )
    if serial == STAND_IN_SERIAL:
        refuse_stand_in(settings.device, identity["library"])
    return identity


def make_rig_error(doing: str, error: Exception) -> RigError:
    """Return the driver's message with its error number and its fix."""
    if isinstance(error, NO_DRIVER):
        return RigError("no NI-DAQmx driver on this computer", fix=INSTALL)
    said = join_lines(str(error))
    if isinstance(error, DaqError):
        code = error.error_code
        return RigError(f"{doing}: {said}", fix=fix_of(code), code=code)
    return RigError(f"{doing}: {said or type(error).__name__}", fix="is NI-DAQmx installed whole?")


def join_lines(message: str) -> str:
    """Return the driver's message on one line: property, requested value, what can be selected.

    Left out is what the error says anyway, the status code, and the name of the task, which is
    this program's own.
    """
    lines = [" ".join(line.split()) for line in message.splitlines()]
    told = [line for line in lines if line and not line.startswith(_LEFT_OUT)]
    return " ".join(line if line.endswith((".", ":", ",")) else f"{line};" for line in told).rstrip(
        ".;:, "
    )


@contextmanager
def raise_rig_errors(doing: str) -> Iterator[None]:
    """Turn every failure of driver and package into a `RigError`."""
    try:
        yield
    except FAILURES as error:
        raise make_rig_error(doing, error) from error


@contextmanager
def divert_warnings(note: Callable[[int], None]) -> Iterator[None]:
    """Count the driver's warnings instead of printing one in every tick."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", DaqWarning)
        show = warnings.showwarning

        def divert(message: Any, category: type[Warning], *where: Any, **options: Any) -> None:
            if isinstance(message, DaqWarning):
                note(message.error_code)
            else:
                show(message, category, *where, **options)

        warnings.showwarning = divert
        yield
