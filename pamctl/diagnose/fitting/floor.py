"""The floor: the residual that a model leaves on data that it generated itself.

A p-value would call every small misfit significant: residuals are autocorrelated, and friction
rectifies the noise of the pressure. Instead the model is simulated on the same commands, with the
same noise, converters and smoothing, and refitted. The residual on the held-out records is then
what a perfect model leaves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pamctl.bounded_memory import BoundedMemory
from pamctl.diagnose.fitting.block_fit import Fit, rms, sensitivity
from pamctl.diagnose.fitting.coarse_steps import coarsen
from pamctl.diagnose.fitting.drives import Drive
from pamctl.diagnose.fitting.repeatability import RepeatSpread
from pamctl.diagnose.measured.noise.sensor_noise import Noise
from pamctl.diagnose.measured.record import Array
from pamctl.plant.model import PlantSettings, plant_parameters

REPLICAS = 12
LIMIT_SIGMAS = 3.0
"""Limit above the mean, in scatters. A short record holds few slow waves, and all may be high; what
a named effect leaves must not count as unexplained for that."""
DEAF = 0.03
"""Where the noise of the inputs moves the output by less, in noises of the output, it is left out:
the floor is then too low by less than half of this squared, 0.05 %."""
PRESSED = 2
"""Stream of the draws for a piston's pressure; 0 is the driving signal's, 1 the output's."""
QUIET = 0.2
"""Share of the stretches that count as quiet, where the noise is unknown."""
FEWEST_IN_STRETCH = 32
LEAST_LEVEL = 1e-9
"""Least floor, in the drive's unit: a perfect model of perfect data leaves nothing at all."""
TOO_FAR = 1e4
"""A signal is at most this far above any floor of a sensor that can be used to model it."""
STRETCH_S = 0.25
"""Residuals this far apart count as independent."""


@dataclass(frozen=True)
class Floor:
    """What a perfect model leaves of one block on the held-out drives."""

    mean: float
    """RMS in deviations of the sensor."""
    scatter: float
    """Standard deviation over the replicas."""
    limit: float
    """A residual above is a discrepancy: the replicas' 95 % quantile or three sigma, and a
    practical margin."""
    shifts: Array
    """How far noise alone moves the fitted numbers, in their scales, shape (replicas, p)."""
    spread: Array
    """RMS of each replica on the held-out drives, shape (replicas,)."""
    memory: float = 1.0
    """Number of samples of such a residual that are worth one independent sample."""
    repeatability: float = 0.0
    """The limit that the rig's own repeatability sets; 0 where nothing is repeated."""
    is_estimate: bool = False
    """The sensor's noise is unknown: the floor is what repeats or quiet stretches suggest."""

    def with_repeatability(self, spread: RepeatSpread) -> Floor:
        """Raise the limit to what the rig itself does differently each time.

        The spread beyond the floor counts with two sigma of its uncertainty. It contains no error
        of the model, which is the same in both runs.
        """
        beyond = float(np.sqrt(max(spread.rms**2 - self.mean**2, 0.0)))
        level = float(np.hypot(self.mean, beyond * (1.0 + 2.0 * spread.uncertainty)))
        level = level if spread.rms else 0.0
        return replace(self, limit=max(self.limit, level), repeatability=level)

    def with_level(self, level: float, limit: float, repeatability: float) -> Floor:
        """Return the floor at another level: the replicas keep their shape, not their size."""
        times = level / self.mean
        return replace(
            self,
            mean=level,
            scatter=self.scatter * times,
            limit=limit,
            shifts=self.shifts * times,
            spread=self.spread * times,
            repeatability=repeatability,
            is_estimate=True,
        )

    @property
    def usual(self) -> float:
        """What a perfect model usually stays below: one sigma above the mean."""
        return self.mean + self.scatter

    @property
    def highest_noise(self) -> float:
        """What noise alone hardly exceeds: three sigma, without any margin."""
        return self.mean + LIMIT_SIGMAS * self.scatter

    @property
    def decided_by(self) -> str:
        """Name what sets the limit: `repeatability`, `quiet stretches` or `self-simulation`."""
        if self.limit == self.repeatability:
            return "repeatability"
        return "quiet stretches" if self.is_estimate else "self-simulation"


