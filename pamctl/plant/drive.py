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

from collections import OrderedDict
from functools import lru_cache
from threading import Lock
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

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
from pamctl.plant.sample_grid import (
    STEPS_A_TICK,
    DriveSteps,
    SampleGrid,
    build_grid,
    build_steps,
    check_signal,
)

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
    commands = check_signal("command_v", command_v)
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
    commands = check_signal("command_v", command_v)
    positions = check_signal("position_m", position_m, len(commands))
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
    pressures = check_signal("pressure_pa", pressure_pa)
    forces = None if force_n is None else check_signal("force_n", force_n, len(pressures))
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
    key = (id(ends_s), id(samples_s), id(values))
    with _ONE_AT_A_TIME:
        if key in _INTERPOLATED:
            _INTERPOLATED.move_to_end(key)
            return _INTERPOLATED[key][0]
    made = np.interp(ends_s, samples_s, values)
    with _ONE_AT_A_TIME:
        _INTERPOLATED[key] = made, made_from
        while sum(kept.nbytes for kept, _ in _INTERPOLATED.values()) > _MOST_INTERPOLATED_BYTES:
            _INTERPOLATED.popitem(last=False)  # the one that was not asked for the longest time
    return made


_ONE_AT_A_TIME = Lock()
"""A diagnosis drives records in several threads."""
_INTERPOLATED: OrderedDict[tuple[int, int, int], tuple[Array, tuple[Array, ...]]] = OrderedDict()
"""With what each was made from: while that is kept, no other array gets its `id`."""
_MOST_INTERPOLATED_BYTES = 50_000_000


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
