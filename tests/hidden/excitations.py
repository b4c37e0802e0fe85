"""Excitations of a hidden rig: the diagnosis program, shorter ones, blind ones, a closed loop."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TICK_S = 1e-3
REST_S = 0.8


@dataclass(frozen=True)
class Excitation:
    """One run at 1 kHz: a command, a position to track, or a force to pull with."""

    name: str
    volts: Array | None = None
    wanted_m: Array | None = None
    force_n: Array | None = None
    rest_s: float = REST_S
    rest_v: float = -1.0
    """A vented valve, so that the muscle rests at the atmosphere even if the valve leaks."""
    gains: tuple[float, float, float, float] = (900.0, 2500.0, 8.0, 3e-6)
    seed: int = field(default=0, compare=False)

    @property
    def samples(self) -> int:
        """The length in ticks."""
        asked = [a for a in (self.volts, self.wanted_m, self.force_n) if a is not None]
        return len(asked[0])


def _clock(seconds: float) -> Array:
    return np.arange(round(seconds / TICK_S)) * TICK_S


def _after_rest(name: str, volts: Array, seed: int = 0, rest_v: float = -1.0) -> Excitation:
    rest = np.full(round(REST_S / TICK_S), rest_v)
    command = np.concatenate([rest, np.clip(volts, -5.0, 5.0)])
    return Excitation(name, command, rest_v=rest_v, seed=seed)


def square(hz: float, seconds: float, volts: float = 5.0, seed: int = 0) -> Excitation:
    """The paper's own test (Sec. VI-A): filled and vented at full opening."""
    t = _clock(seconds)
    return _after_rest(f"square-{hz:g}", np.where((t * hz) % 1.0 < 0.5, volts, -volts), seed)


def multisine(
    volts: float, low_hz: float, high_hz: float, seconds: float, seed: int, bias_v: float = 0.0
) -> Excitation:
    """Twenty-four sines of random phase, evenly spread over the logarithm of frequency."""
    rng = np.random.default_rng([11, seed])
    t = _clock(seconds)
    tones = np.geomspace(low_hz, high_hz, 24) * rng.uniform(0.97, 1.03, 24)
    phases = rng.uniform(0.0, 2.0 * np.pi, 24)
    wave = np.sin(2.0 * np.pi * tones[:, None] * t + phases[:, None]).sum(axis=0)
    wave *= volts / np.abs(wave).max()
    lift = np.where(t < 0.06, 5.0, wave + bias_v)  # first into the middle of the stroke
    return _after_rest(f"multisine-{volts:g}", lift, seed)


def null_staircase(seconds: float, seed: int) -> Excitation:
    """Steps of 0.2 to 1.5 V to either side: where a valve's laps and leaks are seen."""
    rng = np.random.default_rng([13, seed])
    steps = np.array([0.2, 0.35, 0.5, 0.75, 1.0, 1.5])
    volts: list[Array] = [np.full(60, 5.0)]
    while sum(map(len, volts)) < seconds / TICK_S:
        for height in rng.permutation(steps):
            hold = round(rng.uniform(0.15, 0.35) / TICK_S)
            first = rng.choice([-1.0, 1.0])
            volts += [np.full(hold, first * height), np.full(hold, -first * height)]
    return _after_rest("null-staircase", np.concatenate(volts)[: round(seconds / TICK_S)], seed)


def chirp(seconds: float, volts: float = 3.0, high_hz: float = 120.0, seed: int = 0) -> Excitation:
    """A sine from 1 Hz up, even over the logarithm: separates a spool from a delay."""
    t = _clock(seconds)
    rate = np.log(high_hz) / seconds
    wave = volts * np.sin(2.0 * np.pi * np.expm1(rate * t) / rate)
    return _after_rest("chirp", np.where(t < 0.06, 5.0, wave), seed)


def fill_and_hold(levels: int, hold_s: float, seed: int) -> Excitation:
    """Fill by a burst, then close the valve and wait: where leaks and creep are seen."""
    rng = np.random.default_rng([17, seed])
    parts: list[Array] = []
    for _ in range(levels):
        burst = round(rng.uniform(8.0, 45.0))
        parts += [np.full(burst, 5.0), np.zeros(round(hold_s / TICK_S)), np.full(300, -5.0)]
    return _after_rest("fill-and-hold", np.concatenate(parts), seed)


def long_holds(seed: int = 0) -> Excitation:
    """Twenty seconds at each of three pressures, each from the vented muscle."""
    return replace(fill_and_hold(3, 20.0, seed + 100), name="long-holds")


def tracking(seconds: float, seed: int) -> Excitation:
    """A closed loop over steps, ramps and sines: the command carries the sensors' noise."""
    rng = np.random.default_rng([19, seed])
    t = _clock(seconds)
    steps = np.repeat(rng.uniform(4e-3, 17e-3, 60), 1500)[: len(t)]
    tones = sum(
        rng.uniform(0.3e-3, 1.2e-3) * np.sin(2.0 * np.pi * hz * t + rng.uniform(0.0, 6.0))
        for hz in (0.3, 0.9, 2.1, 5.3)
    )
    wanted = np.concatenate([np.zeros(round(REST_S / TICK_S)), steps + tones])
    return Excitation("tracking", wanted_m=np.clip(wanted, 0.0, 20e-3), seed=seed)


