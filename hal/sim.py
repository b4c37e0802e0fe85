"""The simulated rig: a plant behind the converters, noise and delay of a real card.

A card holds its last voltage when the process that wrote it dies; this is why there is a
guardian. `SharedRegister` behaves in the same way: it is a double in a file in shared memory,
and another process can take it over only after its owner has died. `PrivateRegister` is for
runs without a clock, which have no guardian.
"""

from __future__ import annotations

import math
import mmap
import os
import random
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from hal.backend import Backend, BuiltRig, Plant, RigRequest
from hal.calibration import (
    Calibration,
    CalibrationSettings,
    Configured,
    Converter,
    Output,
    Zero,
    calibration,
    encoder_counts,
    make_output,
    quantise_v,
    sensor_v,
    valve_v,
)
from hal.reservation import open_shared, reserve
from hal.rig import RawSample, RigError, RigIdentity


class SimSettings(Configured):
    """How the simulated sensors and output differ from ideal ones."""

    device: Annotated[
        str,
        Field(
            pattern="^[A-Za-z][A-Za-z0-9_-]{0,40}$",
            description="in real time one run at a time holds it, as it would a card",
        ),
    ] = "sim0"
    sensor_noise_v: Annotated[
        float, Field(ge=0, le=0.5, description="standard deviation; 0.002 V is some 300 Pa")
    ] = 0.002
    sensor_zero_v: Annotated[
        float, Field(ge=0, le=5, description="true output at atmospheric pressure")
    ] = 0.215
    encoder_start_counts: Annotated[
        float, Field(ge=-1e9, le=1e9, description="counter at the vented muscle, with fraction")
    ] = 1000.4
    output_delay_ticks: Annotated[
        Literal[0, 1], Field(description="1: a write reaches the valve at the next read")
    ] = 0
    input_full_scale_v: Annotated[float, Field(ge=0.1, le=10)] = 5.0
    output_full_scale_v: Annotated[float, Field(ge=0.1, le=10)] = 10.0


class SensorChain(NamedTuple):
    """The simulated sensors for the kernels."""

    calibration: Calibration
    zero: Zero
    noise_v: float
    input_converter: Converter
    output_converter: Converter


def sensor_chain(settings: SimSettings, nominal: CalibrationSettings) -> SensorChain:
    """Build the true sensor chain: nominal scales, its own zeros."""
    return SensorChain(
        calibration=calibration(nominal),
        zero=Zero(settings.sensor_zero_v, settings.encoder_start_counts),
        noise_v=settings.sensor_noise_v,
        input_converter=Converter(settings.input_full_scale_v),
        output_converter=Converter(settings.output_full_scale_v),
    )


def simulated_output(settings: SimSettings) -> Output:
    """Return the valve's output: the whole range of its converter."""
    full_scale_v = settings.output_full_scale_v
    return make_output(Converter(full_scale_v), -full_scale_v, full_scale_v)


def sensed_pressure_v(chain: SensorChain, pressure_pa: float, noise: float) -> float:
    """Voltage that the input converter reports; `noise` is a standard normal deviate."""
    true_v = sensor_v(chain.calibration, chain.zero, pressure_pa)
    return quantise_v(chain.input_converter, true_v + chain.noise_v * noise)


def sensed_counts(chain: SensorChain, position_m: float) -> int:
    """Counter value: quadrature counts whole edges passed."""
    return math.floor(encoder_counts(chain.calibration, chain.zero, position_m))


class SimMoment(NamedTuple):
    """Where a simulated rig is between two ticks, beside its plant and its noise."""

    command_v: float
    """Valve command that acts on the plant."""
    output_v: float
    """Voltage on the analog output."""
    plant_t_ns: int
    """The time that the plant has come to."""


