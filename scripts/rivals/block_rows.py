"""The two blocks of the paper's model as linear equations over measured rows.

What the other methods of the benchmark share. Each block is `target = base @ numbers + effects`:
the target is what the start model leaves, the base are the numbers that a recalibration may move,
and an effect of the catalogue is one or more columns, over a grid where its inner number is not
linear.

The rows are the equations' weak form: both sides are summed over a sliding Hann window, so that no
noisy signal is differentiated and both sides are smoothed alike. The start model is recalibrated
first (three rounds), because its numbers do not enter linearly.

The equations are the paper's (Eq. 1 to 9), written here a third time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

Array = NDArray[np.float64]
Record = Mapping[str, Array]
Numbers = Mapping[str, float]
Columns = dict[str, list[list[Array]]]
"""Name -> forms -> columns, each as increments over the time steps, shape (n - 1,)."""

WINDOW = 16
STRIDE = 8
"""Steps; neighbours share half of their noise at most, so BIC may nearly count them."""
SLOPE_S = 0.005
MOVING_M_PER_S = 3e-3
"""Slower rows say nothing of the mechanics: at rest friction takes any value in its band."""
NEAR_SOURCE_PA = 1e4
"""Nearer to the pressure behind the valve, the flow is a root of the noise."""
ROUNDS = 3


@dataclass(frozen=True)
class Block:
    """One block over all rows of some records."""

    name: str
    target: Array
    """Shape (rows,)."""
    base: Array
    """Shape (rows, numbers)."""
    effects: dict[str, list[Array]]
    """Name -> forms; a form is a matrix of columns, shape (rows, columns)."""
    inputs: Array
    """Physical columns for methods that make their own terms, shape (rows, inputs)."""


def make_blocks(
    train: Sequence[Record], held_out: Sequence[Record], card: Mapping[str, Any]
) -> dict[str, tuple[Block, Block]]:
    """Return the (training, held-out) rows of the blocks that the columns allow, by name."""
    left_out = {*card["names_not_to_use"]}
    measured = {*train[0]}
    if "force_n" in measured:
        makers = {"mechanics": _pull}
    elif not {"pressure_pa", "position_m"} <= measured:
        return {}
    else:
        makers = {"mechanics": _move_muscle}
        if "valve_v" in measured:
            makers = {"pressure": _fill_muscle, **makers}
    blocks = {}
    for name, make in makers.items():
        p = dict(card["start_model"]["parameters"])
        for _ in range(ROUNDS):
            fitted = _join([make(record, p) for record in train], name, left_out)
            scale = np.maximum(np.linalg.norm(fitted.base, axis=0), 1e-300)
            weights = np.linalg.lstsq(fitted.base / scale, fitted.target, rcond=None)[0] / scale
            _recalibrate(p, make, weights)
        blocks[name] = tuple(
            _join([make(record, p) for record in part], name, left_out)
            for part in (train, held_out)
        )
    return blocks  # type: ignore[return-value]


def _recalibrate(p: dict[str, float], make: Any, weights: Array) -> None:
    """Move the numbers by the weights of their columns, by a fifth at most."""
    w = np.clip(weights, -1e9, 1e9)
    if make is _fill_muscle:
        p["valve_gain_m2_per_v"] *= 1 + np.clip(w[0], -0.2, 0.2)
        p["tank_pressure_pa"] *= 1 + 0.01 * np.clip(w[1], -5, 5)
        p["braid_length_m"] *= 1 - 0.001 * np.clip(w[2], -5, 5)
        return
    p["damping_n_s_per_m"] *= 1 + np.clip(w[0] / p["damping_n_s_per_m"], -0.2, 0.2)
    p["stiffness_n_per_m"] *= 1 + np.clip(w[1] / p["stiffness_n_per_m"], -0.2, 0.2)
    if make is _move_muscle:
        p["kinetic_friction_per_m"] *= 1 + np.clip(w[2], -0.2, 0.2)
        p["braid_length_m"] *= 1 - 0.001 * np.clip(w[3], -5, 5)


def _join(parts: list[dict[str, Any]], name: str, left_out: set[str]) -> Block:
    def stack(key: str) -> Array:
        return np.concatenate([rows[key] for rows in parts])

    effects = {
        effect: [
            np.concatenate([r["effects"][effect][k] for r in parts]) for k in range(len(forms))
        ]
        for effect, forms in parts[0]["effects"].items()
        if effect not in left_out
    }
    return Block(name, stack("target"), stack("base"), effects, stack("inputs"))


# --- pressure: d(P V) = R T m dt, Eq. 7 and 8 ----------------------------------------------------


def _fill_muscle(record: Record, p: Numbers) -> dict[str, Any]:
    t, u = record["t_s"], record["valve_v"][:-1]  # a command acts from its sample to the next
    dt, pressure = np.diff(t), middle(record["pressure_pa"])
    rt = p["gas_constant_j_per_kg_k"] * p["temperature_k"]
    braid, gain, tank = p["braid_length_m"], p["valve_gain_m2_per_v"], p["tank_pressure_pa"]
    air = p["atmospheric_pressure_pa"]
    volume = _volume(p, record["position_m"], braid)
    inside = np.diff(record["pressure_pa"] * volume) / rt

    def flow(opening: Array, tank_pa: float = tank, critical: float = 0.0) -> Array:
        fill = np.maximum(opening, 0.0) * psi(
            p, np.full_like(pressure, tank_pa), pressure, critical
        )
        vent = np.maximum(-opening, 0.0) * psi(p, pressure, np.full_like(pressure, air), critical)
        return np.asarray(gain * dt * (fill - vent))

    plain = flow(u)
    filled = flow(np.maximum(u, 0.0)) / dt

    def opened(opening: Array) -> Array:
        return flow(opening) - plain

    mean_flow = mean_over(plain / dt, 5)
    # From the model: the measured increments hold the noise that the target holds.
    smooth = mean_over(record["position_m"], WINDOW + 1)
    growth = np.diff(_volume(p, smooth, braid)) / rt
    rise = (plain - pressure * growth) / middle(volume)
    wider = _volume(p, smooth, 1.001 * braid) - _volume(p, smooth, braid)
    braided = rise * middle(wider) + pressure * np.diff(wider) / rt
    base = [plain, flow(u, 1.01 * tank) - plain, braided]
    effects: Columns = {
        "valve_deadband": [
            [opened(np.maximum(u - w, 0) + np.minimum(u, 0)),
             opened(np.minimum(u + w, 0) + np.maximum(u, 0))]
            for w in (0.05, 0.1, 0.15, 0.25, 0.4, 0.6)
        ],
        "valve_asymmetry": [[flow(np.minimum(u, 0.0))]],
        "valve_saturation": [[opened(np.clip(u, -5 + w, 5 - w))] for w in (0.2, 0.6, 1.2, 2.0)],
        "valve_curve": [[flow(u * np.abs(u))]],
        "valve_spool": [[opened(lag(dt, u, s))] for s in (0.5e-3, 1e-3, 2e-3, 4e-3, 8e-3)],
        "command_delay": [[opened(delay(dt, u, s))] for s in (0.5e-3, 1e-3, 2e-3, 3e-3, 5e-3)],
        "valve_hysteresis": [[opened(play(u, w))] for w in (0.03, 0.1, 0.2, 0.3, 0.5)],
        "valve_leak": [
            [flow(near) + flow(-near)]
            for near in (np.ones_like(u), np.maximum(1.0 - np.abs(u) / 1.5, 0.0))
        ],
        "chamber_leak": [[flow(-np.ones_like(u))]],
        "discharge_ratio": [[flow(u, tank, c) - plain] for c in (0.2, 0.3, 0.4, 0.5)],
        "supply_droop": [[(flow(u, 0.99 * tank) - plain) * lag(dt, filled, s) * 1e3]
                         for s in (1e-4, 0.03, 0.1, 0.3, 1.0)],
        "line_restriction": [[plain * np.abs(mean_flow) * 1e3]],
        "dead_volume": [[rise]],
        "polytropic": [[pressure * growth]],
        "pressure_sensor_lag": [[np.gradient(rise) * middle(volume)]],
        "pressure_sensor_gain": [[plain - air * growth]],
        "pressure_sensor_offset": [[growth]],
    }  # fmt: skip
    source = np.where(u > 0, tank, air)
    clear = (u == 0) | (np.abs(mean_over(pressure, 5) - source) > NEAR_SOURCE_PA)
    inputs = [u, (pressure - air) / 1e5, middle(record["position_m"]) * 1e3]
    return _sum_windows(clear, inside - plain, base, effects, inputs)


def psi(p: Numbers, upstream: Array, downstream: Array, critical: float = 0.0) -> Array:
    """Return the mass flow per area of Eq. 8; with a `critical` ratio, ISO 6358's ellipse."""
    gamma = p["heat_capacity_ratio"]
    rt = p["gas_constant_j_per_kg_k"] * p["temperature_k"]
    ratio = np.clip(downstream / upstream, 0.0, 1.0)
    choked = np.sqrt(gamma / rt) * (2 / (gamma + 1)) ** ((gamma + 1) / (2 * (gamma - 1)))
    if critical:
        share = np.clip((ratio - critical) / (1 - critical), 0.0, 1.0)
        return np.asarray(choked * upstream * np.sqrt(1 - share**2))
    sonic = (2 / (gamma + 1)) ** (gamma / (gamma - 1))
    r = np.maximum(ratio, sonic)
    subsonic = np.sqrt(2 * gamma / ((gamma - 1) * rt))
    drop = np.maximum(1 - r ** ((gamma - 1) / gamma), 0.0)
    return np.asarray(upstream * subsonic * r ** (1 / gamma) * np.sqrt(drop))


