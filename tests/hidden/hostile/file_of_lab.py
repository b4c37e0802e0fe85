"""A rig that may change while it runs, and what the user's file holds of it.

Sensors, clocks, and offline habits; each channel is read at instants of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, filtfilt

from hidden.equations.motion import prepare_passage, settle
from hidden.equations.truth import State, Truth
from hidden.excitations import Excitation
from hidden.hostile.lab import Channel, Lab
from hidden.rig import HiddenRig, Record, needed_step_s
from hidden.sensors import ADC_STEP_PA, AO_STEP_V, ENCODER_STEP_M, Sensors, remember

Array = NDArray[np.float64]
Reader = Callable[[int, State], tuple[float, float]]
"""(tick, state) -> (pressure in Pa, position in m) as the loop's sensors show them."""


@dataclass(frozen=True)
class Passed:
    """What was there: the commands of the ticks, and the state at the asked instants."""

    volts: Array
    sensed_pa: Array
    geared_m: Array
    """Both at their own instants."""
    rest_m: float


def run_varying(
    truth_at: Callable[[float], Truth],
    excitation: Excitation,
    tick_s: Array,
    pressure_s: Array,
    position_s: Array,
    read: Reader,
    step_s: float,
) -> Passed:
    """Move the rig under the commands of the ticks, from rest and vented.

    A command acts from its tick on. `pressure_s` and `position_s` are the instants at which the
    file's values were really there; before the start and after the last tick the rig is as then.
    """
    start = truth_at(0.0)
    state = settle(start, excitation.rest_v, step_s)
    end_s = float(tick_s[-1])
    instants = np.unique(np.clip(np.concatenate([tick_s, pressure_s, position_s]), 0.0, end_s))
    ticks = {float(t): k for k, t in enumerate(tick_s)}
    loop = _Loop(excitation)
    volts = np.zeros(len(tick_s))
    seen = np.zeros((2, len(instants)))
    call = prepare_passage(start, state, np.ascontiguousarray(tick_s), volts, step_s)
    rest_m = float(state.geared_m)
    for i, now in enumerate(instants):
        seen[:, i] = state.sensed_pa, state.geared_m
        tick = ticks.get(float(now))
        if tick is not None:
            dt = float(tick_s[tick] - tick_s[tick - 1]) if tick else 1e-3
            volts[tick] = loop.choose_volts(tick, float(now), dt, *read(tick, state))
            call.put("written", tick + 1)
        if i + 1 < len(instants):
            call.put("p", truth_at(float(now)))
            call.put("since", float(now))
            call.put("until", float(instants[i + 1]))
            call.run()
            state = call.get("state")
    at = [np.searchsorted(instants, np.clip(t, 0.0, end_s)) for t in (pressure_s, position_s)]
    return Passed(volts, seen[0][at[0]], seen[1][at[1]], rest_m)


class _Loop:
    """Asks for a voltage: the excitation's own, or a PID's on what it reads."""

    def __init__(self, excitation: Excitation) -> None:
        self._asked = excitation
        self._total = self._slope = self._slow = 0.0
        self._before = 0.0
        self._began = False

    def choose_volts(
        self, k: int, t_s: float, dt: float, pressure: float, position: float
    ) -> float:
        asked = self._asked
        if asked.volts is not None:
            return round(float(asked.volts[k]) / AO_STEP_V) * AO_STEP_V
        assert asked.wanted_m is not None
        if not self._began:
            self._before, self._slow, self._began = position, pressure, True
        proportional, integral, derivative, damping = asked.gains
        self._slope += dt / 8e-3 * ((position - self._before) / dt - self._slope)
        self._slow += dt / 50e-3 * (pressure - self._slow)
        self._before = position
        if t_s < asked.rest_s:
            return round(asked.rest_v / AO_STEP_V) * AO_STEP_V
        error = float(asked.wanted_m[k]) - position
        u = proportional * error + integral * self._total - derivative * self._slope
        u -= damping * (pressure - self._slow)
        if abs(u) < 5.0:
            self._total += error * dt
        return round(min(max(u, -5.0), 5.0) / AO_STEP_V) * AO_STEP_V


STATED_ATMOSPHERE_PA = 101.3e3
PRESSURE_SPAN_PA = 700e3
POSITION_SPAN_M = 25.6e-3


