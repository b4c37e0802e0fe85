"""The NI card behind the kernel's own driver, paced by the computer.

Encoder and pressure are read by one system call, a list of two instructions; where that is
refused, by two calls.

Subdevices are locked while the rig is open. The kernel drops these locks with the open file, even
by SIGKILL, so that a guardian can take the output over at once.

No card has been seen: all this is tested over a stand-in of the library, and over the real library
above a stand-in of the kernel.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, suppress
from ctypes import POINTER, byref, c_uint, cast, sizeof
from typing import NamedTuple

from hal.card import CardRig, refuse_stand_in, unwrap_count
from hal.comedi import libcomedi
from hal.comedi.comedi_backend import ComediSettings
from hal.comedi.libcomedi import (
    UNCALIBRATED,
    AnalogChannel,
    ComediFile,
    ComediInsn,
    ComediInsnList,
    LibraryMissingError,
    Polynomial,
    evaluate,
    find_channel,
    make_nominal,
    read_calibration,
)
from hal.rig import RawSample, RigError, RigIdentity

STAND_IN_DRIVER = "stand_in"
"""What the stand-in of this project's tests calls the kernel's driver."""

_REFERENCES = {
    "rse": libcomedi.AREF_GROUND,
    "nrse": libcomedi.AREF_COMMON,
    "diff": libcomedi.AREF_DIFF,
}
_FILTERS = {
    0: libcomedi.NI_PFI_FILTER_OFF,
    125: libcomedi.NI_PFI_FILTER_125NS,
    6425: libcomedi.NI_PFI_FILTER_6425NS,
}


# --- what is there -----------------------------------------------------------------------


def require_card(settings: ComediSettings) -> None:
    """Load the library and open the card once.

    Raises `RigError` where one is missing, or where the card is the tests' stand-in.
    """
    with ComediFile(settings.device) as file:
        _identify(file)


def _identify(file: ComediFile) -> dict[str, object]:
    identity = file.describe()
    if identity["driver_name"] == STAND_IN_DRIVER:
        refuse_stand_in(file.path, str(identity["library"]))
    return identity


def find_valve_output(file: ComediFile, settings: ComediSettings) -> AnalogChannel:
    """Return the valve's output; raise `RigError` where the card does not have it."""
    asked_v = (settings.output_low_v, settings.output_high_v)
    channel = int(settings.valve_channel.removeprefix("ao"))
    return find_channel(file, libcomedi.SUBD_AO, channel, asked_v, libcomedi.AREF_GROUND)


def find_pressure_input(file: ComediFile, settings: ComediSettings) -> AnalogChannel:
    """Return the sensor's input in its narrowest range; raise `RigError` where there is none."""
    asked_v = (settings.input_low_v, settings.input_high_v)
    channel = int(settings.pressure_channel.removeprefix("ai"))
    reference = _REFERENCES[settings.terminal]
    return find_channel(file, libcomedi.SUBD_AI, channel, asked_v, reference)


def find_counter(file: ComediFile, settings: ComediSettings) -> int:
    """Return the subdevice of the encoder's counter; raise `RigError` where it is missing."""
    subdevice: int = -1
    for _ in range(int(settings.encoder_counter.removeprefix("ctr")) + 1):
        subdevice = file.library.comedi_find_subdevice_by_type(
            file.handle, libcomedi.SUBD_COUNTER, subdevice + 1
        )
        if subdevice < 0:
            raise RigError(
                f"{file.path} has no counter {settings.encoder_counter}",
                fix="correct comedi.device: it must be an M Series card",
            )
    return subdevice


def find_pfi_lines(file: ComediFile) -> int:
    """Return the subdevice of the PFI lines; raise `RigError` where it is missing."""
    subdevice: int = -1
    while True:
        subdevice = file.library.comedi_find_subdevice_by_type(
            file.handle, libcomedi.SUBD_DIO, subdevice + 1
        )
        if subdevice < 0:
            raise RigError(
                f"{file.path} has no PFI lines",
                fix="correct comedi.device: it must be an M Series card",
            )
        flags = file.library.comedi_get_subdevice_flags(file.handle, subdevice)
        # The card's other digital lines have terminals of their own.
        if flags & libcomedi.SDF_INTERNAL:
            return subdevice


# --- the parts of an open card -----------------------------------------------------------


class CardReading(NamedTuple):
    """The code of the input and the reading of the counter, each with the time of its call."""

    code: int
    counter: int
    code_t_ns: int
    counter_t_ns: int


