"""The plant driven by recorded signals: coupled, or one block by the other's measured signal.

    p = parameters_of({"stiffness_n_per_m": 9500.0, "valve_spool.time_constant_s": 1e-3})
    drive_coupled(p, command_v, dt_s)       -> CoupledResponse
    drive_pressure(p, command_v, position_m, dt_s)  -> PressureResponse
    drive_mechanics(p, pressure_pa, dt_s)   -> MechanicsResponse

The order of a tick is that of the simulated rig and of `pamctl.offline.closed_loop`: sample k is
taken, then command k is written, and the plant runs under it for `dt_s[k]` until sample k + 1
is taken. So the samples of tick 0 are the start state, `command_v[k]` does not affect sample k,
and the last command is not used. `dt_s` is one number for a regular grid, or one for each
interval (n - 1 of them; an n-th is ignored); a missed tick is an interval of twice the length, and
is cut into twice as many steps. For many drives of one grid call `build_grid` once.

In real time a command is computed first: it acts `acts_after_s[k]` after sample k, and the command
before it acts until then. The interval is cut at that instant. A negative number is a command that
acted already before its sample: the loop missed edges of the card's clock. The effect
`command_delay` comes on top. For a rig whose output is one tick late, shift `command_v` by one.

Every `position_m` and `pressure_pa`, in and out, is a sensor's reading: with the effects of the
sensors, without noise or rounding. `true_...` is the reading of an ideal sensor.
Where the plant leaves the range of its model, the response is NaN from there on.
All arrays are of float, of the same length n, SI, pressures absolute. The loops call the kernels of
the simulated rig itself: a fit uses the simulation's own integrator.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pamctl.bounded_memory import BoundedMemory
from pamctl.kernel.calls import machine
from pamctl.plant.catalogue import SensorMemory, undo_reading
from pamctl.plant.chamber import pressure_behind_line_pa
from pamctl.plant.effects.air import restricts
from pamctl.plant.effects.readings import restart_behind_play
from pamctl.plant.parameters import (
    PlantParameters,
    PlantState,
    parameters_of,
    rest_state,
    vented_state,
)
from pamctl.plant.simulated import LONGEST_STEP_S
from pamctl.plant.step import (
    mechanics_block_step,
    plant_step,
    pressure_at_sensor_pa,
    pressure_block_step,
    sensed_position_m,
    sensed_pressure_pa,
    sensors_step,
    settle_valve,
)
from pamctl.plant.terms import undo_reading_term

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Array = NDArray[np.float64]

STEPS_A_TICK = 2
SLOPE_S = 1e-5
"""Half of the line by which a restart's reading is undone: much shorter than a tick."""


class Restarts(NamedTuple):
    """Samples at which the mechanics go on from a measured state; the effects keep their memories.

    Creep or bristles are not measured: they are where the model's own run left them.
    """

    rows: NDArray[np.int64]
    """The samples, increasing."""
    outputs: Array
    """Readings of the encoder there, m."""
    rates: Array
    """Rates of the readings there, m/s."""


NO_RESTARTS = Restarts(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0))


class CoupledResponse(NamedTuple):
    """The coupled plant at each sample."""

    position_m: Array
    pressure_pa: Array
    true_position_m: Array
    true_pressure_pa: Array
    velocity_m_per_s: Array


class PressureResponse(NamedTuple):
    """The pressure block at each sample."""

    pressure_pa: Array
    true_pressure_pa: Array


class MechanicsResponse(NamedTuple):
    """The mechanics at each sample."""

    position_m: Array
    true_position_m: Array
    velocity_m_per_s: Array


def drive_coupled(
    p: PlantParameters,
    command_v: ArrayLike,
    dt_s: ArrayLike | SampleGrid,
    *,
    start: PlantState | None = None,
    steps: int = STEPS_A_TICK,
    acts_after_s: ArrayLike | None = None,
) -> CoupledResponse:
    """Run the coupled plant under commands (V), from the vented muscle or from `start`.

    `steps` is the number of steps in an interval of one period. A grid has its own
    `acts_after_s`. Raises ValueError for arrays of different lengths or with NaN.
    """
    commands = _check_signal("command_v", command_v)
    grid = build_grid(dt_s, len(commands), steps, acts_after_s)
    state = _settle_valve(p, vented_state(p) if start is None else start, grid.held_v)
    rows = np.full((len(CoupledResponse._fields), len(commands)), np.nan)
    machine(run_coupled).fill_until_it_fails(p, state, build_steps(p, commands, grid), rows)
    return CoupledResponse(*rows)


