"""Volts and codes of a channel: the card's ranges, and the polynomials that correct them.

The converters of an M Series card are not trimmed: their nominal range is wrong by some 5 %, and
the program corrects each code. `comedi_soft_calibrate` measures the card's internal reference,
whose voltage NI stored in the card, and writes the polynomials to a file.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

from hal.comedi import libcomedi
from hal.comedi.comedi_backend import UNCALIBRATED
from hal.comedi.libcomedi import ComediFile, ComediPolynomial
from hal.rig import RigError

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
    return {
        number: (one.min, one.max)
        for number, one in ranges.items()
        if one.unit == libcomedi.UNIT_VOLT
    }


def find_channel(
    file: ComediFile, kind: int, channel: int, asked_v: tuple[float, float], reference: int
) -> AnalogChannel:
    """Return a channel in the narrowest range that holds `asked_v`; raise `RigError` if none does.

    `kind` is `SUBD_AI` or `SUBD_AO`.
    """
    what = "analog input" if kind == libcomedi.SUBD_AI else "analog output"
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
    if direction == libcomedi.TO_PHYSICAL:
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
        if not flags & libcomedi.SDF_SOFT_CALIBRATED:
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
        _free(text)


_free = ctypes.CDLL(None).free
_free.argtypes = [ctypes.c_void_p]
_free.restype = None