class WiredCard(NamedTuple):
    """What the open card offers."""

    file: ComediFile
    write_v: Callable[[float], None]
    read: Callable[[], CardReading]
    input_volts: Polynomial
    counter_span: int


def start_encoder(file: ComediFile, settings: ComediSettings) -> int:
    """Let the counter count all four edges of a cycle, from 0; return its subdevice."""
    what = f"counter {settings.encoder_counter}"
    counter = find_counter(file, settings)
    file.lock(counter, what)
    lines = (settings.encoder_a_pfi, settings.encoder_b_pfi)
    pfi = find_pfi_lines(file)
    for line in lines:
        file.configure(f"PFI {line}", pfi, line, libcomedi.INSN_CONFIG_DIO_INPUT)
        shortest_pulse = _FILTERS[settings.encoder_filter_ns]
        file.configure(f"PFI {line}", pfi, line, libcomedi.INSN_CONFIG_FILTER, shortest_pulse)

    def configure(*words: int) -> None:
        file.configure(what, counter, 0, *words)

    configure(libcomedi.INSN_CONFIG_RESET)
    # The counter itself, and both registers that it could be loaded from.
    for register in range(3):
        file.write_code(what, counter, (register, 0, 0), 0)
    # The clock that samples A and B: another program may have left another one.
    configure(libcomedi.INSN_CONFIG_SET_CLOCK_SRC, libcomedi.NI_GPCT_TIMEBASE_1_CLOCK_SRC_BITS, 0)
    # A gate would stop the count; the index would reset it in the middle of a motion.
    for gate in range(2):
        configure(libcomedi.INSN_CONFIG_SET_GATE_SRC, gate, libcomedi.NI_GPCT_DISABLED_GATE_SELECT)
    for source, select in (
        (libcomedi.NI_GPCT_SOURCE_ENCODER_A, libcomedi.select_pfi(lines[0])),
        (libcomedi.NI_GPCT_SOURCE_ENCODER_B, libcomedi.select_pfi(lines[1])),
        (libcomedi.NI_GPCT_SOURCE_ENCODER_Z, libcomedi.NI_GPCT_DISABLED_OTHER_SELECT),
    ):
        configure(libcomedi.INSN_CONFIG_SET_OTHER_SRC, source, select)
    configure(
        libcomedi.INSN_CONFIG_SET_COUNTER_MODE,
        libcomedi.NI_GPCT_COUNTING_MODE_QUADRATURE_X4_BITS
        | libcomedi.NI_GPCT_COUNTING_DIRECTION_HW_UP_DOWN_BITS,
    )
    configure(libcomedi.INSN_CONFIG_ARM, libcomedi.NI_GPCT_ARM_IMMEDIATE)
    return counter


def make_volt_writer(
    file: ComediFile, place: AnalogChannel, to_code: Polynomial
) -> Callable[[float], None]:
    """Return a function that puts volts on an output: the nearest code of its range."""

    def write_v(volts: float) -> None:
        code = min(max(round(evaluate(to_code, volts)), 0), place.highest_code)
        file.write_code("the valve", place.subdevice, place.chanspec, code)

    return write_v


class CardReader:
    """The two instructions that read encoder and pressure, and the memory they write to."""

    def __init__(
        self, file: ComediFile, counter: int, place: AnalogChannel, now_ns: Callable[[], int]
    ) -> None:
        """`now_ns` is the clock of the readings."""
        self._file = file
        self._now_ns = now_ns
        self._data = (c_uint * 2)()
        targets = (
            (counter, libcomedi.pack_channel(0)),
            (place.subdevice, libcomedi.pack_channel(*place.chanspec)),
        )
        self._insns = (ComediInsn * 2)(
            *(
                ComediInsn(
                    libcomedi.INSN_READ,
                    1,
                    cast(byref(self._data, i * sizeof(c_uint)), POINTER(c_uint)),
                    subdevice,
                    chanspec,
                    (c_uint * 3)(),
                )
                for i, (subdevice, chanspec) in enumerate(targets)
            )
        )
        self._list = ComediInsnList(2, self._insns)

    def read_together(self) -> CardReading:
        """Read both by one system call, the encoder first."""
        file = self._file
        t_ns = self._now_ns()
        done = file.library.comedi_do_insnlist(file.handle, self._list)
        if done != 2:
            file.require("reading encoder and pressure sensor", min(done, -1))
        counter, code = self._data
        return CardReading(code, counter, t_ns, t_ns)

    def read_singly(self) -> CardReading:
        """Read both by a system call each, the encoder first."""
        file = self._file
        counter_t_ns = self._now_ns()
        done = file.library.comedi_do_insn(file.handle, self._insns[0])
        file.require("reading the encoder", done)
        code_t_ns = self._now_ns()
        done = file.library.comedi_do_insn(file.handle, self._insns[1])
        file.require("reading the pressure sensor", done)
        counter, code = self._data
        return CardReading(code, counter, code_t_ns, counter_t_ns)

    def choose(self) -> Callable[[], CardReading]:
        """Return the way that the driver accepts; raise `RigError` where it accepts neither."""
        with suppress(RigError):
            self.read_together()
            return self.read_together
        self.read_singly()
        return self.read_singly


