"""A rig in a person's hands: command the valve for a while, read samples, watch the limits, ask.

`doctor --actuate` and `calibrate` move slowly and little, with a person watching. They need no
law, no log and no loop process, but they keep the limits of the rig file. The rig is held by them
alone, and safe at the end. It goes on while an answer is awaited: `idle` is called again and
again, and holds a pressure or watches the encoder.
"""

from __future__ import annotations

import math
import os
import select
import statistics
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import NamedTuple

from hal.calibration import Zero, calibration, output_v, pressure_pa, valve_v
from hal.rig import RawSample, Rig, open_rig
from pamctl.base.errors import ExitCode
from pamctl.processes.backends import build_clock, build_rig, hold_device
from pamctl.processes.guardian_main import keep_watchman
from pamctl.processes.interrupts import MASK, Interrupts, keep_awake
from pamctl.realtime.clock import Clock, SleepWatch
from pamctl.settings.resolve import RunSettings
from pamctl.settings.rig_file import RigFile

HOLD_V_PER_PA = 1e-4
"""Gain of the pressure hold. The valve fills some 1.5 MPa a second and volt: a pole at 150 1/s,
below the valve's own, and 5 kPa of error where the valve's null is off by half a volt."""
NEAR_PA = 10e3
"""How near a hold comes while the valve's null is not known yet."""


class LimitError(Exception):
    """The rig left a limit of its file; the message says which, and what to check."""

    exit_code = ExitCode.SAFETY_TRIP


class SensorStatistics(NamedTuple):
    """What the sensors read over some time."""

    samples: int
    sensor_v: float
    """Mean."""
    noise_v: float
    """Standard deviation of a single sample."""
    drift_v: float
    """Mean of the second half minus mean of the first."""
    counts: float
    """Mean."""
    counts_span: int
    """Highest minus lowest."""
    counts_jump: int
    """Largest change from one sample to the next."""

    @property
    def mean_noise_v(self) -> float:
        """Standard deviation of the mean, if the samples are independent."""
        return self.noise_v / math.sqrt(self.samples)


def summarise_samples(samples: Sequence[RawSample]) -> SensorStatistics:
    """Return the statistics of at least one sample."""
    volts = [sample.pressure_v for sample in samples]
    counts = [sample.encoder_counts for sample in samples]
    half = len(volts) // 2
    steps = [abs(b - a) for a, b in pairwise(counts)]
    return SensorStatistics(
        samples=len(samples),
        sensor_v=statistics.fmean(volts),
        noise_v=statistics.pstdev(volts),
        drift_v=statistics.fmean(volts[half:]) - statistics.fmean(volts[:half] or volts),
        counts=statistics.fmean(counts),
        counts_span=max(counts) - min(counts),
        counts_jump=max(steps, default=0),
    )


