"""What measured columns tell: their steps, what stands in for gaps, speed, an imposed motion."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.evidence.constants import REST_SHARE
from pamctl.diagnose.record import estimate_white_noise
from pamctl.log.record_problems import find_sensor_step
from pamctl.plant.sample_grid import accumulate_times

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SMOOTH_S = 0.05
"""Over which a measured state is smoothed, where a window begins."""
START_ORDER = 4
"""Of the polynomials that find the state where a window begins."""
SPEED_S = 0.3
"""Over which the speed of an imposed motion is measured."""
SPRING_SHARE = 0.2
"""Of the force's span that a spring takes which makes a mechanism forget."""
INERTIA_SHOWS = 1.02
"""The mean square of the force without the acceleration, over that with it, if a mass shows. A
piston that a crank moves has 1.002; a slow carriage with cogging, which its motor moves, 1.07."""


def judge_motion(records: Sequence[Any], actuator: str, period_s: float) -> tuple[bool, bool]:
    """Tell whether a mechanism's motion is imposed, and whether it needs windows, by its force.

    A spring that takes part of the force makes it forget. Without one, a force in which the
    acceleration does not show has not moved the mass: something else did. All columns are smoothed
    alike: what of the force is quicker than the acceleration can show says nothing.
    """
    if actuator != "direct" or any(r.position_m is None for r in records):
        return False, False
    tables, forces = [], []
    for record in records:
        samples_s = accumulate_times(np.diff(record.t_s))

        def smooth(column: Any, samples_s: Array = samples_s) -> dict[str, Array]:
            return find_rates(np.asarray(column, float), period_s, SMOOTH_S, samples_s)

        rates = smooth(record.position_m)
        speed = rates["speed"]
        columns = [rates["push"], speed, rates["smooth"], np.sign(speed), np.ones(len(speed))]
        if record.force_n is not None and record.pressure_pa is not None:
            pressure = smooth(record.pressure_pa)["smooth"]
            columns += [pressure, pressure * np.sign(speed)]
        tables.append(np.column_stack(columns))
        drive = record.force_n if record.force_n is not None else record.pressure_pa
        forces.append(smooth(drive)["smooth"])
    table, force = np.concatenate(tables), np.concatenate(forces)
    table = table / np.maximum(np.abs(table).max(axis=0), 1e-30)
    amounts, _, _, _ = np.linalg.lstsq(table, force, rcond=None)
    less, _, _, _ = np.linalg.lstsq(table[:, 1:], force, rcond=None)
    left2 = [
        float(np.mean((force - t @ a) ** 2)) for t, a in ((table, amounts), (table[:, 1:], less))
    ]
    spring = abs(amounts[2]) * np.ptp(table[:, 2]) / max(float(np.ptp(force)), 1e-30)
    if spring >= SPRING_SHARE:
        return False, False
    has_force = all(r.force_n is not None for r in records)
    shows = amounts[0] > 0.0 and left2[1] > INERTIA_SHOWS * left2[0]
    return has_force and not shows, True


def find_rates(
    position_m: Array, period_s: float, width_s: float, samples_s: Array
) -> dict[str, Array]:
    """Return the smoothed position, its speed and acceleration, of samples at uneven times."""
    from scipy.signal import savgol_filter  # a second to import; a muscle does without

    even_s = np.arange(0.0, samples_s[-1] + period_s, period_s)
    even_m = np.interp(even_s, samples_s, position_m)
    width = min(max(5, round(width_s / period_s) | 1), (len(even_m) - 1) | 1)
    found = {
        name: savgol_filter(even_m, width, 2, deriv=deriv, delta=period_s)
        for deriv, name in enumerate(("smooth", "speed", "push"))
    }
    return {name: np.interp(samples_s, even_s, row) for name, row in found.items()}