# --- the rig -----------------------------------------------------------------------------


class ComediRig(CardRig[ComediSettings, WiredCard]):
    """Valve, pressure sensor and encoder on one M Series card.

    The volts that `write` returns are those of an ideal 16-bit converter, as with NI's driver. The
    code that the card's calibration gives for them is at most half a code away.
    """

    def read(self) -> RawSample:
        """Read encoder and pressure; the time of each is that just before its system call."""
        wired = self._require_open()
        code, counter, code_t_ns, counter_t_ns = wired.read()
        self._counts = unwrap_count(self._counts, counter, wired.counter_span)
        return RawSample(evaluate(wired.input_volts, code), self._counts, code_t_ns, counter_t_ns)

    def describe(self) -> RigIdentity:
        """Name terminals and ranges; once opened, also library, driver and calibration."""
        extra = {**self._settings.model_dump(), **self._identity}
        return RigIdentity("comedi", self._safe_output_v, extra=extra)

    def _explain_failure(self, failure: Exception) -> RigError:
        if isinstance(failure, RigError):
            return failure
        return RigError(f"driving the safe voltage: {failure}", fix="is libcomedi installed whole?")

    def _is_hopeless(self, error: Exception) -> bool:
        return isinstance(error, LibraryMissingError)

    def _wire(self, acquired: ExitStack) -> WiredCard:
        """Write the safe voltage, and only then take the inputs."""
        settings = self._settings
        file = acquired.enter_context(ComediFile(settings.device))
        valve = find_valve_output(file, settings)
        file.lock(valve.subdevice, "the valve's output")
        to_code, failure = self._find_output_codes(file, valve)
        write_v = make_volt_writer(file, valve, to_code)
        write_v(self._safe_v)
        identity = _identify(file)
        if failure is not None:
            raise failure
        counter = start_encoder(file, settings)
        sensor = find_pressure_input(file, settings)
        file.lock(sensor.subdevice, "the analog input")
        with read_calibration(file, settings.calibration_file) as calibration:
            volts = calibration.get_polynomial(file, sensor, libcomedi.TO_PHYSICAL)
            path = calibration.path
        reader = CardReader(file, counter, sensor, self._now_ns)
        read = reader.choose()
        self._identity = {
            **identity,
            "calibrated_by": path or UNCALIBRATED,
            "input_volts_origin": volts.origin,
            "input_volts_coefficients": list(volts.coefficients),
            "output_code_origin": to_code.origin,
            "output_code_coefficients": list(to_code.coefficients),
            "reads_in_one_call": read == reader.read_together,
        }
        span = int(file.library.comedi_get_maxdata(file.handle, counter, 0)) + 1
        return WiredCard(file, write_v, read, volts, span)

    def _find_output_codes(
        self, file: ComediFile, valve: AnalogChannel
    ) -> tuple[Polynomial, RigError | None]:
        """Return how volts become codes, and why that is nominal only although it must not be.

        The safe voltage does not wait for a calibration: off by some percent it is still safe.
        """
        try:
            with read_calibration(file, self._settings.calibration_file) as calibration:
                return calibration.get_polynomial(file, valve, libcomedi.FROM_PHYSICAL), None
        except RigError as failure:
            return make_nominal(valve, libcomedi.FROM_PHYSICAL), failure

    def _put_v(self, wired: WiredCard, volts: float) -> None:
        wired.write_v(volts)

    def _write_safe_as_wired(self, wired: WiredCard) -> None:
        wired.write_v(self._safe_v)

    def _write_safe_alone(self) -> None:
        with ComediFile(self._settings.device) as file:
            valve = find_valve_output(file, self._settings)
            to_code, _ = self._find_output_codes(file, valve)
            make_volt_writer(file, valve, to_code)(self._safe_v)
