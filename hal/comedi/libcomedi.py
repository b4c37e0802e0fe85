"""libcomedi through ctypes: its functions, its structures, and its errors as `RigError`.

Numbers are those of the kernel's public header `linux/comedi.h`; signatures and structures are
those of `comedilib.h` 0.11. A test compares them with the headers.
"""

from __future__ import annotations

import ctypes
import errno
import os
from collections.abc import Mapping
from ctypes import POINTER, Structure, c_char_p, c_double, c_int, c_uint, c_void_p
from functools import cache
from typing import Any

from hal.card import find_loaded_library
from hal.rig import RigError

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


SONAME = "libcomedi.so.0"

SUBD_AI, SUBD_AO, SUBD_DIO, SUBD_COUNTER = 1, 2, 5, 6
SDF_INTERNAL, SDF_SOFT_CALIBRATED = 0x00040000, 0x2000
AREF_GROUND, AREF_COMMON, AREF_DIFF = 0, 1, 2
UNIT_VOLT = 0

INSN_READ, INSN_WRITE, INSN_CONFIG = 0x4000000, 0x8000001, 0xC000003
INSN_CONFIG_DIO_INPUT = 0
INSN_CONFIG_FILTER = 24
INSN_CONFIG_ARM = 31
INSN_CONFIG_RESET = 34
INSN_CONFIG_SET_GATE_SRC = 2001
INSN_CONFIG_SET_CLOCK_SRC = 2003
INSN_CONFIG_SET_OTHER_SRC = 2005
INSN_CONFIG_SET_COUNTER_MODE = 4097

NI_GPCT_COUNTING_MODE_QUADRATURE_X4_BITS = 0x3 << 16
NI_GPCT_COUNTING_DIRECTION_HW_UP_DOWN_BITS = 0x2 << 24
NI_GPCT_DISABLED_GATE_SELECT = 0x8000
NI_GPCT_DISABLED_OTHER_SELECT = 0x8000
NI_GPCT_SOURCE_ENCODER_A, NI_GPCT_SOURCE_ENCODER_B, NI_GPCT_SOURCE_ENCODER_Z = 0, 1, 2
NI_GPCT_ARM_IMMEDIATE = 0
NI_GPCT_TIMEBASE_1_CLOCK_SRC_BITS = 0
NI_PFI_FILTER_OFF, NI_PFI_FILTER_125NS, NI_PFI_FILTER_6425NS = 0, 1, 2

TO_PHYSICAL, FROM_PHYSICAL = 0, 1


def pack_channel(channel: int, range_number: int = 0, reference: int = 0) -> int:
    """Return the channel, range and reference of an instruction as one number (`CR_PACK`)."""
    return (reference & 0x3) << 24 | (range_number & 0xFF) << 16 | channel


def select_pfi(line: int) -> int:
    """Return the number of a PFI line as a counter's source (`NI_GPCT_PFI_OTHER_SELECT`)."""
    return 1 + line if line < 10 else 0xB + line


class ComediRange(Structure):
    """`comedi_range`: volts where `unit` is `UNIT_VOLT`."""

    _fields_ = (("min", c_double), ("max", c_double), ("unit", c_uint))


class ComediPolynomial(Structure):
    """`comedi_polynomial_t`."""

    _fields_ = (("coefficients", c_double * 4), ("expansion_origin", c_double), ("order", c_uint))


class ComediInsn(Structure):
    """`comedi_insn`: one instruction for one subdevice."""

    _fields_ = (
        ("insn", c_uint),
        ("n", c_uint),
        ("data", POINTER(c_uint)),
        ("subdev", c_uint),
        ("chanspec", c_uint),
        ("unused", c_uint * 3),
    )


class ComediInsnList(Structure):
    """`comedi_insnlist`: instructions that the kernel runs one after the other."""

    _fields_ = (("n_insns", c_uint), ("insns", POINTER(ComediInsn)))