def find_starts(position_m: Array, period_s: float, samples_s: Array) -> dict[str, Array]:
    """Return position and speed where windows begin, smoothed no wider than the motion allows.

    Of local polynomials the widest is taken whose speed differs from that of each narrower one by
    no more than the noise of the latter (Lepski's rule): a fixed width is late in a quick motion.
    `speed_error` is the speed's standard deviation, m/s.
    """
    from scipy.signal import savgol_coeffs, savgol_filter

    even_s = np.arange(0.0, samples_s[-1] + period_s, period_s)
    even_m = np.interp(even_s, samples_s, position_m)
    noise_m = max(estimate_white_noise(even_m), find_resolution(position_m) / sqrt(12.0))
    widest = min(round(SMOOTH_S / period_s) | 1, (len(even_m) - 1) | 1)
    widths = [w for w in (7, 9, 13, 19, 27, 37, 51, 71, 101, 141, 201) if w < widest] + [widest]
    narrower = list[tuple[Array, float]]()
    for width in widths:
        order = min(START_ORDER, width - 1)
        row = savgol_coeffs(width, order, deriv=1, delta=period_s)
        speed = savgol_filter(even_m, width, order, deriv=1, delta=period_s)
        differs = (float(np.sqrt(np.mean((speed - s) ** 2))) > 1.5 * n for s, n in narrower)
        if any(differs):
            break
        narrower.append((speed, noise_m * float(np.sqrt(np.sum(row**2)))))
    best = widths[len(narrower) - 1]
    smooth = savgol_filter(even_m, best, min(START_ORDER, best - 1))
    speed, error = narrower[-1]
    found = {"smooth": smooth, "speed": speed, "speed_error": np.full(len(speed), error)}
    return {name: np.interp(samples_s, even_s, row) for name, row in found.items()}


def has_no_speed(speed: Array, samples_s: Array) -> Mask:
    """Tell where a log has no speed: at rest, and where its average goes over a reversal."""
    size = np.abs(speed)
    turns_s = samples_s[np.flatnonzero(np.diff(np.sign(speed)))]
    after = np.searchsorted(turns_s, samples_s)
    turns_s = np.concatenate([[-np.inf], turns_s, [np.inf]])
    apart_s = np.minimum(samples_s - turns_s[after], turns_s[after + 1] - samples_s)
    return np.asarray((size < REST_SHARE * np.quantile(size, 0.95)) | (apart_s < 0.5 * SPEED_S))


# --- samples ---


def find_resolution(row: Array) -> float:
    """Return the step with which a channel was digitised; a millionth of its span if none shows."""
    return find_sensor_step(row) or max(1e-6 * float(np.ptp(row)), 1e-12)


def fill_gone(row: Array, gone: Mask) -> Array:
    """Return a column whose missing samples lie on lines between their neighbours."""
    if not gone.any():
        return row
    if gone.all():
        return np.zeros_like(row)
    at = np.arange(len(row))
    return np.interp(at, at[~gone], row[~gone])


def find_neighbours(masked: Mask, ends: NDArray[np.int64]) -> tuple[Any, Any, Any, Array]:
    """Return the masked samples, their next unmasked ones on either side, and the right's share."""
    at = np.flatnonzero(masked)
    lefts, rights = np.zeros(len(at), dtype=int), np.zeros(len(at), dtype=int)
    for begin, end in pairwise(ends):
        seen = begin + np.flatnonzero(~masked[begin:end])
        mine = (at >= begin) & (at < end)
        if not mine.any():
            continue
        if not len(seen):
            lefts[mine] = rights[mine] = begin
            continue
        place = np.searchsorted(seen, at[mine])
        lefts[mine] = seen[np.maximum(place - 1, 0)]
        rights[mine] = seen[np.minimum(place, len(seen) - 1)]
    lefts = np.where(lefts > at, rights, lefts)
    rights = np.where(rights < at, lefts, rights)
    share = np.where(rights > lefts, (at - lefts) / np.maximum(rights - lefts, 1), 0.0)
    return at, lefts, rights, share