class Bench:
    """An open rig, a clock that paces it, and the limits that every sample is checked against.

    Every method leaves the last command on the valve. Who opened the rig makes it safe.
    """

    def __init__(self, rig: Rig, clock: Clock, file: RigFile) -> None:
        """`rig` is open already, and `file` is its rig file."""
        self.keys = file.record.keys
        self.rig = rig
        self.limits = file.limits
        self.homing = file.homing
        self.safe_volts = file.safe_volts
        self.settings = file.calibration
        self.calibration = calibration(file.calibration)
        self.safe_valve_v = valve_v(self.calibration, file.safe_volts)
        self._clock = clock
        self._sleep = SleepWatch()
        self._command_v = self.safe_valve_v
        self._zero = Zero(file.calibration.sensor_zero_v, 0.0)
        self._lowest_counts = math.inf
        self._highest_counts = -math.inf
        self._bad_since_ns: int | None = None

    @property
    def period_s(self) -> float:
        """Time between two samples."""
        return self._clock.period_ns * 1e-9

    @property
    def vents_when_safe(self) -> bool:
        """Say whether the safe voltage opens the exhaust, as the file has it."""
        return self.safe_valve_v < -0.5

    def point_to(self, *keys: str) -> str:
        """Return the end of a hint: which of these keys to check; empty where there are none."""
        named = " and ".join(key for key in keys if key)
        return f"; check {named} in the rig file" if named else ""

    def pressure_pa(self, sensor_v: float) -> float:
        """Absolute pressure by the file's calibration."""
        return pressure_pa(self.calibration, self._zero, sensor_v)

    def step(self, command_v: float) -> RawSample:
        """Wait for the next sample, check it against the limits, and command the valve (V)."""
        self._clock.wait()
        sample = self.rig.read()
        self._watch(sample)
        limit_v = self.limits.command_v
        self._command_v = command_v = min(max(command_v, -limit_v), limit_v)
        self.rig.write(output_v(self.calibration, command_v))
        return sample

    def hold(self, command_v: float, duration_s: float) -> list[RawSample]:
        """Command the valve for a while; return all samples, at least one."""
        return [self.step(command_v) for _ in range(max(1, round(duration_s / self.period_s)))]

    def hold_unwatched(self, command_v: float, duration_s: float) -> list[RawSample]:
        """As `hold`, without limits: for a command that is safe whatever the sensors read."""
        self.rig.write(output_v(self.calibration, command_v))
        samples = []
        for _ in range(max(1, round(duration_s / self.period_s))):
            self._clock.wait()
            samples.append(self.rig.read())
        return samples

    def hold_pressure(
        self, target_pa: float, until: Callable[[list[RawSample]], bool]
    ) -> list[RawSample]:
        """Hold a pressure (absolute, Pa) until `until` is true of the samples so far."""
        samples: list[RawSample] = []
        while not until(samples):
            sample = self.step(self._command_v)
            samples.append(sample)
            self._command_v = self._holding_v(target_pa, sample.pressure_v)
        return samples

    def bring_to_pressure(self, target_pa: float, patience_s: float = 5.0) -> None:
        """Bring the pressure near a target (absolute, Pa).

        Raises `LimitError` if the pressure does not get there.
        """
        most = round(patience_s / self.period_s)
        recent = 20

        def near(samples: list[RawSample]) -> bool:
            if len(samples) < recent:
                return False
            mean_v = statistics.fmean(s.pressure_v for s in samples[-recent:])
            return abs(self.pressure_pa(mean_v) - target_pa) < NEAR_PA or len(samples) >= most

        samples = self.hold_pressure(target_pa, near)
        mean_pa = self.pressure_pa(statistics.fmean(s.pressure_v for s in samples[-recent:]))
        if abs(mean_pa - target_pa) > 2 * NEAR_PA:
            raise LimitError(
                f"the pressure stays at {self.gauge_kpa(mean_pa):.0f} kPa gauge and does not reach "
                f"{self.gauge_kpa(target_pa):.0f} kPa within {patience_s:g} s; check the supply, "
                "and the valve with `pamctl doctor --actuate`"
            )

    def settle(self, command_v: float, averaged_s: float = 0.5) -> SensorStatistics:
        """Hold a command until pressure and encoder are at rest; return what they then read.

        Rest is defined as in homing. Raises `LimitError` where they do not come to rest.
        """
        homing = self.homing
        before = summarise_samples(self.hold(command_v, 0.5 * homing.steady_s))
        for _ in range(round(2.0 * homing.timeout_s / homing.steady_s)):
            after = summarise_samples(self.hold(command_v, 0.5 * homing.steady_s))
            drift_v = abs(after.sensor_v - before.sensor_v)
            moved = abs(after.counts - before.counts) + after.counts_span
            if drift_v <= homing.steady_v and moved <= homing.steady_counts + 1:
                return summarise_samples(self.hold(command_v, averaged_s))
            before = after
        raise LimitError(
            f"pressure or encoder does not come to rest within {homing.timeout_s:g} s "
            f"(sensor drift {drift_v * 1e3:.1f} mV, encoder {moved:.0f} counts in "
            f"{homing.steady_s / 2:g} s); check the exhaust, the valve and the encoder"
        )

    def gauge_kpa(self, absolute_pa: float) -> float:
        """Pressure above the atmosphere, for people."""
        return (absolute_pa - self.settings.atmospheric_pressure_pa) * 1e-3

    def absolute_pa(self, gauge_kpa: float) -> float:
        """Return the inverse of `gauge_kpa`."""
        return self.settings.atmospheric_pressure_pa + gauge_kpa * 1e3

    def _holding_v(self, target_pa: float, sensor_v: float) -> float:
        wanted_v = HOLD_V_PER_PA * (target_pa - self.pressure_pa(sensor_v))
        return min(max(wanted_v, -self.homing.fill_v), self.homing.fill_v)

    def _watch(self, sample: RawSample) -> None:
        limits, cal = self.limits, self.calibration
        slept_s = self._sleep.slept_ns() * 1e-9
        if slept_s > limits.sample_age_s:
            raise LimitError(
                f"the PC slept for {slept_s:.1f} s with the valve driven; forbid it: {MASK}"
            )
        sensor_v = sample.pressure_v
        absolute_pa = self.pressure_pa(sensor_v)
        if absolute_pa > limits.pressure_pa:
            raise LimitError(
                f"{absolute_pa * 1e-3:.0f} kPa absolute is above limits.pressure_pa "
                f"({limits.pressure_pa * 1e-3:.0f} kPa); check the supply's regulator"
            )
        self._lowest_counts = min(self._lowest_counts, sample.encoder_counts)
        self._highest_counts = max(self._highest_counts, sample.encoder_counts)
        travel_mm = (
            (self._highest_counts - self._lowest_counts) * abs(cal.encoder_m_per_count) * 1e3
        )
        # The muscle's first position is not known, so only its whole travel can be checked.
        if travel_mm > limits.stroke_high_mm - limits.stroke_low_mm:
            raise LimitError(
                f"the encoder has moved {travel_mm:.1f} mm, more than the limits of the stroke; "
                "check limits.stroke_high_mm, the encoder and its scale"
            )
        if limits.sensor_low_v <= sensor_v <= limits.sensor_high_v:
            self._bad_since_ns = None
            return
        now_ns = self._clock.now_ns()
        if self._bad_since_ns is None:
            self._bad_since_ns = now_ns
        if (now_ns - self._bad_since_ns) * 1e-9 >= limits.patience_s:
            raise LimitError(
                f"the pressure sensor gives {sensor_v:.3f} V, outside {limits.sensor_low_v:g} to "
                f"{limits.sensor_high_v:g} V; check its wire and its supply"
            )