def _volume(p: Numbers, x: Array, braid: float) -> Array:
    length = p["rest_length_m"] - x
    return np.asarray(length * (braid**2 - length**2) / (4 * np.pi * p["braid_turns"] ** 2))


# --- mechanics: M dv = (P_g A(x) - k x - friction) dt - c dx, Eq. 3 to 6 -------------------------


def _move_muscle(record: Record, p: Numbers) -> dict[str, Any]:
    dt, x, moved = (
        np.diff(record["t_s"]),
        middle(record["position_m"]),
        np.diff(record["position_m"]),
    )
    gauge = middle(record["pressure_pa"]) - p["atmospheric_pressure_pa"]
    v = slope(record["t_s"], record["position_m"])
    up = (middle(v) > 0).astype(float)
    length, braid = p["rest_length_m"] - x, p["braid_length_m"]

    def area(braid: float) -> Array:
        return np.asarray((3 * length**2 - braid**2) / (4 * np.pi * p["braid_turns"] ** 2))

    contact = p["kinetic_friction_per_m"] * p["braid_count"] * p["braid_contact_area_m2"]
    grip = contact * np.maximum(gauge, 0.0)
    kinetic = grip * length * np.arccos(np.clip(length / braid, -1, 1)) * dt
    friction = up * (kinetic + grip * moved)
    force = gauge * area(braid) * dt
    widened = gauge * (area(1.001 * braid) - area(braid)) * dt
    inertia = p["mass_kg"] * np.diff(v)
    left = force - p["stiffness_n_per_m"] * x * dt - p["damping_n_s_per_m"] * moved
    base = [moved, x * dt, friction, widened]
    # The pressure that the motion asks for: the measured one holds the noise of the target.
    balanced = (p["stiffness_n_per_m"] * x + p["damping_n_s_per_m"] * middle(v)) / area(braid)
    balanced = balanced + up * kinetic / (dt * area(braid))
    effects = _list_mechanical(dt, x, middle(v))
    effects |= {
        "presliding": [[bristle(x, s) * kinetic - up * kinetic] for s in (5e-6, 2e-5, 5e-5, 2e-4)],
        "stribeck": [
            [kinetic * np.exp(-((middle(v) / s) ** 2)) * up] for s in (2e-3, 5e-3, 1e-2, 2e-2)
        ],
        "return_friction": [[kinetic * (1 - up)]],
        "pressure_damping": [[gauge * moved]],
        "bladder_threshold": [[area(braid) * dt]],
        "braid_stretch": [[gauge * widened]],
        "end_cap": [[balanced * length * dt]],
        "pressure_sensor_offset": [[area(braid) * dt]],
        "pressure_sensor_lag": [[np.gradient(mean_over(balanced, 5)) * area(braid)]],
        "encoder_scale": [[balanced * x * dt]],
    }
    moving = np.abs(middle(v)) > MOVING_M_PER_S
    inputs = [gauge / 1e5, x * 1e3, middle(v) * 1e2, np.sign(middle(v))]
    return _sum_windows(moving, left - friction - inertia, base, effects, inputs)