class SimRig:
    """Advances a plant by the given clock, between reads and writes."""

    def __init__(
        self,
        plant: Plant,
        chain: SensorChain,
        *,
        safe_output_v: float,
        now_ns: Callable[[], int],
        output_delay_ticks: Literal[0, 1] = 0,
        seed: int = 0,
        register: PrivateRegister | SharedRegister | None = None,
    ) -> None:
        """`safe_output_v` is the analog output voltage at which the rig is safe.

        `register` holds the output's voltage; by default it lies within this object.
        """
        self._plant = plant
        self._chain = chain
        self._safe_output_v = safe_output_v
        self._now_ns = now_ns
        self._delay_ticks: Literal[0, 1] = output_delay_ticks
        self._random = random.Random(seed)
        self._noise = self._random.gauss
        self._plant_t_ns = 0
        self._register = register or PrivateRegister(safe_output_v)
        self._safe_failure: RigError | None = None
        self._command_v = 0.0
        self._is_open = False

    def open(self) -> None:
        """Reserve the output, drive the safe voltage and start the plant's time."""
        self._register.reserve()
        self._plant_t_ns = self._now_ns()
        self._is_open = True
        self.make_safe()

    def read(self) -> RawSample:
        """Let the plant catch up with the clock and sample it."""
        self._require_open()
        now_ns = self._now_ns()
        plant, chain = self._plant, self._chain
        try:
            self._catch_up(now_ns)
            self._apply()
            pressure_v = sensed_pressure_v(chain, plant.pressure_pa, self._noise(0.0, 1.0))
            counts = sensed_counts(chain, plant.position_m)
        except (ArithmeticError, ValueError) as error:
            raise RigError(
                f"the simulated plant left the range of numbers ({error})",
                fix="check the sizes in the plant file",
            ) from error
        return RawSample(pressure_v, counts, now_ns, now_ns)

    def write(self, ao_v: float) -> float:
        """Apply a voltage to the valve driver."""
        self._require_open()
        if not math.isfinite(ao_v):
            raise RigError(f"refused to output {ao_v} V", fix="a law must command a finite voltage")
        applied_v = self._drive(ao_v)
        if not self._delay_ticks:
            self._catch_up(self._now_ns())
            self._apply()
        return applied_v

    def make_safe(self) -> None:
        """Drive the safe voltage at once, even where the plant fails."""
        try:
            self._register.reserve()
        except RigError as error:
            self._safe_failure = error
            return
        self._safe_failure = None
        self._drive(self._safe_output_v)
        if self._is_open:
            # The next read reports a plant that fails.
            with suppress(ArithmeticError, ValueError):
                self._catch_up(self._now_ns())
        else:
            self._register.release()
        self._apply()

    def close(self) -> None:
        """Make safe, stop, and leave the output to others."""
        self.make_safe()
        self._register.release()
        self._is_open = False

    @property
    def parts(self) -> tuple[Plant, SensorChain, int, random.Random]:
        """Plant, sensors, output delay (ticks) and noise, for who runs many ticks at once."""
        return self._plant, self._chain, self._delay_ticks, self._random

    def freeze(self) -> SimMoment:
        """Return the moment that the rig is in."""
        return SimMoment(self._command_v, self._register.volts, self._plant_t_ns)

    def thaw(self, moment: SimMoment) -> None:
        """Go on from a moment; the caller has set the plant and the noise."""
        self._command_v, self._register.volts, self._plant_t_ns = moment

    @property
    def output_v(self) -> float:
        """The voltage now on the analog output."""
        return self._register.volts

    @property
    def safe_failure(self) -> RigError | None:
        """Why the last `make_safe` could not drive the safe voltage; None where it did."""
        return self._safe_failure

    def describe(self) -> RigIdentity:
        """Say what is simulated."""
        return RigIdentity(
            "sim",
            self._safe_output_v,
            self._delay_ticks,
            extra={
                "sensor_noise_v": self._chain.noise_v,
                "input_full_scale_v": self._chain.input_converter.full_scale_v,
                "output_full_scale_v": self._chain.output_converter.full_scale_v,
                "encoder_m_per_count": self._chain.calibration.encoder_m_per_count,
            },
        )

    def _drive(self, ao_v: float) -> float:
        volts = self._register.volts = quantise_v(self._chain.output_converter, ao_v)
        return volts

    def _apply(self) -> None:
        """Apply the register's voltage to the valve; any process may have written it."""
        self._command_v = valve_v(self._chain.calibration, self._register.volts)

    def _catch_up(self, now_ns: int) -> None:
        if now_ns > self._plant_t_ns:
            self._plant.advance(self._command_v, (now_ns - self._plant_t_ns) * 1e-9)
            self._plant_t_ns = now_ns

    def _require_open(self) -> None:
        if not self._is_open:
            raise RigError("the simulated rig is not open", fix="call open() first")


_PID_AT = 8
_SIZE = 64


class PrivateRegister:
    """Holds the volts on a simulated output that no other process can see."""

    def __init__(self, volts: float = 0.0) -> None:
        """Power up at `volts`."""
        self.volts = volts

    def reserve(self) -> None:
        """Take the output for this process; raise `RigError` if another holds it. Idempotent."""

    def release(self) -> None:
        """Release the output; the voltage stays. Idempotent."""


class SharedRegister:
    """An output in shared memory. Powers up at 0 V, as an M series card does."""

    def __init__(self, path: Path, device: str) -> None:
        """`reserve` creates the file where it is missing; `device` is for messages."""
        self._path = path
        self._device = device
        self._fd: int | None = None
        # Until `reserve` maps the file, the voltage lies in private memory.
        self._volts = memoryview(bytearray(_SIZE)).cast("d")

    @property
    def volts(self) -> float:
        """The voltage now on the output, from any process."""
        return self._volts[0]

    @volts.setter
    def volts(self, value: float) -> None:
        self._volts[0] = value

    def reserve(self) -> None:
        """Take the output until `release` or death; raise `RigError` naming the holder."""
        if self._fd is not None:
            return
        fd = open_shared(self._path, _SIZE)
        try:
            reserve(fd, f"the output of {self._device}", _PID_AT)
            # The mapping duplicates its descriptor, and a duplicate would keep the lock.
            self._volts = memoryview(_map_file(self._path)).cast("d")
        except BaseException:
            os.close(fd)
            raise
        self._fd = fd

    def release(self) -> None:
        """Release the output; it keeps its voltage."""
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None


def peek_v(path: Path) -> float:
    """Read a register as a voltmeter would: without reserving it."""
    return memoryview(_map_file(path)).cast("d")[0]


def _map_file(path: Path) -> mmap.mmap:
    fd = open_shared(path, _SIZE)
    try:
        return mmap.mmap(fd, _SIZE)
    finally:
        os.close(fd)


def _build(request: RigRequest[SimSettings]) -> BuiltRig:
    settings, output_file = request.settings, request.output_file
    rig = SimRig(
        request.plant,
        sensor_chain(settings, request.calibration),
        safe_output_v=request.safe_volts,
        now_ns=request.now_ns,
        output_delay_ticks=settings.output_delay_ticks,
        seed=request.seed,
        register=None if output_file is None else SharedRegister(output_file, settings.device),
    )
    return BuiltRig(rig)


SIM = Backend(
    name="sim",
    description="A simulated rig; what it moves is the plant.",
    settings=SimSettings,
    rig_file="sim",
    safe_volts=0.0,
    device=lambda settings: settings.device,
    output=simulated_output,
    build=_build,
    is_simulated=True,
)