def drive_pressure(
    p: PlantParameters,
    command_v: ArrayLike,
    position_m: ArrayLike,
    dt_s: ArrayLike | SampleGrid,
    *,
    start: PlantState | None = None,
    steps: int = STEPS_A_TICK,
    acts_after_s: ArrayLike | None = None,
) -> PressureResponse:
    """Run the pressure block under commands (V) and a measured position (m).

    The position is linear between samples; no velocity is needed. By default the
    muscle starts at atmospheric pressure at the first position.
    """
    commands = _check_signal("command_v", command_v)
    positions = _check_signal("position_m", position_m, len(commands))
    grid = build_grid(dt_s, len(commands), steps, acts_after_s)
    true_m = undo_sensor("position_reading", p, positions, grid.samples_s)
    if start is None:
        start = rest_state(p, float(true_m[0]), p.paper.atmospheric_pressure_pa)
    start = _settle_valve(p, start, grid.held_v)
    cut = build_steps(p, commands, grid)
    rows = np.full((len(PressureResponse._fields), len(cut.first)), np.nan)
    ends_m = _interpolate(cut.ends_s, grid.samples_s, true_m)
    machine(run_pressure).fill_until_it_fails(p, start, cut, ends_m, rows)
    return PressureResponse(*rows)


def drive_mechanics(
    p: PlantParameters,
    pressure_pa: ArrayLike,
    dt_s: ArrayLike | SampleGrid,
    *,
    force_n: ArrayLike | None = None,
    start: PlantState | None = None,
    steps: int = STEPS_A_TICK,
    restarts: Restarts = NO_RESTARTS,
) -> MechanicsResponse:
    """Run the mechanics under a measured absolute pressure (Pa), linear between samples.

    A direct mechanism also takes a measured force (N). By default the muscle starts vented, at
    rest.
    """
    pressures = _check_signal("pressure_pa", pressure_pa)
    forces = None if force_n is None else _check_signal("force_n", force_n, len(pressures))
    grid = build_grid(dt_s, len(pressures), steps)
    state = vented_state(p) if start is None else start
    rows = np.full((len(MechanicsResponse._fields), len(pressures)), np.nan)
    cut = build_steps(p, pressures, grid)
    true_pa = undo_sensor("pressure_reading", p, pressures, grid.samples_s)
    ends_pa = _interpolate(cut.ends_s, grid.samples_s, true_pa)
    ends = len(cut.ends_s)
    ends_n = _make_zeros(1 << ends.bit_length())[:ends]
    if forces is not None:
        ends_n = _interpolate(cut.ends_s, grid.samples_s, forces)
    restarts = _undo_restarts(p, restarts, grid)
    machine(run_mechanics).fill_until_it_fails(p, state, cut, ends_pa, ends_n, restarts, rows)
    return MechanicsResponse(*rows)


@lru_cache
def _make_zeros(count: int) -> Array:
    zeros = np.zeros(count)
    zeros.setflags(write=False)  # all drives share it
    return zeros


def _interpolate(ends_s: Array, samples_s: Array, values: Array) -> Array:
    """Return a signal at the ends of the steps; a fit drives one record hundreds of times."""
    if ends_s is samples_s:
        return values
    made_from = (ends_s, samples_s, values)
    made = lambda: (np.interp(ends_s, samples_s, values),)  # noqa: E731
    return _INTERPOLATED.recall(tuple(map(id, made_from)), made_from, made)[0]


_INTERPOLATED: BoundedMemory[tuple[Array]] = BoundedMemory(50_000_000)


_NEUTRAL = parameters_of({}).effects


def _settle_valve(p: PlantParameters, state: PlantState, held_v: float | None) -> PlantState:
    """Return the state with a valve that has settled under the command before the first one."""
    if held_v is None or not p.valve_acts:
        return state
    return state._replace(valve=settle_valve(p.effects.valve, p.terms, state.valve, held_v))


# The kernels. Each fills `rows`, with one row for each field of its result; `state` is the start.


