"""The effects' equations written a second time, for SciPy's solvers; nothing of `pamctl.plant`.

Each block is driven as the drives are: by a command or a pressure, the other's signal straight
between samples. Friction at rest is taken as events, as in `paper_equations`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import support.equations.paper_equations as paper

Array = NDArray[np.float64]
RT = paper.R * paper.T


class Hidden:
    """What is switched on: values by their flat names, 0 (or 1) for all others."""

    def __init__(self, values: Mapping[str, float]) -> None:
        self._values = values

    def __call__(self, name: str, neutral: float = 0.0) -> float:
        return self._values.get(name, neutral)


def straight(at: float, samples: list[float]) -> float:
    """A signal between its samples, `at` counted in them: one value, for which numpy is slow."""
    before = min(int(at), len(samples) - 2)
    share = at - before
    return (1.0 - share) * samples[before] + share * samples[before + 1]


# --- the pressure block -----------------------------------------------------------------------


def arrivals(e: Hidden, command_v: Sequence[float], tick_s: float) -> list[tuple[float, float]]:
    """(time, command) of every change at the driver, delay and play done."""
    changes = [(0.0, command_v[0])]
    for k in range(1, len(command_v)):
        if command_v[k] != command_v[k - 1]:
            changes.append((k * tick_s + e("command_delay.delay_s"), command_v[k]))
    slack, played, spool_v = 0.5 * e("valve_hysteresis.width_v"), [], 0.0
    limit = 5.0 - e("valve_saturation.shortfall_v")
    for t, u in changes:
        u += e("null_offset.offset_v")
        if limit < 5.0:
            u = max(-limit, min(limit, u))
        if abs(u - spool_v) > slack:
            spool_v = u - math.copysign(slack, u - spool_v)
        played.append((t, spool_v))
    return played


def slewed(
    changes: Sequence[tuple[float, float]], slowness: float
) -> tuple[list[float], list[float]]:
    """Corners (times, volts) of a spool that needs `slowness` for each volt."""
    times, volts, now = [0.0], [0.0], 0.0
    for (t, goal), until in zip(changes, [*(t for t, _ in changes[1:]), math.inf], strict=True):
        reached = min(t + slowness * abs(goal - now), until)
        times.append(t)
        volts.append(now)
        now += math.copysign((reached - t) / slowness, goal - now)
        times.append(reached)
        volts.append(now)
    return times, volts


def area_m2(e: Hidden, spool_v: float, t: float) -> float:
    """Opening, positive to the tank."""
    lap = e("valve_deadband.fill_width_v") if spool_v > 0 else e("valve_deadband.exhaust_width_v")
    travel = max(0.0, abs(spool_v) - lap)
    if travel == 0.0:
        return 0.0
    travel *= 1 + e("valve_curve.curvature_per_v") * travel
    bare = max(0.0, abs(spool_v) - lap)
    travel *= (bare / 5.0) ** (e("valve_curve.exponent", 1.0) - 1.0)
    if spool_v < 0:
        travel *= e("valve_asymmetry.exhaust_gain", 1.0)
    gain = paper.K_AV * (1 + e("drift.valve_gain_per_s") * t)
    return math.copysign(gain * travel, spool_v)


def jet(e: Hidden, up: float, down: float) -> float:
    """Flow per area, either way; the unchoked branch moved to begin at b."""
    if down > up:
        return -jet(e, down, up)
    b = paper.CRITICAL_RATIO + e("discharge_ratio.shift")
    ratio = down / up
    if ratio <= b:
        return paper.psi(up, 0.0)
    share = (ratio - b) / (1 - b)
    return paper.psi(up, up * (paper.CRITICAL_RATIO + share * (1 - paper.CRITICAL_RATIO)))


def room(e: Hidden, x: float, pressure: float) -> float:
    length = paper.L_0 - x - e("end_cap.length_m")
    braid = paper.B * (1 + e("braid_stretch.compliance_per_pa") * (pressure - paper.P_ATM))
    volume = length * (braid**2 - length**2) / (4 * math.pi * paper.TURNS**2)
    return volume + e("dead_volume.volume_m3")


def pressure_of(e: Hidden, air: float, x: float) -> float:
    """P from P V^a."""
    a = e("polytropic.exponent", 1.0)
    if e("braid_stretch.compliance_per_pa") == 0.0:
        return air / room(e, x, paper.P_ATM) ** a
    return float(brentq(lambda p: p * room(e, x, p) ** a - air, 5e4, 1e6, xtol=1e-9, rtol=1e-14))


def valve_flows(e: Hidden, area: float, spool_v: float, supply: float, node: float) -> Any:
    """(out of the supply, into the node)."""
    leak = e("valve_leak.area_m2") / (1 + e("valve_leak.fade_per_v") * abs(spool_v))
    taken = (max(area, 0.0) + leak) * jet(e, supply, node)
    return taken, taken - (max(-area, 0.0) + leak) * jet(e, node, paper.P_ATM)


def regulated(e: Hidden, t: float) -> float:
    """What the regulator holds."""
    swing = 2 * math.pi * e("supply_ripple.frequency_hz", 1.0) * t + e("supply_ripple.phase_rad")
    return paper.P_TANK + e("supply_ripple.amplitude_pa") * math.sin(swing)


def supply_at(e: Hidden, area: float, spool_v: float, node: float, tank: float) -> float:
    """The tank's pressure; without a tank what a regulator leaves at this flow."""
    resistance = e("supply_droop.resistance_pa_s_per_kg")
    if resistance == 0.0 or e("supply_droop.refill_time_s") > 0.0:
        return tank

    def miss(s: float) -> float:
        return s + resistance * valve_flows(e, area, spool_v, s, node)[0] - paper.P_TANK

    return float(brentq(miss, min(node, paper.P_TANK) - 1.0, paper.P_TANK + 1.0, xtol=1e-7))


