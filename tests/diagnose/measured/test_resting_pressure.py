"""Zeros that homing left: aligned by the rests, without what the records share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pamctl.diagnose.mend import align_resting_pressure
from pamctl.diagnose.record import Record

ATMOSPHERE_PA, NOISE_PA, AMPLITUDE_PA = 101325.0, 150.0, 3e5


def rest_and_move(
    zero_pa: float,
    seed: int,
    *,
    rest_s: float = 1.0,
    resting_v: float = 0.0,
    leak_pa: float = 0.0,
    decay_pa: float = 0.0,
    noise_pa: float = NOISE_PA,
) -> Record:
    """Rest, then follow a sine. A leak fills the muscle at rest, or it still empties."""
    t_s = np.arange(0.0, 4.0, 1e-3)
    moving_s = np.maximum(t_s - rest_s, 0.0)
    swing = 1.0 - np.cos(2.0 * np.pi * moving_s)
    air_pa = leak_pa * (1.0 - np.exp(-t_s / 0.3)) + decay_pa * np.exp(-t_s / 0.3)
    noise = np.random.default_rng(seed).normal(0.0, noise_pa, len(t_s))
    return Record(
        f"rest-{seed}",
        t_s,
        valve_v=np.where(t_s < rest_s, resting_v, 1.0),
        pressure_pa=ATMOSPHERE_PA + zero_pa + air_pa + AMPLITUDE_PA * swing + noise,
        position_m=0.01 * swing,
    )


def find_shifts(records: list[Record]) -> list[float]:
    """By how much each record's pressure was lowered; the same for all its samples."""
    aligned = align_resting_pressure(records)
    lowered = [r["pressure_pa"] - a["pressure_pa"] for r, a in zip(records, aligned, strict=True)]
    assert all(np.ptp(each) < 1e-6 for each in lowered)
    return [float(each[0]) for each in lowered]


def test_zeros_are_aligned_to_their_median_and_the_common_offset_stays() -> None:
    zeros = (240.0, 160.0, 320.0)
    shifts = find_shifts([rest_and_move(zero, k) for k, zero in enumerate(zeros)])
    # Of 1000 samples the mean is uncertain by 5 Pa, a difference by some 7 Pa.
    assert shifts == pytest.approx([0.0, -80.0, 80.0], abs=20.0)


def test_without_noise_the_difference_goes_to_the_last_pascal() -> None:
    records = [rest_and_move(zero, 0, noise_pa=0.0) for zero in (-20.0, 20.0)]
    assert find_shifts(records) == pytest.approx([-20.0, 20.0], abs=1e-6)


def test_a_shared_leak_is_no_difference_however_long_the_rests_are() -> None:
    """The mean over the longer rest is 34 Pa higher, since the muscle is filled by then."""
    records = [
        rest_and_move(0.0, 1, rest_s=0.5, leak_pa=100.0, noise_pa=1.0),
        rest_and_move(0.0, 2, rest_s=2.0, leak_pa=100.0, noise_pa=1.0),
    ]
    assert find_shifts(records) == pytest.approx([0.0, 0.0], abs=1.0)


@pytest.mark.parametrize(
    "other",
    [
        rest_and_move(0.0, 2, decay_pa=400.0),  # it still empties: no rest
        rest_and_move(700.0, 2),  # more than homing leaves
        rest_and_move(80.0, 2, rest_s=0.05),  # too short to say
        rest_and_move(80.0, 2, resting_v=-5.0),  # an open exhaust: another rest
        replace(rest_and_move(80.0, 2), valve_v=None),  # a pressure that holds may be any
    ],
    ids=["empties", "too far", "too short", "other command", "no command"],
)
def test_what_is_no_matter_of_homing_stays(other: Record) -> None:
    assert find_shifts([rest_and_move(0.0, 1), other]) == [0.0, 0.0]


def test_equal_zeros_are_hardly_moved_by_the_noise_of_the_rests() -> None:
    pairs = [[rest_and_move(0.0, 2 * k), rest_and_move(0.0, 2 * k + 1)] for k in range(40)]
    moved = np.array([find_shifts(pair)[0] for pair in pairs])
    # Half the difference of two means of 1000 samples; what noise explains is not taken off.
    assert np.sqrt(np.mean(moved**2)) < NOISE_PA / np.sqrt(2.0 * 1000)
    assert np.mean(moved == 0.0) > 0.5