SIGNATURES: Mapping[str, tuple[Any, ...]] = {
    "comedi_open": (c_void_p, c_char_p),
    "comedi_close": (c_int, c_void_p),
    "comedi_errno": (c_int,),
    "comedi_strerror": (c_char_p, c_int),
    "comedi_fileno": (c_int, c_void_p),
    "comedi_get_version_code": (c_int, c_void_p),
    "comedi_get_driver_name": (c_char_p, c_void_p),
    "comedi_get_board_name": (c_char_p, c_void_p),
    "comedi_find_subdevice_by_type": (c_int, c_void_p, c_int, c_uint),
    "comedi_get_subdevice_flags": (c_int, c_void_p, c_uint),
    "comedi_get_n_channels": (c_int, c_void_p, c_uint),
    "comedi_get_maxdata": (c_uint, c_void_p, c_uint, c_uint),
    "comedi_get_n_ranges": (c_int, c_void_p, c_uint, c_uint),
    "comedi_get_range": (POINTER(ComediRange), c_void_p, c_uint, c_uint, c_uint),
    "comedi_lock": (c_int, c_void_p, c_uint),
    "comedi_unlock": (c_int, c_void_p, c_uint),
    "comedi_do_insn": (c_int, c_void_p, POINTER(ComediInsn)),
    "comedi_do_insnlist": (c_int, c_void_p, POINTER(ComediInsnList)),
    "comedi_data_write": (c_int, c_void_p, c_uint, c_uint, c_uint, c_uint, c_uint),
    # A pointer, not a string: the caller frees it.
    "comedi_get_default_calibration_path": (c_void_p, c_void_p),
    "comedi_parse_calibration_file": (c_void_p, c_char_p),
    "comedi_cleanup_calibration": (None, c_void_p),
    "comedi_get_softcal_converter": (
        c_int,
        c_uint,
        c_uint,
        c_uint,
        c_int,
        c_void_p,
        POINTER(ComediPolynomial),
    ),
}
"""Result and arguments of each function of the library that is used here."""


class LibraryMissingError(RigError):
    """There is no libcomedi on this computer, or not the one that is needed."""


@cache
def load_library() -> Any:
    """Load libcomedi; raise `LibraryMissingError` where it is missing or too old."""
    try:
        library = ctypes.CDLL(SONAME)
        for name, (result, *arguments) in SIGNATURES.items():
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
    except OSError:
        raise LibraryMissingError("no libcomedi on this computer", fix=INSTALL) from None
    except AttributeError as error:
        raise LibraryMissingError(f"libcomedi is too old: {error}", fix=INSTALL) from None
    return library


def find_library_path() -> str:
    """Return the path of the libcomedi that this process has loaded."""
    return find_loaded_library("libcomedi.so")


class ComediFile:
    """An open device file. Every call raises `RigError` where the card refuses it.

    The kernel drops the file's locks when the last descriptor of it goes, even by SIGKILL. So no
    other process may inherit the descriptor.
    """

    def __init__(self, path: str) -> None:
        """Open the file; raise `RigError` with the fix where that is impossible."""
        self.path = path
        self.library = load_library()
        self.handle = self.library.comedi_open(path.encode())
        if not self.handle:
            code = self.library.comedi_errno()
            fix = OPEN_FIXES.get(code, fix_of(code)).format(device=path)
            raise RigError(f"opening {path}: {self._describe(code)}", fix=fix, code=code)
        os.set_inheritable(self.library.comedi_fileno(self.handle), False)

    def close(self) -> None:
        """Close the file; its locks go with it. Idempotent."""
        if self.handle:
            self.library.comedi_close(self.handle)
            self.handle = None

    def __enter__(self) -> ComediFile:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def require(self, doing: str, result: int) -> int:
        """Return the result of a call that is negative where it failed; then raise `RigError`."""
        if result >= 0:
            return result
        code = self.library.comedi_errno()
        raise RigError(f"{doing}: {self._describe(code)}", fix=fix_of(code), code=code)

    def lock(self, subdevice: int, what: str) -> None:
        """Take a subdevice for this file alone, until it is closed."""
        self.require(f"taking {what}", self.library.comedi_lock(self.handle, subdevice))

    def unlock(self, subdevice: int) -> None:
        """Let go of a subdevice."""
        self.require("letting go", self.library.comedi_unlock(self.handle, subdevice))

    def configure(self, what: str, subdevice: int, channel: int, *words: int) -> None:
        """Run one INSN_CONFIG instruction."""
        data = (c_uint * len(words))(*words)
        insn = ComediInsn(
            INSN_CONFIG, len(words), data, subdevice, pack_channel(channel), (c_uint * 3)()
        )
        self.require(f"setting up {what}", self.library.comedi_do_insn(self.handle, insn))

    def write_code(
        self, what: str, subdevice: int, chanspec: tuple[int, int, int], code: int
    ) -> None:
        """Write one code to a channel, range and reference of a subdevice."""
        result = self.library.comedi_data_write(self.handle, subdevice, *chanspec, code)
        self.require(f"writing to {what}", result)

    def describe(self) -> dict[str, object]:
        """Return the names and versions of library, driver and board."""
        code = self.library.comedi_get_version_code(self.handle)
        return {
            "library": find_library_path(),
            "driver_version": f"{code >> 16}.{code >> 8 & 0xFF}.{code & 0xFF}",
            "driver_name": self.library.comedi_get_driver_name(self.handle).decode(),
            "product_type": self.library.comedi_get_board_name(self.handle).decode(),
        }

    def _describe(self, code: int) -> str:
        return str(self.library.comedi_strerror(code).decode(errors="replace"))
