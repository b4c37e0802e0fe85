"""The NI card: the only file that imports nidaqmx, and only when a card is asked for."""

from __future__ import annotations

from hal.rig import RigError


def require_driver() -> str:
    """Return the version of the installed NI-DAQmx driver; raise `RigError` without one."""
    from nidaqmx.errors import DaqNotFoundError, DaqNotSupportedError
    from nidaqmx.system import System

    try:
        version = System.local().driver_version
    except (DaqNotFoundError, DaqNotSupportedError) as error:
        raise RigError(
            "no NI-DAQmx driver on this computer",
            fix="install NI-DAQmx for Linux (package ni-daqmx from NI's repository), reboot, "
            "and check that `nilsdev` lists the card; or run with --backend sim",
        ) from error
    return f"{version.major_version}.{version.minor_version}.{version.update_version}"
