"""The two blocks, each driven by the other's measured signal, in output-error form.

    pressure block:  u, measured x -> P          mechanics block:  measured P -> x

A block without a fault then stays at its noise floor, whatever the other block hides. Where a
block never forgets its start, it is driven in windows; where a motion is imposed, the force that
it needs is compared (`judging/judges.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from pamctl.bounded_memory import BoundedMemory
from pamctl.diagnose.judging.judges import FREE_RUN, Judge, JudgeKind
from pamctl.diagnose.judging.segments import (
    count_samples,
    differentiate,
    filter_segments,
    find_segments,
    find_strokes,
    slope_gain,
    smooth_below,
    smooth_by_cubic,
)
from pamctl.diagnose.judging.windows import (
    StartModes,
    build_start_modes,
    cut_windows,
    estimate_starts,
    find_rows_inside,
)
from pamctl.diagnose.measured.missed_ticks import find_long_intervals
from pamctl.diagnose.measured.noise.sensor_noise import Noise
from pamctl.diagnose.measured.noise.spectrum import find_tail
from pamctl.diagnose.measured.record import Array, Record
from pamctl.plant.axis.required_force import required_force_n
from pamctl.plant.drive import (
    NO_RESTARTS,
    SAME_INSTANT_S,
    STEPS_A_TICK,
    Restarts,
    SampleGrid,
    build_grid,
    count_steps,
    drive_coupled,
    drive_mechanics,
    drive_pressure,
    find_period_s,
    find_pressure_course,
    select_mechanics_numbers,
    select_pressure_numbers,
    without_pressure_offset,
)
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.parameters import PlantParameters, PlantState, rest_state

PRESSURE, MECHANICS = "pressure", "mechanics"

SMOOTH_HZ = 60.0
"""Cutoff for a measured pressure before it drives the mechanics: friction rectifies its noise."""
CLEAR_OF_SIGNAL = 4.0
"""A cutoff so many times above a signal's highest frequency takes 0.4 % of its amplitude there."""
MODELLED_HZ = 1.0
"""Cutoff for measured minus modelled pressure where the pressure block is at its floor."""
VELOCITY_S = 0.031
"""Length of the parabolas that show the velocity."""
SURE = 3.0
"""A speed above this multiple of its noise has a sure direction."""
VENTED_PA = 20e3
"""Tolerance of a sensor's zero; a muscle that starts higher does not start vented."""
SETTLED_MS = 1000
"""Time after which a muscle stands still (ms)."""
_SIMULATED: BoundedMemory[tuple[Array]] = BoundedMemory(100_000_000)
"""Fits of both blocks, floors and figures ask for the same simulations."""
_DISTURBANCES: BoundedMemory[tuple[Array]] = BoundedMemory(50_000_000)
"""Noise of driving signals; the drives of a fit, weighed and of other steps, share theirs."""
_GRIDS: BoundedMemory[SampleGrid] = BoundedMemory(50_000_000)
"""Drives that are altered share the steps of the record."""
RUNAWAY = 1e6
"""Residual of a model that runs away, in deviations of the sensor. A spring with a negative rate
does so."""