def record_of(
    rig: HiddenRig,
    lab: Lab,
    excitation: Excitation,
    order: float,
    truth_at: Callable[[float], Truth] | None = None,
) -> Record:
    """Excite the rig, and return the file; `order` is 0 for the first record and 1 for the last.

    `truth_at` is the truth over time in place of what the laboratory says.
    """
    rng = np.random.default_rng([rig.seed, excitation.seed, len(excitation.name), 37])
    ticks = _ticks_of(rig.sensors, lab, excitation.samples, rng)
    pressure_s = _instants(lab, "pressure_pa", ticks)
    position_s = _instants(lab, "position_m", ticks)
    white = draw_noise(rig.sensors, len(ticks), rng)
    truth_at = truth_at or truth_over_time(rig.truth, lab, order, excitation.samples * 1e-3)
    passed = run_varying(truth_at, excitation, ticks, pressure_s, position_s,
                         _reader(rig.sensors, white),
                         rig.step_s or needed_step_s(rig.truth))  # fmt: skip
    atmosphere = truth_at(0.0).atmosphere_pa
    shown_pa = _pressure_column(rig.sensors, lab, passed, atmosphere, white, ticks, rng)
    shown_m = _position_column(rig.sensors, lab, passed, ticks, rng)
    shown_v = _command_column(lab, passed.volts, ticks)
    return Record(
        excitation.name, _stamps_of(rig.sensors, lab, ticks, rng), shown_v, shown_pa, shown_m
    )


def truth_over_time(
    truth: Truth, lab: Lab, order: float, length_s: float
) -> Callable[[float], Truth]:
    """Return the truth as a function of the time in one record."""
    made = truth._replace(**lab.truth)
    made = made._replace(atmosphere_pa=lab.true_atmosphere_pa)
    if lab.sensor_is_gauge:  # a regulator holds its pressure above the atmosphere of the place
        made = made._replace(
            supply_pa=made.supply_pa + lab.true_atmosphere_pa - STATED_ATMOSPHERE_PA
        )
    made = _times(made, lab.truth_factors)
    made = _times(made, {name: 1.0 + share * order for name, share in lab.between.items()})
    half = _times(made._replace(**lab.at_half), lab.at_half_factors)
    if not lab.within:
        return lambda t_s: made if t_s < 0.5 * length_s else half

    def changing(t_s: float) -> Truth:
        now = {name: 1.0 + share * t_s / length_s for name, share in lab.within.items()}
        return _times(made, now)

    return changing


def _times(truth: Truth, factors: Mapping[str, float]) -> Truth:
    return truth._replace(**{name: getattr(truth, name) * f for name, f in factors.items()})


def draw_noise(sensors: Sensors, n: int, rng: np.random.Generator) -> Array:
    """Return pressure noise: white, and a share that is correlated over 4 ms."""
    if sensors.perfect:
        return np.zeros(n)
    keep = np.exp(-0.25)
    slow = remember(keep, 0.0, np.sqrt(1.0 - keep**2) * rng.normal(size=n))
    white = np.sqrt(1.0 - sensors.coloured_share) * rng.normal(size=n)
    return np.asarray(sensors.pressure_noise_pa * (white + np.sqrt(sensors.coloured_share) * slow))


def _ticks_of(sensors: Sensors, lab: Lab, n: int, rng: np.random.Generator) -> Array:
    grid = np.arange(n) * 1e-3
    if sensors.perfect or lab.jittered_stamps_s > 0.0:
        return grid  # the card's clock paces the samples; only the stamps are the software's
    return grid + np.minimum(rng.exponential(sensors.clock_jitter_s, n), 0.4e-3)


def _instants(lab: Lab, channel: Channel, ticks: Array) -> Array:
    """Return when a row's value was really there."""
    rate = 1.0 + lab.clock_rates.get(channel, 0.0)
    return np.asarray(ticks * rate - lab.late_s.get(channel, 0.0))


def _stamps_of(sensors: Sensors, lab: Lab, ticks: Array, rng: np.random.Generator) -> Array:
    stamps = ticks * (1.0 + lab.time_rate)
    if lab.jittered_stamps_s > 0.0:
        stamps = stamps + np.abs(rng.normal(0.0, lab.jittered_stamps_s, len(ticks)))
        order = 2e-6 * np.arange(len(ticks))  # a stamp is later than the one before it
        stamps = np.maximum.accumulate(stamps - order) + order
    return stamps if sensors.perfect else np.round(stamps, 6)


def _reader(s: Sensors, noise: Array) -> Callable[[int, State], tuple[float, float]]:
    """Return what the loop itself reads: it has no fault of the file."""
    rested: list[float] = []

    def read(tick: int, state: State) -> tuple[float, float]:
        if tick == 0:
            rested.append(float(state.geared_m))
        zero = rested[0] if s.encoder_homed else 0.0
        position = s.encoder_scale * (float(state.geared_m) - zero)
        if not s.perfect:
            position = np.floor(position / ENCODER_STEP_M + s.encoder_phase) * ENCODER_STEP_M
        return float(state.sensed_pa) + float(noise[tick]), float(position)

    return read