def pulling(seconds: float, seed: int, newtons: float = 40.0) -> Excitation:
    """A force on a spring-mass-friction mechanism: slow ramps, sines, rests."""
    rng = np.random.default_rng([23, seed])
    t = _clock(seconds)
    corners = np.concatenate([[0.0, 0.0], rng.uniform(0.1, 1.0, 400)]) * newtons
    holds = np.cumsum(np.concatenate([[0.0, REST_S], rng.choice([0.15, 0.3, 0.8], 400)]))
    ramps = np.interp(t, holds, corners)
    started = np.clip((t - REST_S) / 0.5, 0.0, 1.0)
    tones = sum(
        rng.uniform(0.02, 0.08) * newtons * np.sin(2.0 * np.pi * hz * t + rng.uniform(0.0, 6.0))
        for hz in (0.7, 1.9, 4.7, 9.1)
    )
    return Excitation("pulling", force_n=ramps + started * tones, seed=seed)


Runs = list[Excitation]


def standard(seed: int) -> tuple[Runs, Runs]:
    """Return (train, held-out) of the diagnosis program: a minute, and half of one."""
    train = [
        square(0.5, 4.0, seed=seed),
        square(1.0, 3.0, seed=seed),
        square(2.0, 3.0, seed=seed),
        null_staircase(9.0, seed),
        multisine(1.2, 0.3, 60.0, 9.0, seed, bias_v=0.05),
        multisine(3.0, 0.2, 40.0, 9.0, seed),
        chirp(8.0, seed=seed),
        fill_and_hold(4, 2.5, seed),
    ]
    held_out = [
        square(0.7, 4.0, seed=seed + 1),
        null_staircase(6.0, seed + 1000),
        multisine(2.0, 0.3, 50.0, 8.0, seed + 1000),
        multisine(1.0, 0.3, 50.0, 6.0, seed + 2000, bias_v=0.05),
        fill_and_hold(2, 2.5, seed + 1000),
    ]
    return train, held_out


def full(seed: int) -> tuple[Runs, Runs]:
    """Return the standard program with slow squares, and a minute of long holds on each side."""
    train, held_out = standard(seed)
    train += [square(0.25, 8.0, seed=seed), long_holds(seed)]
    return train, [*held_out, long_holds(seed + 1)]


def short(seed: int) -> tuple[Runs, Runs]:
    """Return a third of the standard program: twenty seconds, and ten."""
    train = [
        square(1.0, 2.0, seed=seed),
        null_staircase(4.0, seed),
        multisine(1.2, 0.3, 60.0, 4.0, seed, bias_v=0.05),
        multisine(3.0, 0.3, 40.0, 4.0, seed),
        fill_and_hold(2, 1.5, seed),
    ]
    held_out = [
        square(1.4, 2.0, seed=seed + 1),
        multisine(1.5, 0.3, 50.0, 4.0, seed + 1000, bias_v=0.05),
        null_staircase(3.0, seed + 1000),
    ]
    return train, held_out


def brief(seed: int) -> tuple[Runs, Runs]:
    """Return the least that shows a large effect: for continuous integration."""
    train = [
        square(1.0, 1.5, seed=seed),
        null_staircase(2.0, seed),
        multisine(2.0, 0.5, 50.0, 2.0, seed, bias_v=0.05),
        fill_and_hold(1, 1.0, seed),
    ]
    held_out = [square(1.4, 1.5, seed=seed + 1), multisine(1.5, 0.5, 50.0, 2.0, seed + 1000)]
    return train, held_out


def squares_only(seed: int) -> tuple[Runs, Runs]:
    """Return the paper's own excitation, which is blind to what happens near the valve's null."""
    train = [square(hz, 4.0, seed=seed) for hz in (0.25, 0.5, 1.0, 2.0)]
    return train, [square(hz, 4.0, seed=seed + 1) for hz in (0.35, 1.4)]


def closed_loop_program(seed: int) -> tuple[Runs, Runs]:
    """Return records of a position controller only."""
    return [tracking(18.0, seed), tracking(18.0, seed + 1)], [tracking(15.0, seed + 2)]


def direct_program(seed: int) -> tuple[Runs, Runs]:
    """Return records of a mechanism that is pulled by a measured force."""
    return [pulling(15.0, seed), pulling(15.0, seed + 1)], [pulling(15.0, seed + 2)]


PROGRAMS = {
    "standard": standard,
    "full": full,
    "short": short,
    "brief": brief,
    "squares": squares_only,
    "closed_loop": closed_loop_program,
    "direct": direct_program,
}