def estimate_floor(
    simulated: Floor,
    residual: Array,
    drives: Sequence[Drive],
    repeated: RepeatSpread,
    *,
    margin: float,
    is_doubted: bool = False,
) -> Floor:
    """Return the floor of a block whose sensor's noise is unknown.

    Repeats show it: no model can explain what differs between them. Without repeats, it is what the
    recalibrated model leaves in its quietest stretches, without their trends: noise is in all of
    them, and what the model lacks is not. `residual` is that model's on `drives`. It is not below
    the simulated one, which the noise of the block's input alone may set. The limit allows for how
    the quieter half of the stretches scatters, unless that allowance `is_doubted`.
    """
    if repeated.rms:
        limit = float(np.hypot(repeated.rms * (1.0 + 2.0 * repeated.uncertainty), margin))
        return simulated.with_level(repeated.rms, limit, limit)
    levels = _measure_stretches(residual, drives)
    quiet = float(np.quantile(levels, QUIET))
    scatter = float(levels[levels <= np.median(levels)].std())
    limit = float(np.hypot(quiet + LIMIT_SIGMAS * scatter, margin))
    level = max(quiet, simulated.mean, LEAST_LEVEL)
    if is_doubted:
        return simulated.with_level(level, float(np.hypot(level, margin)), 0.0)
    return simulated.with_level(level, max(limit, simulated.limit), 0.0)