def node_at(e: Hidden, area: float, spool_v: float, muscle: float, tank: float) -> float:
    """The line's valve end where it has no volume."""
    laminar = e("line_restriction.resistance_pa_s_per_kg")
    turbulent = e("line_restriction.turbulent_pa_s2_per_kg2")
    if laminar == 0.0 and turbulent == 0.0:
        return muscle

    def miss(n: float) -> float:
        s = supply_at(e, area, spool_v, n, tank)
        flow = valve_flows(e, area, spool_v, s, n)[1]
        rough = 2.0 * paper.P_ATM * turbulent * flow * abs(flow)
        lost = math.sqrt(max(muscle**2 + rough, 0.0)) - muscle
        return n - muscle - laminar * flow - lost

    return float(brentq(miss, 0.5e5, 6e5, xtol=1e-7))


def solve_pressure(
    values: Mapping[str, float], command_v: Sequence[float], position_m: Array, tick_s: float
) -> Array:
    """The sensed pressure at the samples, from the vented muscle."""
    e = Hidden(values)
    samples_s = np.arange(len(command_v)) * tick_s
    a = e("polytropic.exponent", 1.0)
    tau = e("valve_spool.time_constant_s")
    line_m3 = e("line_restriction.volume_m3")
    resistance = e("line_restriction.resistance_pa_s_per_kg")
    lag = e("pressure_sensor_lag.time_constant_s")
    fast = e("supply_droop.fast_share")
    swings = e("supply_ripple.amplitude_pa") != 0.0

    shown_m = position_m.tolist()

    def x_at(t: float) -> float:
        return straight(t / tick_s, shown_m)

    def rates(t: float, y: Array, pushed: float) -> list[float]:
        air, tank, line_air, spool_v, spool_rate, shown, branch = y.tolist()
        tank -= branch
        spool_acc = 0.0
        if slowness > 0.0:
            pushed = float(np.interp(t, *corners))
        if swings:
            tank = regulated(e, t)
        if tau > 0.0:
            spool_acc = (pushed - spool_v) / tau**2
            spool_acc -= 2 * e("valve_spool.damping_ratio", 0.7) / tau * spool_rate
        else:
            spool_v = pushed
        area, x = area_m2(e, spool_v, t), x_at(t)
        muscle = pressure_of(e, air, x)
        has_node = resistance > 0.0 and line_m3 > 0.0
        node = line_air / line_m3 if has_node else node_at(e, area, spool_v, muscle, tank)
        supply = supply_at(e, area, spool_v, node, tank)
        taken, entering = valve_flows(e, area, spool_v, supply, node)
        into = (node - muscle) / resistance if has_node else entering
        lost = e("chamber_leak.area_m2") * jet(e, muscle, paper.P_ATM)
        worth = a * room(e, x, muscle) ** (a - 1)
        refill = e("supply_droop.refill_time_s")
        drop = e("supply_droop.resistance_pa_s_per_kg") * taken
        return [
            RT * (into - lost) * worth,
            (paper.P_TANK - (1 - fast) * drop - tank - branch) / refill if refill > 0.0 else 0.0,
            RT * (entering - into) if has_node else 0.0,
            spool_rate,
            spool_acc,
            (node - shown) / lag if lag > 0.0 else 0.0,
            (fast * drop - branch) / (0.1 * refill) if fast > 0.0 else 0.0,
        ]

    x0 = float(position_m[0])
    y = np.array(
        [
            paper.P_ATM * room(e, x0, paper.P_ATM) ** a,
            paper.P_TANK,
            paper.P_ATM * line_m3,
            0.0,
            0.0,
            paper.P_ATM,
            0.0,
        ]
    )
    changes = [*arrivals(e, command_v, tick_s), (math.inf, 0.0)]
    slowness = e("valve_slew.slowness_s_per_v")
    corners = slewed(changes[:-1], slowness) if slowness > 0.0 else ([], [])
    kinks = [*(t for t, _ in changes), *(round(t, 9) for t in corners[0])]
    cuts = sorted({*samples_s.tolist(), *[t for t in kinks if 0 < t < samples_s[-1]]})
    shown: list[float] = []
    pushed = changes[0][1]
    tolerance = np.array([1e-7, 1e-3, 1e-8, 1e-9, 1e-6, 1e-3, 1e-3])
    for i, t in enumerate(cuts):
        pushed = next(u for (_, u), (until, _) in pairwise(changes) if until > t + 1e-12)
        if np.isclose(samples_s, t, atol=1e-12).any():
            muscle = pressure_of(e, y[0], x_at(t))
            before = shown_v = y[3] if tau > 0.0 else pushed_before(changes, t)
            node = muscle
            if resistance > 0.0 and line_m3 > 0.0:
                node = y[2] / line_m3
            elif resistance > 0.0 and i:
                node = node_at(e, area_m2(e, shown_v, t), before, muscle, y[1])
            sensed = y[5] if lag > 0.0 else node
            gain = e("pressure_sensor_gain.gain", 1.0)
            shown.append(
                paper.P_ATM + gain * (sensed - paper.P_ATM) + e("pressure_sensor_offset.offset_pa")
            )
        if i + 1 < len(cuts):
            piece = solve_ivp(
                rates, (t, cuts[i + 1]), y, "LSODA", args=(pushed,), rtol=1e-8, atol=tolerance
            )
            assert piece.success, piece.message
            y = piece.y[:, -1]
    return np.array(shown)


