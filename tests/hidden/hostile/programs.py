"""Three ways to excite a rig, each four records of 8 to 12 s: two to fit, two to judge."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hidden.excitations import (
    REST_S,
    TICK_S,
    Array,
    Excitation,
    fill_and_hold,
    multisine,
    null_staircase,
    square,
    tracking,
)
from hidden.sensors import remember

Records = tuple[list[Excitation], list[Excitation]]


def open_program(seed: int) -> Records:
    """Return an open-loop program: in each record squares, small steps, many sines, holds."""
    return (
        [compose_open(seed, 3.2, 3.8, 2.6), compose_open(seed + 101, 2.2, 3.0, 3.4)],
        [compose_open(seed + 202, 2.0, 3.0, 2.4), compose_open(seed + 303, 1.6, 2.6, 2.6)],
    )


def compose_open(seed: int, small_s: float, sines_s: float, large_s: float) -> Excitation:
    """Return one record of the open program; the lengths are those of its parts."""
    rng = np.random.default_rng([29, seed])
    parts = [
        square(float(rng.choice([0.7, 1.0, 1.4])), 1.6),
        null_staircase(small_s, seed),
        multisine(1.2, 0.4, 60.0, sines_s, seed, bias_v=0.05),
        multisine(3.0, 0.4, 40.0, large_s, seed + 7),
        fill_and_hold(1, 1.2, seed),
    ]
    pieces = [p.volts[round(REST_S / TICK_S) :] for p in parts if p.volts is not None]
    return _rested("open-program", np.concatenate(pieces), seed)


def closed_loop(seed: int) -> Records:
    """Return a position controller's records: steps, and sines on them."""
    runs = [
        replace(tracking(seconds, seed + 101 * k), name=f"closed-loop-{k}")
        for k, seconds in enumerate((11.0, 10.0, 9.0, 8.0))
    ]
    return runs[:2], runs[2:]


def random_levels(seed: int) -> Records:
    """Return random openings for random times, with a shaken command on them."""
    made = [
        shake_levels(seed + 101 * k, seconds) for k, seconds in enumerate((11.0, 10.0, 9.0, 8.0))
    ]
    return made[:2], made[2:]


def shake_levels(seed: int, seconds: float) -> Excitation:
    """Return one record of random levels."""
    rng = np.random.default_rng([31, seed])
    count = round(seconds / TICK_S)
    levels: list[Array] = []
    while sum(map(len, levels)) < count:
        height = rng.choice([0.3, 0.8, 2.0, 5.0]) * rng.uniform(-1.0, 1.0)
        levels.append(np.full(round(rng.gamma(2.0, 0.06) / TICK_S) + 5, height))
    # A first-order lag of 8 ms on white noise.
    shake = remember(0.88, 0.0, np.append(0.0, rng.normal(0.0, 0.12, count - 1)))
    return _rested("random-levels", np.concatenate(levels)[:count] + shake, seed)


def _rested(name: str, volts: Array, seed: int) -> Excitation:
    rest = np.full(round(REST_S / TICK_S), -1.0)
    return Excitation(f"{name}-{seed}", np.concatenate([rest, np.clip(volts, -5, 5)]), seed=seed)


EXCITATIONS: dict[str, Callable[[int], Records]] = {
    "open": open_program,
    "closed": closed_loop,
    "random": random_levels,
}