def run_coupled(p: PlantParameters, state: PlantState, steps: DriveSteps, rows: Array) -> None:
    """Kernel of `drive_coupled`."""
    for k in range(rows.shape[1]):
        if k:
            for j in range(steps.first[k - 1], steps.first[k]):
                state = plant_step(p, state, steps.command_v[j], steps.step_s[j])
        rows[0, k] = sensed_position_m(p, state.position_m, state.sensors, state.age_s)
        rows[1, k] = sensed_pressure_pa(p, state.pressure_pa, state.air, state.sensors, state.age_s)
        rows[2, k] = state.position_m
        rows[3, k] = state.pressure_pa
        rows[4, k] = state.velocity_m_per_s


def run_pressure(
    p: PlantParameters, state: PlantState, steps: DriveSteps, positions_m: Array, rows: Array
) -> None:
    """Kernel of `drive_pressure`. `positions_m` holds the positions at the ends of the steps."""
    pressure_pa, valve, air, sensors = state.pressure_pa, state.valve, state.air, state.sensors
    age_s = state.age_s
    for k in range(rows.shape[1]):
        if k:
            for j in range(steps.first[k - 1], steps.first[k]):
                x, end_m, step_s = positions_m[j], positions_m[j + 1], steps.step_s[j]
                begin_pa = pressure_at_sensor_pa(p, pressure_pa, air)
                pressure_pa, valve, air = pressure_block_step(
                    p,
                    pressure_pa,
                    valve,
                    air,
                    steps.command_v[j],
                    x,
                    0.5 * (x + end_m),
                    end_m,
                    age_s,
                    step_s,
                )
                end_pa = pressure_at_sensor_pa(p, pressure_pa, air)
                sensors = sensors_step(p, sensors, begin_pa, end_pa, x, end_m, age_s, step_s)
                age_s += step_s
        rows[0, k] = sensed_pressure_pa(p, pressure_pa, air, sensors, age_s)
        rows[1, k] = pressure_pa


def run_mechanics(
    p: PlantParameters,
    state: PlantState,
    steps: DriveSteps,
    pressures_pa: Array,
    forces_n: Array,
    restarts: Restarts,
    rows: Array,
) -> None:
    """Kernel of `drive_mechanics`. The loads are those at the ends of the steps."""
    x, v, sensors, mechanics = (
        state.position_m,
        state.velocity_m_per_s,
        state.sensors,
        state.mechanics,
    )
    muscle_pa, age_s = pressures_pa[0], state.age_s
    has_line = restricts(p.effects.air.line_restriction) and not p.direct
    has_play = p.effects.sensors.encoder_backlash.width_m > 0.0
    again = 0
    for k in range(rows.shape[1]):
        if k:
            for j in range(steps.first[k - 1], steps.first[k]):
                step_s, begin_pa = steps.step_s[j], muscle_pa
                muscle_pa = pressures_pa[j + 1]
                if has_line:
                    muscle_pa = pressure_behind_line_pa(
                        p, begin_pa, pressures_pa[j], muscle_pa, x, v, step_s
                    )
                middle_pa = 0.5 * (begin_pa + muscle_pa)
                begin_m = x
                middle_n = 0.5 * (forces_n[j] + forces_n[j + 1])
                x, v, mechanics = mechanics_block_step(
                    p, x, v, mechanics, middle_pa, middle_n, age_s, step_s
                )
                sensors = sensors_step(p, sensors, begin_pa, muscle_pa, begin_m, x, age_s, step_s)
                age_s += step_s
        if again < len(restarts.rows) and restarts.rows[again] == k:
            shown_m, rate = restarts.outputs[again], restarts.rates[again]
            if has_play:
                x, v, carrier = restart_behind_play(
                    p.effects.sensors.encoder_backlash,
                    sensors.encoder_backlash,
                    x,
                    v,
                    shown_m,
                    rate,
                )
                sensors = SensorMemory(sensors.pressure_sensor_lag, carrier)
            else:
                x, v = shown_m, rate
            again += 1
        rows[0, k] = sensed_position_m(p, x, sensors, age_s)
        rows[1, k] = x
        rows[2, k] = v


def _check_signal(name: str, values: ArrayLike, length: int | None = None) -> Array:
    signal = np.ascontiguousarray(values, dtype=np.float64)
    if signal.ndim != 1 or not len(signal):
        raise ValueError(f"{name}: one value a sample is needed, not shape {signal.shape}")
    if length is not None and len(signal) != length:
        raise ValueError(f"{name}: {len(signal)} samples, where the command has {length}")
    if not np.isfinite(signal).all():
        raise ValueError(f"{name}: sample {int(np.argmin(np.isfinite(signal)))} is not a number")
    return signal