def pushed_before(changes: Sequence[tuple[float, float]], t: float) -> float:
    """What stood at the spool just before t."""
    return [u for since, u in changes if since < t - 1e-12 or since == 0.0][-1]


# --- the mechanics ------------------------------------------------------------------------------


class Mechanics:
    """Eq. 4 to 6 with the effects, under a pressure that is straight between samples."""

    def __init__(self, values: Mapping[str, float], pressure_pa: Array, tick_s: float) -> None:
        self.e = Hidden(values)
        self.samples_s = np.arange(len(pressure_pa)) * tick_s
        self.tick_s = tick_s
        self.pressure_pa = pressure_pa.tolist()
        e = self.e
        self.mass = paper.M + e("moving_mass.added_kg")
        self.stiff = e("creep.stiffness_n_per_m")
        self.bristles = e("presliding.compliance_m_per_n") > 0.0

    def gauge(self, t: float) -> float:
        return straight(t / self.tick_s, self.pressure_pa) - paper.P_ATM

    def net(self, t: float, y: Array) -> float:
        """Everything but friction and damping."""
        e, x, p = self.e, float(y[0]), self.gauge(t)
        length = paper.L_0 - e("end_cap.length_m") - x
        braid = paper.B * (1 + e("braid_stretch.compliance_per_pa") * p)
        pull = max(0.0, p - e("bladder_threshold.pressure_pa")) if p > 0 else p
        if e("bladder_threshold.pressure_pa") == 0.0:
            pull = p
        force = pull * (3 * length**2 - braid**2) / (4 * math.pi * paper.TURNS**2)
        force -= paper.K * (1 + e("drift.stiffness_per_s") * t) * x
        force -= e("cubic_stiffness.n_per_m3") * x**3 + e("external_load.force_n")
        force += e("piston.area_m2") * p
        fast = e("creep.fast_share")
        force -= e("spring_hysteresis.force_n") * float(y[5])
        return force - self.stiff * ((1 - fast) * (x - float(y[2])) + fast * (x - float(y[3])))

    def grip(self, t: float, x: float) -> float:
        slower = 1 + self.e("drift.friction_per_s") * t
        slower *= 1 + self.e("position_friction.share_per_m") * x
        return slower * paper.MU_K * paper.BRAIDS * paper.A_B * max(0.0, self.gauge(t))

    def band(self, t: float, x: float, v: float) -> tuple[float, float]:
        e = self.e
        length = paper.L_0 - e("end_cap.length_m") - x
        kinetic = self.grip(t, x) * length * math.acos(length / paper.B)
        rise = 1.0
        if e("stribeck.rise"):
            speed = abs(v) / e("stribeck.speed_m_per_s", 5e-3)
            rise += e("stribeck.rise") * math.exp(-(speed ** e("stribeck.exponent", 2.0)))
        dry = e("coulomb_friction.force_n") + e("pressure_friction.n_per_pa") * max(
            0.0, self.gauge(t)
        )
        tilt = rise * e("friction_asymmetry.share")
        lower = e("return_friction.share") * kinetic + dry
        return -(rise - tilt) * lower, (rise + tilt) * (kinetic + dry)

    def damping(self, t: float, x: float, up: bool) -> float:
        c = paper.C + self.e("pressure_damping.per_pa") * max(0.0, self.gauge(t))
        tilt = self.e("viscous_asymmetry.share")
        return c * (1 + tilt) + self.grip(t, x) if up else c * (1 - tilt)

    def rates(self, t: float, y: Array, mode: str) -> list[float]:
        x, v, slow, fast, bristle, loop = y.tolist()
        tau = self.e("creep.time_constant_s", 1.0)
        lags = [(x - slow) / tau, (x - fast) / (0.1 * tau)]
        if mode == "stick":
            return [0.0, 0.0, *lags, 0.0, 0.0]
        up = v > 0 if mode == "bristles" else mode == "up"
        low, high = self.band(t, x, v)
        damping, bends = self.damping(t, x, up), 0.0
        friction = high if up else low
        if mode == "bristles":
            sigma, form = 1 / self.e("presliding.compliance_m_per_n"), self.e("presliding.form")
            friction = min(max(bristle, low), high)
            width, limit = max(high - low, 1e-9), high if up else low
            bends = sigma * v * abs(limit - friction) / width
            if form == 2.0:
                sigma_1 = self.e("presliding.bristle_damping_n_s_per_m")
                damping += sigma_1 * abs(limit - friction) / width
            bends += 1e5 * (friction - bristle)  # the band has moved past it
        loops = (math.copysign(1.0, v) - loop) * abs(v) / self.e("spring_hysteresis.way_m", 1e-3)
        return [v, (self.net(t, y) - friction - damping * v) / self.mass, *lags, bends, loops]

    def solve(self) -> Array:
        """The displacement at the samples, from the muscle at rest."""
        if self.bristles and self.e("presliding.form") in (0.0, 3.0):
            # Backward Euler is of first order: two step sizes take its error away.
            fine, coarse = self.solve_by_small_steps(2e-5), self.solve_by_small_steps(4e-5)
            return 2.0 * fine - coarse
        mode = "bristles" if self.bristles else "stick"
        x0 = -self.e("external_load.force_n") / paper.K
        y = np.array([x0, 0.0, x0, x0, 0.0, 0.0])
        seen = [x0]
        for begin, end in pairwise(self.samples_s):
            t = float(begin)
            for _ in range(50):
                if t >= end:
                    break
                t, y, mode = self.piece(t, float(end), y, mode)
            seen.append(float(y[0]))
        return np.array(seen)

    def solve_by_small_steps(self, step_s: float) -> Array:
        """Springs on sliders: backward Euler; in each step some bend and some slide."""
        bands = [1.0]
        if self.e("presliding.form") == 3.0:
            others = ("second", "third", "fourth")
            bands += [self.e(f"presliding.{name}_over_first", 1.0) for name in others]
        count = len(bands)
        sigma = 1 / self.e("presliding.compliance_m_per_n") / count
        shares = [band / sum(bands) for band in bands]
        y, springs, seen = np.zeros(6), [0.0] * count, [0.0]
        tick_s = float(self.samples_s[1])
        for k in range(1, len(self.samples_s)):
            for i in range(round(tick_s / step_s)):
                t = (k - 1) * tick_s + (i + 1) * step_s
                low, high = self.band(t, float(y[0]), 0.0)
                pushed = self.mass / step_s * y[1] + self.net(t, y)
                held = [
                    min(max(f, s * low), s * high) for f, s in zip(springs, shares, strict=True)
                ]
                up = pushed > sum(held)
                sliding = self.mass / step_s + paper.C + (self.grip(t, float(y[0])) if up else 0.0)
                v = self.speed_on_springs(
                    pushed, sliding, springs, shares, (low, high), sigma * step_s
                )
                springs = self.dragged(springs, shares, (low, high), sigma * step_s * v)
                y[1] = v
                y[0] += step_s * v
            seen.append(float(y[0]))
        return np.array(seen)

    @staticmethod
    def dragged(
        springs: list[float], shares: list[float], band: tuple[float, float], bent: float
    ) -> list[float]:
        """Each spring bends, and slides where its share of the band ends."""
        low, high = band
        return [min(max(f + bent, s * low), s * high) for f, s in zip(springs, shares, strict=True)]

    def speed_on_springs(
        self,
        pushed: float,
        sliding: float,
        springs: list[float],
        shares: list[float],
        band: tuple[float, float],
        bend_per_speed: float,
    ) -> float:
        """The speed at which the springs hold what pushes; which of them slide is found in turn."""
        v = (pushed - sum(springs)) / (sliding + len(springs) * bend_per_speed)
        for _ in range(2 * len(springs) + 1):
            ends = self.dragged(springs, shares, band, bend_per_speed * v)
            bends = [
                abs(e - f - bend_per_speed * v) < 1e-12 for e, f in zip(ends, springs, strict=True)
            ]
            held = sum(f if b else e for e, f, b in zip(ends, springs, bends, strict=True))
            again = (pushed - held) / (sliding + sum(bends) * bend_per_speed)
            if again == v:
                break
            v = again
        return v

    def piece(self, begin: float, end: float, y: Array, mode: str) -> tuple[float, Array, str]:
        events: list[Callable[..., float]] = []
        if mode == "stick":
            events = [
                lambda t, z, m: self.net(t, z) - self.band(t, float(z[0]), 0.0)[1] - 1e-9,
                lambda t, z, m: self.band(t, float(z[0]), 0.0)[0] - self.net(t, z) - 1e-9,
            ]
            for event, next_mode in zip(events, ("up", "down"), strict=True):
                if event(begin, y, mode) > 0.0:
                    return begin, y, next_mode
        elif mode != "bristles":
            sign = -1.0 if mode == "up" else 1.0
            events = [lambda t, z, m: sign * float(z[1])]
        for event in events:
            event.terminal, event.direction = True, 1  # type: ignore[attr-defined]
        piece = solve_ivp(
            self.rates,
            (begin, end),
            y,
            "LSODA",
            args=(mode,),
            rtol=1e-9,
            atol=[1e-12, 1e-10, 1e-12, 1e-12, 1e-7, 1e-9],
            events=events or None,
            first_step=min(1e-7, end - begin),
        )
        assert piece.success, piece.message
        y = piece.y[:, -1].copy()
        if piece.status == 0:
            return end, y, mode
        t = float(piece.t[-1])
        y[1] = 0.0
        if mode == "stick":
            return t, y, "up" if len(piece.t_events[0]) else "down"
        return t, y, "stick"
