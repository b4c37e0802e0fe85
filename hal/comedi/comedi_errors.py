"""The errors of comedi that a user can do something about, and what."""

from __future__ import annotations

import errno
from collections.abc import Mapping

INSTALL = "install libcomedi (Debian, Ubuntu: sudo apt install libcomedi0); or use --backend sim"

_UNBOUND = (
    "check that the kernel's driver holds the card: `pamctl doctor --backend comedi`; "
    "if no driver does: sudo modprobe ni_pcimio"
)
_BUSY = "another program holds this part of the card: end it (a run of pamctl? a comedi tool?)"
_TIMEOUT = "the card did not answer in time: is it failing? Look into `dmesg`"

PERMIT = (
    "ls -l {device} shows its group: sudo usermod -aG GROUP $USER, and log in again; where the "
    "group is root, `pamctl manual comedi` has the udev rule"
)

OPEN_FIXES: Mapping[int, str] = {
    errno.ENOENT: _UNBOUND,
    errno.ENODEV: _UNBOUND,
    errno.ENXIO: _UNBOUND,
    errno.EACCES: PERMIT,
    errno.EPERM: PERMIT,
    errno.ENOTTY: "that file is no comedi device: correct comedi.device in the rig file",
}
"""Of opening the device file."""

FIXES: Mapping[int, str] = {
    errno.EBUSY: _BUSY,
    # The kernel's answer to an instruction for a subdevice that another file has locked.
    errno.EACCES: _BUSY,
    errno.EINVAL: "the card refuses this: check channels, ranges and PFI lines in section comedi "
    "of the rig file",
    errno.ENODEV: f"the card or its driver is gone; {_UNBOUND}",
    errno.ETIME: _TIMEOUT,
    errno.ETIMEDOUT: _TIMEOUT,
}
"""Of everything after that."""

BUSY = frozenset({errno.EBUSY, errno.EACCES})


def fix_of(code: int) -> str:
    """Return what to do about an error number of an open card."""
    return FIXES.get(code, "look into `dmesg`, and see whether a reboot helps")