def _measure_stretches(residual: Array, drives: Sequence[Drive]) -> Array:
    """Return the RMS of each stretch of the residuals of several drives, without its trend.

    What the model lacks changes slowly in most stretches, however large it is.
    """
    from scipy.signal import detrend  # most of a second to import

    levels = []
    for drive, part in zip(drives, _split_by_drive(residual, drives), strict=True):
        length = max(int(STRETCH_S / float(np.median(drive.step_s))), FEWEST_IN_STRETCH)
        whole = part[: max(len(part) // length, 1) * length]
        levels += [rms(detrend(s)) for s in np.array_split(whole, max(len(whole) // length, 1))]
    return np.array(levels)


def _split_by_drive(residual: Array, drives: Sequence[Drive]) -> list[Array]:
    return np.split(residual, np.cumsum([drive.samples for drive in drives])[:-1])


def doubt_floor(block: str, ratio: float) -> str:
    """Say that a residual is too far above its floor to be believed; empty where it is not."""
    if ratio < TOO_FAR:
        return ""
    return (
        f"{block}: the residual is {ratio:.3g} times its floor. No model of a rig is that bad: the "
        "floor is wrong. The data may have been filtered, or their noise is not what it seems; "
        "state it with `--noise`, or give the data as they were measured."
    )


def simulate_floor(
    fitted: Fit,
    holdout: Sequence[Drive],
    noises: dict[str, Noise],
    *,
    margin: float,
    replicas: int = REPLICAS,
) -> Floor:
    """Return the floor of one block: simulate with noise, refit, measure the rest on `holdout`.

    A fit of both blocks is refitted on both. `margin` is the smallest excess that matters, in
    deviations of the sensor. The refit is one Gauss-Newton step with the fit's own derivatives:
    noise moves the numbers only a little.
    """
    imitated = imitate_records(fitted, holdout, noises, replicas=replicas)
    spread = np.array([rms(residual) for residual in imitated.residuals])
    mean = float(spread.mean())
    scatter = float(spread.std(ddof=1))
    sensor = sensor_noise_of(holdout, noises)
    high = max(float(np.quantile(spread, 0.95)), mean + LIMIT_SIGMAS * scatter)
    high *= 1.0 + 2.0 * sensor.uncertainty
    limit = float(np.hypot(high, margin))
    return Floor(mean, scatter, limit, imitated.shifts, spread, imitated.memory)


class Imitations(NamedTuple):
    """Replicas of the records: the residuals and the shifts that noise alone causes."""

    residuals: Array
    """On the held-out drives, after the refit, shape (replicas, samples)."""
    shifts: Array
    """Shifts of the fitted numbers, in their scales, shape (replicas, p)."""
    memory: float
    """Number of samples of noise that are worth one independent sample, at least 1."""


_IMITATED: BoundedMemory[Imitations] = BoundedMemory(100_000_000)
"""Floors, regimes and the colour of residuals rest on the same replicas."""


def imitate_records(
    fitted: Fit,
    holdout: Sequence[Drive],
    noises: dict[str, Noise],
    *,
    replicas: int = REPLICAS,
) -> Imitations:
    """Simulate records of the fitted plant with new noise, and refit; the noise is reproducible."""
    made_from = (fitted, noises, *holdout)
    return _IMITATED.recall(
        (replicas, *map(id, made_from)),
        made_from,
        lambda: _imitate_anew(fitted, holdout, noises, replicas),
    )


def _imitate_anew(
    fitted: Fit, holdout: Sequence[Drive], noises: dict[str, Noise], replicas: int
) -> Imitations:
    settings = fitted.settings
    # Both of two simulations have the integrator's error: half the steps do.
    train = [_Imitator(drive, settings, noises) for drive in coarsen(fitted.drives, settings)]
    held = [_Imitator(drive, settings, noises) for drive in coarsen(holdout, settings)]
    slope = sensitivity(holdout, settings, fitted.free)
    residuals, shifts, memories = [], [], []
    for replica in range(replicas):
        noise = np.concatenate([i.draw_residual(replica) for i in held])
        shift = np.zeros(0)
        if fitted.free:
            shift = -fitted.solve(np.concatenate([i.draw_residual(replica) for i in train]))
        residuals.append(noise + slope @ shift)
        shifts.append(shift)
        memories.append(_estimate_memory(noise, holdout))
    return Imitations(np.array(residuals), np.array(shifts), max(float(np.mean(memories)), 1.0))


def sensor_noise_of(drives: Sequence[Drive], noises: dict[str, Noise]) -> Noise:
    """Return the noise of the sensor of a block's output."""
    return noises[drives[0].channel]


def _estimate_memory(residual: Array, drives: Sequence[Drive]) -> float:
    """Return the variance of stretch means times samples per stretch, over that of the samples."""
    length = max(int(STRETCH_S / float(np.median(drives[0].step_s))), 1)
    whole = residual[: len(residual) // length * length].reshape(-1, length)
    return float(np.mean(whole.mean(axis=1) ** 2) * length / np.mean(whole**2))


class _Imitator:
    """One drive of a fitted plant, again and again with new noise."""

    def __init__(self, drive: Drive, settings: PlantSettings, noises: dict[str, Noise]) -> None:
        self.drive, self.noises = drive, noises
        self.p = plant_parameters(settings)
        self.ideal = drive.simulate_with(self.p)
        """Output without noise, shape (n,)."""
        self._is_deaf: bool | None = None
        inner, outer = "position_m", drive.channel
        if outer == "position_m":
            inner = "force_n" if settings.actuator == "direct" else "pressure_pa"
        self._inner, self._outer = inner, outer

    def draw_residual(self, replica: int) -> Array:
        """Return the residual that noise on the inputs and on the output leaves."""
        random = self.drive.random_generator(replica, 1)
        measured = self.noises[self._outer].simulate_sensor(self.ideal, random)
        noisy = replace(self._disturb_inputs(replica), measured=measured)
        if self._is_deaf:
            return noisy.residual_of(self.ideal)
        simulated = noisy.simulate_with(self.p)
        if self._is_deaf is None:
            answer = rms(np.nan_to_num(simulated - self.ideal))
            self._is_deaf = answer < DEAF * rms(measured - self.ideal)
        return noisy.residual_of(simulated)

    def _disturb_inputs(self, replica: int) -> Drive:
        drive = self.drive
        if self._is_deaf:
            return drive
        driven, pressed_pa = drive.driven, drive.pressed_pa
        if self._inner in self.noises:
            driven = driven + drive.draw_disturbance(driven, self.noises[self._inner], replica)
        if pressed_pa is not None and "pressure_pa" in self.noises:
            noise = self.noises["pressure_pa"]
            pressed_pa = pressed_pa + drive.draw_disturbance(pressed_pa, noise, replica, PRESSED)
        return replace(drive, driven=driven, pressed_pa=pressed_pa, is_remembered=False)