def _pull(record: Record, p: Numbers) -> dict[str, Any]:
    dt, x, moved = (
        np.diff(record["t_s"]),
        middle(record["position_m"]),
        np.diff(record["position_m"]),
    )
    v = slope(record["t_s"], record["position_m"])
    left = (middle(record["force_n"]) - p["stiffness_n_per_m"] * x) * dt
    left -= p["damping_n_s_per_m"] * moved + p["mass_kg"] * np.diff(v)
    effects = _list_mechanical(dt, x, middle(v))
    effects["presliding"] = [[(2 * bristle(x, s) - 1) * dt] for s in (5e-6, 2e-5, 5e-5, 2e-4)]
    inputs = [x * 1e3, middle(v) * 1e2, np.sign(middle(v))]
    base = [moved, x * dt, np.diff(v)]
    moving = np.abs(middle(v)) > MOVING_M_PER_S
    return _sum_windows(moving, left, base, effects, inputs)


def _list_mechanical(dt: Array, x: Array, v: Array) -> Columns:
    return {
        "coulomb_friction": [[np.sign(v) * dt]],
        "cubic_stiffness": [[(x * 1e2) ** 3 * dt]],
        "creep": [[(x - lag(dt, x, s)) * 1e3 * dt] for s in (0.3, 0.6, 1.0, 2.0, 4.0)],
        "external_load": [[dt]],
        "encoder_backlash": [[(play(x, w) - x) * 1e3 * dt] for w in (1e-5, 3e-5, 1e-4, 2e-4)],
    }