@dataclass(frozen=True)
class Drive:
    """One record for one block: the inputs, and the measured output.

    The output is the block's own (pressure or position), by simulation; or, with `is_equation`,
    the force that a measured motion needs.
    """

    block: str
    name: str
    step_s: Array
    """Time from each sample to the next, shape (n - 1,)."""
    valve_v: Array
    """Command after each sample, shape (n,); zeros for the mechanics."""
    driven: Array
    """Position (pressure block; equation), or pressure or force (mechanics), shape (n,)."""
    cutoff_hz: float
    """Cutoff of the filter on `driven`; 0 stands for a cubic over 15 ms, infinity for none."""
    measured: Array
    """Measured output of the block, shape (n,)."""
    deviation: float
    """Unit of the residuals: the sensor's standard deviation, or a weight given by `Evidence`."""
    slack: float
    """Tolerance of the measurement's zero: a converter's step, or more where the encoder was zeroed
    on a muscle that a leak had filled a little."""
    start: float
    """Initial output of the block: atmospheric pressure, or the position at rest."""
    steps: int = STEPS_A_TICK
    has_position: bool = True
    """False for a pressure block whose position was not measured: the model then simulates it."""
    usable: NDArray[np.bool_] | None = None
    """The samples that a judge can use, shape (n,); None for all."""
    part: NDArray[np.bool_] | None = None
    """The samples of one part of the data, such as those to fit on, shape (n,); None for all."""
    windows: tuple[slice, ...] = ()
    """Stretches that are simulated each from the measured state; empty for one free run."""
    has_known_start: bool = True
    """The first window starts like a free run, and starts are taken as they are measured. Else
    all starts are measured, and what their errors move is projected out of the residual."""
    velocity_time_s: float = np.inf
    """Time in which the block forgets a velocity; for what an error of a start moves."""
    is_equation: bool = False
    """The output is the force that the motion `driven` needs; nothing is simulated."""
    slope_s: float = 0.0
    """Length of the parabolas that differentiate the motion of an equation."""
    pressed_pa: Array | None = None
    """Absolute pressure on a direct mechanism's piston, smoothed, shape (n,); None without one."""
    acts_after_s: Array | None = None
    """Time from each sample to the instant from which its command acts; None: at the sample."""
    held_v: float | None = None
    """The command before the first, which acts until the first does; None: the first itself."""
    bend: tuple[Array, Array] | None = None
    """How the driving pressure leaves the line between two samples where ticks were missed: times
    since the first sample (s), and pressures (Pa). None: nowhere."""
    is_remembered: bool = True
    """Simulations are kept, as they may be asked for again; not so for one draw of noise."""

    @cached_property
    def rows(self) -> NDArray[np.bool_] | None:
        """The samples that count, shape (n,); None for all."""
        if self.usable is None or self.part is None:
            return self.part if self.usable is None else self.usable
        return self.usable & self.part

    @property
    def samples(self) -> int:
        """Number of samples that count."""
        return len(self.measured) if self.rows is None else int(self.rows.sum())

    @property
    def channel(self) -> str:
        """The channel of the output."""
        if self.is_equation:
            return "force_n"
        return "pressure_pa" if self.block == PRESSURE else "position_m"

    @property
    def position_m(self) -> Array:
        """The position that the record holds; zeros where it was not measured, shape (n,)."""
        return self.measured if self.channel == "position_m" else self.driven

    @property
    def load(self) -> Array:
        """Pressure (Pa) or force (N) on the mechanics, shape (n,)."""
        return self.driven if self.channel == "position_m" else self.measured

    @cached_property
    def velocity_m_per_s(self) -> Array:
        """The velocity of the measured position, for regimes and pictures, shape (n,)."""
        return self.differentiate_motion(VELOCITY_S, 1)

    def cut_beginning(self, samples: int) -> Drive:
        """Return the drive's first samples, for one free run; an equation stays whole."""
        if self.is_equation or samples >= len(self.measured):
            return self
        pressed_pa, late_s = self.pressed_pa, self.acts_after_s
        return replace(
            self,
            step_s=self.step_s[: samples - 1],
            valve_v=self.valve_v[:samples],
            driven=self.driven[:samples],
            measured=self.measured[:samples],
            usable=None,
            part=None,
            windows=(),
            pressed_pa=None if pressed_pa is None else pressed_pa[:samples],
            acts_after_s=None if late_s is None else late_s[:samples],
            bend=None,
        )

    @cached_property
    def coarse(self) -> Drive:
        """The drive with half the steps; itself where it has only one, or simulates nothing."""
        if self.is_equation or self.steps < 2:
            return self
        return replace(self, steps=-(-self.steps // 2))

    @cached_property
    def grid(self) -> SampleGrid:
        """The simulation's steps."""
        made_from = (self.step_s, self.acts_after_s)
        key = (*map(id, made_from), len(self.measured), self.steps, self.held_v)
        return _GRIDS.recall(
            key,
            made_from,
            lambda: build_grid(
                self.step_s, len(self.measured), self.steps, self.acts_after_s, self.held_v
            ),
        )

    def simulate(self, settings: PlantSettings) -> Array:
        """Simulate the block; return the output of its sensor without noise."""
        return self.simulate_with(plant_parameters(settings))

    def simulate_with(self, p: PlantParameters) -> Array:
        """Simulate the block with the kernels' parameters; the result is read-only."""
        p = self.select_numbers(p)
        offset_pa = p.effects.sensors.pressure_sensor_offset.offset_pa
        if offset_pa and self._only_adds_offset(p):
            shown: Array = Drive.simulate_with(self, without_pressure_offset(p)) + offset_pa
            return shown
        if not self.is_remembered:
            return self._simulate_anew(p)
        made_from = (
            *(self.step_s, self.valve_v, self.driven, self.pressed_pa, self.acts_after_s),
            *(self.bend, self._restarts if self.windows else NO_RESTARTS),
        )
        key = (
            p,
            *map(id, made_from),
            (self.block, self.is_equation, self.has_position, self.has_known_start),
            (self.start, self.held_v, self.steps, self.slope_s),
        )
        (simulated,) = _SIMULATED.recall(key, made_from, lambda: (self._simulate_anew(p),))
        simulated.setflags(write=False)
        return simulated

    def _only_adds_offset(self, p: PlantParameters) -> bool:
        """Tell whether the pressure sensor's zero only moves what the block shows.

        It is the last effect of the reading. Windows start from a reading, which it moves.
        """
        alone = self.block == PRESSURE and self.has_position and not self.windows
        return alone and p.terms is None

    def select_numbers(self, p: PlantParameters) -> PlantParameters:
        """Return the numbers that this block's simulation depends on; the others are neutral."""
        if self.is_equation or not self.has_position or p.direct:
            return p
        return select_pressure_numbers(p) if self.block == PRESSURE else select_mechanics_numbers(p)

    def _simulate_anew(self, p: PlantParameters) -> Array:
        if self.is_equation:
            pressed_pa = self._find_pressed_pa(p)
            return required_force_n(p, self.times_s, self.driven, *self._rates, pressed_pa)
        if not self.has_position:
            return drive_coupled(p, self.valve_v, self.grid).pressure_pa
        again = self._restarts
        if self.block == PRESSURE:
            return drive_pressure(
                p,
                self.valve_v,
                self.driven,
                self.grid,
                start=self._find_start_pressure(p),
                restarts=again,
            ).pressure_pa
        start = rest_state(p, self.start, p.atmospheric_pressure_pa) if self.start else None
        return drive_mechanics(
            p,
            self._find_pressed_pa(p) if p.direct else self.driven,
            self.grid,
            force_n=self.driven if p.direct else None,
            start=start,
            restarts=again,
            bend_pa=self._bend_pa,
        ).position_m

    def _find_pressed_pa(self, p: PlantParameters) -> Array:
        """Return the absolute pressure on a direct mechanism's piston, if it has one."""
        if self.pressed_pa is None:
            return np.full(len(self.driven), p.atmospheric_pressure_pa)
        return self.pressed_pa

    def find_bend(self, settings: PlantSettings) -> tuple[Array, Array] | None:
        """Return `bend` for the mechanics, from this pressure block's simulation.

        Within a missed tick the muscle may fill by tens of kilopascals, along no straight line.
        """
        long = find_long_intervals(self.step_s)
        if not (self.has_position and long.any()):
            return None
        p = plant_parameters(settings)
        ends_s, course_pa = find_pressure_course(
            p,
            self.valve_v,
            self.driven,
            self.grid,
            start=self._find_start_pressure(p),
            restarts=self._restarts,
        )
        samples_s = self.grid.samples_s
        line_pa = np.interp(ends_s, samples_s, np.interp(samples_s, ends_s, course_pa))
        within = np.searchsorted(samples_s, ends_s[1:-1] - SAME_INSTANT_S) - 1
        bent = np.concatenate([[False], long[within], [False]])
        return ends_s, np.where(bent, course_pa - line_pa, 0.0)

    @cached_property
    def _bend_pa(self) -> Array | None:
        return None if self.bend is None else np.interp(self.grid.ends_s, *self.bend)

    def _find_start_pressure(self, p: PlantParameters) -> PlantState | None:
        rests = self.start == p.atmospheric_pressure_pa
        return None if rests else rest_state(p, float(self.driven[0]), self.start)

    def resting_gauge_pa(self, settings: PlantSettings, samples: int) -> float:
        """Return the true gauge pressure that the valve leaves at rest."""
        p = plant_parameters(settings)
        if not (self.has_position and samples):
            return 0.0
        driven = drive_pressure(p, self.valve_v, self.driven, self.grid)
        resting_pa = driven.true_pressure_pa[samples // 2 : samples]
        return float(np.mean(resting_pa)) - p.atmospheric_pressure_pa

    def show_output(self, true: Array) -> Array:
        """Return a simulated output as the record's column shows it."""
        return true

    def without_filter(self) -> Drive:
        """Return the drive as its sensor showed it: a column may have been filtered since."""
        return self

    def residual(self, settings: PlantSettings) -> Array:
        """Return measurement minus simulation, in deviations of the sensor, shape (samples,)."""
        return self.residual_of(self.simulate(settings))

    def residual_of(self, simulated: Array) -> Array:
        """Return measurement minus a simulated output, in deviations of the sensor."""
        error, most = self.measured - simulated, RUNAWAY * self.deviation
        largest = max(float(error.max()), -float(error.min()))
        if not largest <= most:  # not a number, too
            error = np.nan_to_num(error, nan=most).clip(-most, most)
        # A model that runs away does so in a straight line: that is no error of a start.
        if not self.has_known_start and largest < most:
            error = self._start_modes.project_out(error)
        if self.rows is not None:
            error = error[self.rows]
        if self.slack:
            error = error - max(-self.slack, min(float(error.mean()), self.slack))
        return error / self.deviation

    def random_generator(self, *key: int) -> np.random.Generator:
        """Return a random generator that is fixed by this record and the key."""
        return np.random.default_rng([crc32(self.measured.tobytes()), *key])

    def draw_disturbance(self, signal: Array, noise: Noise, replica: int, stream: int = 0) -> Array:
        """Draw noise of a driving signal, smoothed like the signal itself, shape (n,).

        A coarse converter's error goes slowly where the signal does: it is that of the signal. The
        draws are kept: the floors of all models use the same noise.
        """
        made_from = (self.measured, signal, self.step_s, noise)

        def draw() -> tuple[Array]:
            random = self.random_generator(replica, stream)
            drawn = noise.simulate_sensor(signal, random) - signal
            return (smooth_signal(drawn, self.step_s, self.cutoff_hz),)

        key = (replica, stream, self.cutoff_hz, *map(id, made_from))
        return _DISTURBANCES.recall(key, made_from, draw)[0]

    @cached_property
    def times_s(self) -> Array:
        """The time of each sample since the first, shape (n,)."""
        return np.concatenate([[0.0], np.cumsum(self.step_s)])

    @cached_property
    def _rates(self) -> tuple[Array, Array]:
        """Velocity and acceleration of an equation's motion."""
        velocity, acceleration = (self.differentiate_motion(self.slope_s, n) for n in (1, 2))
        return velocity, acceleration

    @cached_property
    def _restarts(self) -> Restarts:
        if not self.windows:
            return NO_RESTARTS
        started = self.windows[1:] if self.has_known_start else self.windows
        return estimate_starts(self.times_s, self.measured, started, self.deviation)

    @cached_property
    def _start_modes(self) -> StartModes:
        time_s = self.velocity_time_s if self.block == MECHANICS else None
        return build_start_modes(self.times_s, self.windows, time_s)

    def differentiate_motion(self, length_s: float, order: int) -> Array:
        """Differentiate the position, over missed ticks but not over gaps, shape (n,)."""
        period_s = find_period_s(self.step_s)
        return filter_segments(
            self.position_m,
            self.step_s,
            lambda even: differentiate(even, period_s, length_s, order),
            short=0.0,
        )


def prepare_pressure_drive(
    record: Record, noises: dict[str, Noise], nominal: PlantSettings, judge: Judge = FREE_RUN
) -> Drive:
    """Prepare a record for the pressure block; without a valve in the record, it is closed."""
    has_position = record.position_m is not None
    position_m = record["position_m"] if has_position else np.zeros(len(record))
    closed_v = np.zeros(len(record))
    atmosphere_pa = nominal.parameters.atmospheric_pressure_pa
    drive = Drive(
        PRESSURE,
        record.name,
        record.step_s,
        closed_v if record.valve_v is None else record["valve_v"],
        smooth_signal(position_m, record.step_s, 0.0),
        0.0,
        record["pressure_pa"],
        max(noises["pressure_pa"].total, 1.0),
        0.0,
        _initial_pressure_pa(record, noises["pressure_pa"], atmosphere_pa),
        count_steps(record.period_s),
        has_position=has_position or has_constant_volume(nominal),
        acts_after_s=record.acts_after_s,
        held_v=record.held_v,
        usable=record.counts,
    )
    return judge_drive(drive, judge)


def has_constant_volume(nominal: PlantSettings) -> bool:
    """Tell whether the plant is a chamber without a moving wall, which needs no position."""
    return str(nominal.actuator) == "chamber"


def prepare_mechanics_drive(
    record: Record,
    noises: dict[str, Noise],
    modelled_pa: Array | None = None,
    cutoff_hz: float = SMOOTH_HZ,
    judge: Judge = FREE_RUN,
) -> Drive:
    """Prepare a record for the mechanical block.

    `modelled_pa` is the pressure block's simulation of the measured pressure. With it, only the
    difference is smoothed, so that steep flanks stay as they are.
    """
    base = 0.0 if modelled_pa is None else modelled_pa
    load = base + smooth_signal(record["pressure_pa"] - base, record.step_s, cutoff_hz)
    return judge_drive(_drive_by_load(record, noises, load, cutoff_hz), judge)


def prepare_force_drive(record: Record, noises: dict[str, Noise], judge: Judge) -> Drive:
    """Prepare a record of a mechanism without a muscle, driven by force, pressure or both.

    If the judge is the equation, the motion is the input and the force is the output.
    """
    pressed_pa = record.pressure_pa
    if pressed_pa is not None:
        pressed_pa = smooth_signal(
            pressed_pa, record.step_s, _find_cutoff_hz(pressed_pa, record.step_s, judge)
        )
    if judge.kind is JudgeKind.EQUATION:
        return _prepare_equation(record, noises, judge, pressed_pa)
    force_n = np.zeros(len(record)) if record.force_n is None else record.force_n
    cutoff_hz = _find_cutoff_hz(force_n, record.step_s, judge)
    load = smooth_signal(force_n, record.step_s, cutoff_hz)
    drive = replace(_drive_by_load(record, noises, load, cutoff_hz), pressed_pa=pressed_pa)
    return judge_drive(drive, judge)


def _find_cutoff_hz(load: Array, step_s: Array, judge: Judge) -> float:
    """Return the cutoff for a measured force or pressure on a mechanism; infinity for none.

    A filter keeps noise from being rectified by friction. It must leave the signal as it is, which
    may be faster than a muscle's. A free mass averages the noise by itself, and answers jumps.
    """
    if not judge.forgets_start:
        return np.inf
    tail = find_tail([load[part] for part in find_segments(step_s)])
    if tail is None:
        return np.inf
    return max(SMOOTH_HZ, CLEAR_OF_SIGNAL * tail.begins / find_period_s(step_s))


def _prepare_equation(
    record: Record, noises: dict[str, Noise], judge: Judge, pressed_pa: Array | None
) -> Drive:
    force_n = record["force_n"]
    drive = Drive(
        MECHANICS,
        record.name,
        record.step_s,
        np.zeros(len(record)),
        record["position_m"],
        np.inf,
        force_n,
        max(noises["force_n"].total, 1e-9 * float(np.ptp(force_n))),
        0.0,
        float(record["position_m"][0]),
        is_equation=True,
        slope_s=judge.slope_s,
        pressed_pa=pressed_pa,
        usable=record.counts,
    )
    velocity = drive.differentiate_motion(judge.slope_s, 1)
    speed_noise = noises["position_m"].total * slope_gain(judge.slope_s, record.period_s)
    # At rest friction may take any value in its band: the force tells nothing there.
    direction = np.where(np.abs(velocity) > SURE * speed_noise, np.sign(velocity), 0.0)
    edge = count_samples(judge.slope_s, record.period_s) // 2
    strokes = find_strokes(direction, find_segments(record.step_s), edge)
    return _restrict(drive, find_rows_inside(strokes, len(record)))


def _restrict(drive: Drive, rows: NDArray[np.bool_] | None) -> Drive:
    """Return the drive with only those of its usable samples that are in `rows`; None for all."""
    if rows is None:
        return drive
    return replace(drive, usable=rows if drive.usable is None else drive.usable & rows)


def judge_drive(drive: Drive, judge: Judge) -> Drive:
    """Return the drive with the windows of a judge; a gap always begins a new one."""
    segments = find_segments(drive.step_s)
    if judge.kind is JudgeKind.FREE_RUN and len(segments) == 1:
        return drive
    period_s = float(np.median(drive.step_s))
    samples = len(drive.measured)
    length = samples if judge.horizon_s is None else round(judge.horizon_s / period_s)
    windows = cut_windows(segments, length)
    drive = _restrict(replace(drive, windows=windows), find_rows_inside(windows, samples))
    if judge.forgets_start:
        return drive
    return replace(
        drive,
        has_known_start=False,
        velocity_time_s=judge.velocity_time_s,
        slack=0.0,
        start=float(drive.measured[0]),
    )


def _drive_by_load(
    record: Record, noises: dict[str, Noise], load: Array, cutoff_hz: float
) -> Drive:
    noise = noises["position_m"]
    return Drive(
        MECHANICS,
        record.name,
        record.step_s,
        np.zeros(len(record)),
        load,
        cutoff_hz,
        record["position_m"],
        max(noise.total, 1e-7),
        noise.resolution,
        initial_position_m(record, noise),
        count_steps(record.period_s),
        usable=record.counts,
    )


def contraction_m(settings: PlantSettings, gauge_pa: float) -> float:
    """Return how far a constant pressure moves a muscle from its vented rest."""
    p = plant_parameters(settings)
    steady_pa = np.full(SETTLED_MS, p.atmospheric_pressure_pa + gauge_pa)
    return float(drive_mechanics(p, steady_pa, 1e-3).position_m[-1])


def initial_position_m(record: Record, noise: Noise) -> float:
    """Return the initial position: zero, unless the encoder clearly shows another."""
    position_m = float(np.mean(record["position_m"][: max(min(record.rest_samples, 500), 1)]))
    return position_m if abs(position_m) > 3.0 * max(noise.resolution, 1e-6) else 0.0


def _initial_pressure_pa(record: Record, noise: Noise, atmosphere_pa: float) -> float:
    """Return the initial pressure: the atmosphere's, if within the sensor's tolerance."""
    count = max(min(record.rest_samples, 500), 1)
    pressure_pa = float(np.mean(record["pressure_pa"][:count]))
    near = abs(pressure_pa - atmosphere_pa) < max(VENTED_PA, 5.0 * noise.deviation)
    return atmosphere_pa if near else pressure_pa


def smooth_signal(values: Array, step_s: Array, cutoff_hz: float) -> Array:
    """Smooth without delay, over missed ticks but not over gaps: by cubics (`cutoff_hz` 0), or by a
    filter.
    """
    period_s = find_period_s(step_s)

    def smooth_evenly(even: Array) -> Array:
        if cutoff_hz == 0.0:
            return smooth_by_cubic(even, period_s)
        return smooth_below(even, period_s, cutoff_hz)

    return filter_segments(values, step_s, smooth_evenly)


def stack_residuals(drives: Sequence[Drive], settings: PlantSettings) -> Array:
    """Return the residuals of several drives, one after the other."""
    p = plant_parameters(settings)
    return np.concatenate([drive.residual_of(drive.simulate_with(p)) for drive in drives])


def move_residuals(
    drives: Sequence[Drive], settings: PlantSettings, moved: Sequence[PlantSettings]
) -> Array:
    """Return by how much the stacked residuals change to other plants, shape (samples, plants).

    Only the blocks that depend on the changed numbers are simulated.
    """
    here, others = plant_parameters(settings), [plant_parameters(m) for m in moved]
    change: Array = np.zeros((len(others), sum(drive.samples for drive in drives)))
    first = 0
    for drive in drives:
        rows, own = slice(first, first + drive.samples), drive.select_numbers(here)
        first = rows.stop
        reached = [i for i, p in enumerate(others) if drive.select_numbers(p) != own]
        if reached:
            before = drive.residual_of(drive.simulate_with(here))
        for i in reached:
            change[i, rows] = drive.residual_of(drive.simulate_with(others[i])) - before
    return change.T
