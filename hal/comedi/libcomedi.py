"""libcomedi through ctypes: functions, structures, errors as `RigError`, codes and their volts.

Numbers are those of the kernel's public header `linux/comedi.h`; signatures and structures are
those of `comedilib.h` 0.11. A test compares them with the headers.

The converters of an M Series card are not trimmed: their nominal range is wrong by some 5 %, and
the program corrects each code. `comedi_soft_calibrate` measures the card's internal reference,
whose voltage NI stored in the card, and writes the polynomials to a file.
"""

from __future__ import annotations

import ctypes
import errno
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from ctypes import POINTER, Structure, c_char_p, c_double, c_int, c_uint, c_void_p
from functools import cache
from typing import Any, NamedTuple

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
    "group is root, `pamctl manual wire-the-card` has the udev rule"
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


UNCALIBRATED = "none"
"""The `calibration_file` of a rig whose owner accepts the nominal ranges of the card."""
CALIBRATE = (
    "shut the air supply off, for this moves the valve: `sudo comedi_soft_calibrate -f {device}`; "
    "or accept an error of some 5 % with comedi.calibration_file: none"
)


class Polynomial(NamedTuple):
    """Coefficients of rising powers of `x - origin`."""

    origin: float
    coefficients: tuple[float, ...]


def evaluate(polynomial: Polynomial, x: float) -> float:
    """Return the polynomial's value at a code (volts) or at a voltage (a code and a fraction)."""
    origin, coefficients = polynomial
    total, power = 0.0, 1.0
    for coefficient in coefficients:
        total += coefficient * power
        power *= x - origin
    return total


class AnalogChannel(NamedTuple):
    """One input or output of the card, in one of its ranges."""

    subdevice: int
    channel: int
    range_number: int
    reference: int
    low_v: float
    high_v: float
    highest_code: int

    @property
    def chanspec(self) -> tuple[int, int, int]:
        """Channel, range and reference, as an instruction takes them."""
        return self.channel, self.range_number, self.reference


def list_ranges(file: ComediFile, subdevice: int, channel: int) -> dict[int, tuple[float, float]]:
    """Return the ranges of a channel that are in volts, by their number."""
    library, handle = file.library, file.handle
    count = file.require(
        "asking for ranges", library.comedi_get_n_ranges(handle, subdevice, channel)
    )
    ranges = {
        number: library.comedi_get_range(handle, subdevice, channel, number).contents
        for number in range(count)
    }
    return {number: (one.min, one.max) for number, one in ranges.items() if one.unit == UNIT_VOLT}


def find_channel(
    file: ComediFile, kind: int, channel: int, asked_v: tuple[float, float], reference: int
) -> AnalogChannel:
    """Return a channel in the narrowest range that holds `asked_v`; raise `RigError` if none does.

    `kind` is `SUBD_AI` or `SUBD_AO`.
    """
    what = "analog input" if kind == SUBD_AI else "analog output"
    subdevice = file.library.comedi_find_subdevice_by_type(file.handle, kind, 0)
    if subdevice < 0:
        raise RigError(
            f"{file.path} has no {what}", fix="correct comedi.device: it must be an M Series card"
        )
    count = file.library.comedi_get_n_channels(file.handle, subdevice)
    if channel >= count:
        raise RigError(
            f"{what} {channel} is not one of the card's {count}",
            fix="correct the channel in section comedi of the rig file",
        )
    ranges = list_ranges(file, subdevice, channel)
    fitting = [
        (high - low, number)
        for number, (low, high) in ranges.items()
        if low <= asked_v[0] and asked_v[1] <= high
    ]
    if not fitting:
        there = ", ".join(f"{low:g} to {high:g} V" for low, high in ranges.values())
        raise RigError(
            f"no range of {what} {channel} holds {asked_v[0]:g} to {asked_v[1]:g} V",
            fix=f"the card has {there}: correct section comedi of the rig file",
        )
    number = min(fitting)[1]
    highest = file.library.comedi_get_maxdata(file.handle, subdevice, channel)
    return AnalogChannel(subdevice, channel, number, reference, *ranges[number], highest)


def make_nominal(place: AnalogChannel, direction: int) -> Polynomial:
    """Return the straight line of a card that needs no correction."""
    step_v = (place.high_v - place.low_v) / place.highest_code
    if direction == TO_PHYSICAL:
        return Polynomial(0.0, (place.low_v, step_v))
    return Polynomial(place.low_v, (0.0, 1.0 / step_v))


class CardCalibration(NamedTuple):
    """The file of a card's polynomials, read by the library; `parsed` is None without one."""

    path: str
    parsed: int | None
    device: str

    def get_polynomial(self, file: ComediFile, place: AnalogChannel, direction: int) -> Polynomial:
        """Return the polynomial of a channel; raise `RigError` where the file has none for it."""
        if self.parsed is None:
            return make_nominal(place, direction)
        flags = file.library.comedi_get_subdevice_flags(file.handle, place.subdevice)
        if not flags & SDF_SOFT_CALIBRATED:
            return make_nominal(place, direction)
        found = ComediPolynomial()
        if file.library.comedi_get_softcal_converter(
            place.subdevice, place.channel, place.range_number, direction, self.parsed, found
        ):
            raise RigError(
                f"{self.path} has no calibration of subdevice {place.subdevice}, channel "
                f"{place.channel}, {place.low_v:g} to {place.high_v:g} V",
                fix=CALIBRATE.format(device=self.device),
            )
        return Polynomial(found.expansion_origin, tuple(found.coefficients[: int(found.order) + 1]))


@contextmanager
def read_calibration(file: ComediFile, named: str) -> Iterator[CardCalibration]:
    """Read the calibration file that a rig file names; raise `RigError` where it is missing."""
    if named == UNCALIBRATED:
        yield CardCalibration("", None, file.path)
        return
    path = named or find_default_path(file)
    parsed = file.library.comedi_parse_calibration_file(path.encode())
    if not parsed:
        raise RigError(
            f"{file.path} has no calibration in {path}", fix=CALIBRATE.format(device=file.path)
        )
    try:
        yield CardCalibration(path, parsed, file.path)
    finally:
        file.library.comedi_cleanup_calibration(parsed)


def find_default_path(file: ComediFile) -> str:
    """Return where comedi keeps the calibration of a card."""
    text = file.library.comedi_get_default_calibration_path(file.handle)
    if not text:
        raise RigError(
            f"libcomedi names no calibration file for {file.path}",
            fix="name it: comedi.calibration_file",
        )
    try:
        return ctypes.string_at(text).decode()
    finally:
        free = ctypes.CDLL(None).free
        free.argtypes, free.restype = [ctypes.c_void_p], None
        free(text)