# --- operators on the steps of a record --------------------------------------------------------


def middle(values: Array) -> Array:
    """Return the means of neighbours: values in the middle of each step, shape (n - 1,)."""
    return np.asarray(0.5 * (values[1:] + values[:-1]))


def mean_over(values: Array, rows: int) -> Array:
    """Return centred means over an odd number of rows."""
    padded = np.pad(values, rows // 2, mode="edge")
    return np.convolve(padded, np.full(rows, 1.0 / rows), mode="valid")


def slope(t: Array, values: Array) -> Array:
    """Return the slopes of centred straight lines over `SLOPE_S`, shape of `values`."""
    period = float(np.median(np.diff(t)))
    n = max(round(SLOPE_S / period) | 1, 3)
    k = np.arange(n) - n // 2
    padded = np.pad(values, n // 2, mode="edge")
    return np.asarray(np.convolve(padded, (k / (k @ k))[::-1], mode="valid") / period)


def lag(dt: Array, values: Array, time_s: float) -> Array:
    """Return the means over each step of a first-order lag of held values."""
    ratio = float(np.median(dt)) / time_s
    keep = float(np.exp(-ratio))
    ends = np.asarray(lfilter([1 - keep], [1, -keep], values, zi=np.array([keep * values[0]]))[0])
    starts = np.concatenate([values[:1], ends[:-1]])
    return np.asarray(values + (starts - values) * (1 - keep) / ratio)


def delay(dt: Array, values: Array, time_s: float) -> Array:
    """Return the means over each step of held values that come later."""
    steps = time_s / float(np.median(dt))
    whole, share = int(steps), steps - int(steps)
    padded = np.concatenate([np.full(whole + 1, values[0]), values])
    n = len(values)
    return np.asarray((1 - share) * padded[1 : 1 + n] + share * padded[:n])


def play(values: Array, width: float) -> Array:
    """Return a play operator's output: it follows at half a width."""
    out, now, half = np.empty_like(values), float(values[0]), 0.5 * width
    for k, value in enumerate(values.tolist()):
        now = min(max(now, value - half), value + half)
        out[k] = now
    return out


def bristle(x: Array, length: float) -> Array:
    """Return friction as a share of its level, 0 to 1: a bristle that bends over a length."""
    out, bent = np.empty_like(x), 0.0
    for k, moved in enumerate(np.diff(x, prepend=x[0]).tolist()):
        bent = min(max(bent + moved / length, 0.0), 1.0)
        out[k] = bent
    return out


def _sum_windows(
    kept: NDArray[np.bool_], target: Array, base: list[Array], effects: Columns, inputs: list[Array]
) -> dict[str, Any]:
    """Sum increments over Hann windows in which every step is kept; inputs are averaged."""
    hann = np.hanning(WINDOW + 2)[1:-1]
    starts = np.arange(0, len(target) - WINDOW, STRIDE)
    starts = starts[[bool(kept[k : k + WINDOW].all()) for k in starts]]
    rows = starts[:, None] + np.arange(WINDOW)

    def sum_up(columns: list[Array]) -> Array:
        return np.stack([column[rows] @ hann for column in columns], axis=1)

    return {
        "target": sum_up([target])[:, 0],
        "base": sum_up(base),
        "effects": {n: [sum_up(form) for form in forms] for n, forms in effects.items()},
        "inputs": sum_up(inputs) / hann.sum(),
    }