def _check_intervals(dt_s: ArrayLike, samples: int) -> Array:
    given: Any = np.asarray(dt_s, dtype=np.float64)
    if given.ndim == 0:
        given = np.full(max(samples - 1, 0), given)
    if given.ndim != 1 or len(given) not in (samples - 1, samples):
        raise ValueError(f"dt_s: {given.shape} for {samples} samples; one for each interval")
    intervals = np.ascontiguousarray(given[: samples - 1])
    if not (np.isfinite(intervals) & (intervals > 0.0)).all():
        raise ValueError("dt_s: every interval must be longer than 0 s")
    return intervals


def _check_acts_after(name: str, given: ArrayLike | None, samples: int) -> Array | None:
    """Return when commands act after their samples; None where all act at their samples."""
    if given is None:
        return None
    late_s: Any = np.asarray(given, dtype=np.float64)
    if late_s.ndim == 0:
        late_s = np.full(samples, late_s)
    late_s = _check_signal(name, late_s, samples)
    return late_s if np.any(np.abs(late_s) > SAME_INSTANT_S) else None


class DriveSteps(NamedTuple):
    """The steps of a whole drive."""

    first: NDArray[np.int64]
    """For each sample the index of the first step after it."""
    step_s: Array
    command_v: Array
    """The command that acts at the valve in each step."""
    ends_s: Array
    """Ends of the steps, from the first sample on: one more than steps."""


SAME_INSTANT_S = 1e-10
"""Instants closer than this count as one."""


class SampleGrid(NamedTuple):
    """Samples and the steps between them, made once for many drives."""

    samples_s: Array
    """Times of the samples since the first one."""
    acts_s: Array
    """When each command acts, on the same clock, never falling."""
    held_v: float | None
    """The command that acts until the first one does; None: the first one itself."""
    acting: NDArray[np.int64]
    """For each step the index of the command that acts; -1 until the first one does."""
    first: NDArray[np.int64]
    """For each sample the index of the first step after it."""
    step_s: Array
    ends_s: Array
    """Ends of the steps: one more than steps."""


def build_grid(
    dt_s: ArrayLike | SampleGrid,
    samples: int,
    steps: int = STEPS_A_TICK,
    acts_after_s: ArrayLike | None = None,
    held_v: float | None = None,
) -> SampleGrid:
    """Cut each interval where a command acts, and each part into equal steps.

    An interval of one period gets `steps` steps. A tolerance of a tenth keeps jitter from adding
    one. `acts_after_s` is one number, or one for each sample; None: commands act at their samples.
    Until the first command acts the valve has `held_v`, in which it had settled; by default it has
    the first command, and its spool starts as the state says.
    A grid is returned unchanged. Raises ValueError if arrays do not fit the number of samples, or
    if a grid is given another `acts_after_s`.
    """
    if isinstance(dt_s, SampleGrid):
        if len(dt_s.samples_s) != samples:
            raise ValueError(f"dt_s: a grid of {len(dt_s.samples_s)} samples, where {samples} are")
        if acts_after_s is not None:
            raise ValueError("acts_after_s: a grid has its own; give it to build_grid")
        return dt_s
    intervals = _check_intervals(dt_s, samples)
    longest_s = 1.1 * find_period_s(intervals) / steps if len(intervals) else 1.0
    samples_s = accumulate_times(intervals)
    late_s = _check_acts_after("acts_after_s", acts_after_s, samples)
    if late_s is None:
        acts_s, acting, parts_s = samples_s, np.arange(samples - 1), intervals
        begins = np.arange(samples)
    else:
        # A command that was written later replaces one that is still on its way.
        acts_s = np.maximum.accumulate(samples_s + late_s)
        cuts_s = _merge_instants(samples_s, acts_s)
        acting = np.searchsorted(acts_s, cuts_s[:-1] + SAME_INSTANT_S, "right") - 1
        parts_s = np.diff(cuts_s)
        begins = np.searchsorted(cuts_s, samples_s - SAME_INSTANT_S)
    counts = np.maximum(1, np.ceil(parts_s / longest_s - 1e-6)).astype(np.int64)
    step_s = np.repeat(parts_s / counts, counts)
    first = np.concatenate([[0], np.cumsum(counts)])[begins]
    acting = np.repeat(acting, counts)
    is_whole = len(step_s) == len(intervals)  # one step from each sample to the next
    ends_s = samples_s if is_whole else accumulate_times(step_s)
    return SampleGrid(samples_s, acts_s, held_v, acting, first, step_s, ends_s)