@contextmanager
def open_workplace(settings: RunSettings) -> Iterator[Bench]:
    """Hold the device, open the rig, and make a bench of it.

    Raises `RigError` where the device is not available, for instance because a run holds it,
    and `SignalInterrupt` when a signal ends the work.
    """
    clock = build_clock(settings, may_spin=False)
    # Nothing here is fast: the computer's clock paces the work even where a device could.
    rig = build_rig(settings, clock, by_computer=True).rig
    with (
        Interrupts() as interrupts,
        hold_device(settings.rig),
        keep_watchman(settings.rig, rig),
        keep_awake(),
        open_rig(rig),
        interrupts.heed_signals(),
    ):
        yield Bench(rig, clock, settings.rig)


class NoAnswer(Exception):
    """Standard input has ended, or the person said no."""

    exit_code = ExitCode.USAGE


class Terminal:
    """Asks a person, and keeps the rig running while waiting."""

    def __init__(self) -> None:
        """Read lines from standard input as they come."""
        self._buffer = b""

    def say(self, text: str) -> None:
        """Print a remark on standard error; standard output is for results."""
        print(text, file=sys.stderr, flush=True)

    def wait(self, request: str, idle: Callable[[], object]) -> None:
        """Ask for something to be done, and wait for Enter. Raises `NoAnswer`."""
        self._line(f"{request} [Enter]", idle)

    def confirm_done(self, request: str, idle: Callable[[], object]) -> bool:
        """Ask for something to be done; return whether it was. Raises `NoAnswer`."""
        return not self._line(f"{request} [Enter, or s to skip]", idle).lower().startswith("s")

    def number(self, question: str, idle: Callable[[], object]) -> float:
        """Ask for a number until one is given. Raises `NoAnswer`."""
        while True:
            text = self._line(question, idle)
            try:
                value = float(text.replace(",", "."))
            except ValueError:
                value = math.nan
            if math.isfinite(value):
                return value
            self.say(f"'{text}' is not a number")

    def require_yes(self, question: str) -> None:
        """Ask for a yes; raise `NoAnswer` on anything else."""
        if self._line(f"{question} [y/N]", None).lower() not in {"y", "yes"}:
            raise NoAnswer("not confirmed")

    def _line(self, question: str, idle: Callable[[], object] | None) -> str:
        source = sys.stdin.fileno()
        print(f"{question} ", end="", file=sys.stderr, flush=True)
        while b"\n" not in self._buffer:
            if idle is not None:
                idle()
            if select.select([source], [], [], None if idle is None else 0.0)[0]:
                # Without Python's buffer: `select` would not see a second line in it.
                read = os.read(source, 4096)
                if not read:
                    raise NoAnswer("standard input has ended; give the values by options")
                self._buffer += read
        line, _, self._buffer = self._buffer.partition(b"\n")
        return line.decode(errors="replace").strip()