def _pressure_column(
    s: Sensors,
    lab: Lab,
    passed: Passed,
    atmosphere: float,
    noise: Array,
    ticks: Array,
    rng: np.random.Generator,
) -> Array:
    gauge = s.pressure_gain * (passed.sensed_pa - atmosphere) + s.pressure_offset_pa
    share = gauge / (PRESSURE_SPAN_PA / 2.0)
    gauge = gauge + lab.pressure_bow * (PRESSURE_SPAN_PA / 2.0) * 4.0 * share * (1.0 - share)
    if lab.noise_with_flow > 0.0:
        flow = np.abs(np.gradient(passed.sensed_pa, ticks))
        noise = noise * (1.0 + lab.noise_with_flow * np.minimum(flow / flow.max(), 1.0))
    gauge = gauge + noise + lab.hum_pa * _hum(lab, ticks, rng) + draw_wander(lab, ticks, rng)
    spiked = rng.random(len(gauge)) < lab.spikes
    gauge = gauge + spiked * rng.choice([-1.0, 1.0], len(gauge)) * lab.spike_pa
    gauge = _drop_rows(gauge, lab, rng)
    column = (STATED_ATMOSPHERE_PA if lab.sensor_is_gauge else atmosphere) + gauge
    if lab.adc_bits:
        step = PRESSURE_SPAN_PA / 2**lab.adc_bits
        column = np.round(column / step) * step
    elif not s.perfect:
        column = np.round(column / ADC_STEP_PA) * ADC_STEP_PA
    column = filter_offline(column, lab)
    if "pressure_pa" in lab.inverted:
        column = 2.0 * atmosphere - column
    return np.asarray(column + lab.pressure_zero_shift_pa)


def _position_column(
    s: Sensors, lab: Lab, passed: Passed, ticks: Array, rng: np.random.Generator
) -> Array:
    zero = passed.rest_m if s.encoder_homed else 0.0
    column = s.encoder_scale * (passed.geared_m - zero)
    column = column + lab.hum_m * _hum(lab, ticks, rng)
    spiked = rng.random(len(column)) < lab.spikes
    column = column + spiked * rng.choice([-1.0, 1.0], len(column)) * lab.spike_m
    if lab.adc_bits:
        step = POSITION_SPAN_M / 2**lab.adc_bits
        column = np.round((column + rng.normal(0.0, 0.3 * step, len(column))) / step) * step
    elif not s.perfect:
        column = np.floor(column / ENCODER_STEP_M + s.encoder_phase) * ENCODER_STEP_M
    column = filter_offline(column, lab) * lab.position_scale
    return -column if "position_m" in lab.inverted else np.asarray(column)


def _command_column(lab: Lab, volts: Array, ticks: Array) -> Array:
    """Return the logged command: that of an earlier instant, of another clock, or of fewer rows."""
    when = _instants(lab, "valve_v", ticks) + 1e-9
    at = np.clip(np.searchsorted(ticks, when, side="right") - 1, 0, len(ticks) - 1)
    column = volts[at]
    rows = np.arange(len(column)) // lab.decimation * lab.decimation
    column = column[rows]
    return -column if "valve_v" in lab.inverted else np.asarray(column)


def _hum(lab: Lab, ticks: Array, rng: np.random.Generator) -> Array:
    phase = rng.uniform(0.0, 2.0 * np.pi)
    return np.asarray(np.sin(2.0 * np.pi * lab.hum_hz * ticks + phase))


def draw_wander(lab: Lab, ticks: Array, rng: np.random.Generator) -> Array:
    """Return a slow random walk that forgets itself over `wander_s`."""
    if lab.wander_pa == 0.0:
        return np.zeros(len(ticks))
    keep = np.exp(-np.median(np.diff(ticks)) / lab.wander_s)
    first = rng.normal()
    kicks = rng.normal(size=len(ticks)) * np.sqrt(1.0 - keep**2)
    return lab.wander_pa * remember(keep, first, kicks)


def _drop_rows(gauge: Array, lab: Lab, rng: np.random.Generator) -> Array:
    dropped = gauge.copy()
    for start in np.flatnonzero(rng.random(len(gauge)) < lab.dropouts):
        dropped[start : start + int(rng.integers(1, 4))] = 0.0
    return dropped


def filter_offline(column: Array, lab: Lab) -> Array:
    if lab.filter_hz == 0.0:
        return column
    b, a = butter(2, lab.filter_hz / 500.0)
    return np.asarray(filtfilt(b, a, column))