def count_steps(period_s: float) -> int:
    """Return the steps of the simulation in a period: none much longer than half a millisecond."""
    return max(STEPS_A_TICK, round(period_s / LONGEST_STEP_S))


def find_period_s(intervals_s: Array) -> float:
    """Return the period of a record: the median interval; less if half of its ticks are missed."""
    usual_s, quick_s = float(np.median(intervals_s)), float(np.quantile(intervals_s, 0.25))
    return quick_s if usual_s > 1.5 * quick_s else usual_s


def build_steps(p: PlantParameters, command_v: Array, grid: SampleGrid) -> DriveSteps:
    """Assign commands to steps; a step is cut where a delayed command arrives within it."""
    delay_s = p.effects.timing.command_delay.delay_s
    if delay_s <= 0.0:
        acting_v = _select_commands(command_v, grid.acting, grid.held_v)
        return DriveSteps(grid.first, grid.step_s, acting_v, grid.ends_s)
    arrivals_s = grid.acts_s + delay_s
    ends_s = _merge_instants(grid.ends_s, arrivals_s)
    arrived = np.searchsorted(arrivals_s, ends_s[:-1] + SAME_INSTANT_S, "right") - 1
    first = np.searchsorted(ends_s, grid.samples_s - SAME_INSTANT_S)
    return DriveSteps(
        first, np.diff(ends_s), _select_commands(command_v, arrived, grid.held_v), ends_s
    )


def _select_commands(command_v: Array, indices: NDArray[np.int64], held_v: float | None) -> Array:
    """Return the command of each step; the indices never fall, and -1 is before the first."""
    waiting = int(np.searchsorted(indices, 0))
    selected_v = command_v[indices]
    selected_v[:waiting] = command_v[0] if held_v is None else held_v
    return selected_v


def _merge_instants(ends_s: Array, more_s: Array) -> Array:
    """Return the instants of both within the span of the first; nearly equal ones count once."""
    inside = (more_s > ends_s[0]) & (more_s < ends_s[-1])
    cuts_s = np.sort(np.concatenate([ends_s, more_s[inside]]), kind="stable")  # of sorted parts
    merged: Array = cuts_s[np.concatenate([[True], np.diff(cuts_s) > SAME_INSTANT_S])]
    return merged


def undo_sensor(place: str, p: PlantParameters, shown: Array, times_s: Array) -> Array:
    """Undo the effects on a reading, as far as they can be undone."""
    if not p.sensors_act:
        return shown
    atmosphere_pa = p.paper.atmospheric_pressure_pa
    shown = undo_reading_term(place, p.terms, shown, times_s, atmosphere_pa)
    true: Array = undo_reading(place, p.effects.sensors, shown, times_s, atmosphere_pa)
    return true


def _undo_restarts(p: PlantParameters, restarts: Restarts, grid: SampleGrid) -> Restarts:
    """Return the restarts with the true values and rates behind the encoder's readings.

    Each is undone as a short line. A play is left: `restart_behind_play` knows more.
    """
    if not (p.sensors_act and len(restarts.rows)):
        return restarts
    sensors = p.effects.sensors._replace(encoder_backlash=_NEUTRAL.sensors.encoder_backlash)
    p = p._replace(effects=p.effects._replace(sensors=sensors))
    around_s = np.array([-SLOPE_S, 0.0, SLOPE_S])
    times_s = np.add.outer(grid.samples_s[restarts.rows], around_s)
    shown = restarts.outputs[:, None] + np.outer(restarts.rates, around_s)
    true = undo_sensor("position_reading", p, shown.ravel(), times_s.ravel()).reshape(shown.shape)
    rates = (true[:, 2] - true[:, 0]) / (2.0 * SLOPE_S)
    return restarts._replace(outputs=np.ascontiguousarray(true[:, 1]), rates=rates)


def accumulate_times(dt_s: Array) -> Array:
    """Return the times since the first sample, from the intervals between them."""
    return np.concatenate([[0.0], np.cumsum(dt_s)])
