"""The records, as blocks of samples with masks, and the simulation of all their sensors.

A muscle or a chamber runs from the command. A mechanism runs from the measured force: freely where
its spring lets it forget, else in windows. Where something else moves an axis, the equation gives
the force. What a hypothesis of the measuring chain does is done to the simulated readings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, map_coordinates

from pamctl.diagnose.evidence.constants import (
    COARSE_STEP_S,
    FINE_STEP_S,
    LEAST_LEVELS,
    LEAST_STEPS,
    LEVELS,
    SCORE_STEP_S,
)
from pamctl.diagnose.evidence.measured_columns import (
    SPEED_S,
    fill_gone,
    find_neighbours,
    find_rates,
    find_resolution,
    find_starts,
    has_no_speed,
    judge_motion,
)
from pamctl.diagnose.evidence.pool import CHAIN
from pamctl.log.record_problems import find_frozen
from pamctl.plant.drive import NO_RESTARTS, Restarts, drive_coupled, drive_mechanics
from pamctl.plant.effects.description import ACTUATORS
from pamctl.plant.parameters import (
    ACTUATOR,
    PlantParameters,
    keep_in_stroke,
    parameters_of,
    rest_state,
)
from pamctl.plant.required_force import required_force_n
from pamctl.plant.sample_grid import SampleGrid, accumulate_times, build_grid

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

WARM_S = 0.25
"""After a start from measured values: longer than the plant's memory of 60 ms."""
WINDOW_S = 0.256
"""A mechanism without a spring never forgets: it begins again after so long."""
OFF_REST_PA = 5e3
"""A muscle whose record begins so far from the atmosphere has not begun vented."""
GAP = 20.0
"""Periods without a sample after which a record goes on anew."""
BLOCK_S = 0.512
"""Of a block at 1 kHz; slower logs come as near to it as the levels let them."""
TWELFTHS = 12
HELD_OUT = (5, 11)
"""Of twelve stretches of each record, those that are held out where no record is."""
ADDED_PA = f"{CHAIN}added.pressure_pa"
"""What a file's pressure is too high by: a record begins by so much lower."""
ADDED_M = f"{CHAIN}added.position_m"
"""The same of a piston's position."""
LATE_M, CLOCK_M = f"{CHAIN}late.position_m", f"{CHAIN}clock.position_m"
"""When a position is read: a window begins with the state of another instant."""
APART_M = f"{CHAIN}apart.position_m"
"""Force and position of one row are read up to a sample apart, or the force is held between."""
FAR = 1e4
"""What a simulation shows where the plant leaves the range of its model."""


class CannotBeWeighed(ValueError):
    """The plant file's model and these records cannot be compared; the message says why."""


class TooLittleRecorded(CannotBeWeighed):
    """The records lack an input, or are shorter than a block; the message says what is needed."""


class Recording(Protocol):
    """What is needed of a record: columns in SI of one length, None where nothing was measured."""

    @property
    def name(self) -> str:
        """Which record it is."""

    @property
    def t_s(self) -> Any:
        """Times of the samples, s."""

    @property
    def valve_v(self) -> Any:
        """Command, V."""

    @property
    def pressure_pa(self) -> Any:
        """Absolute pressure, Pa."""

    @property
    def position_m(self) -> Any:
        """Position, m."""

    @property
    def force_n(self) -> Any:
        """Driving force, N."""


@dataclass
class StepGrids:
    """The grids of one stretch, by the length of the step; each is built when it is first used."""

    between_s: Array
    """From each sample to the next, shape (samples - 1,)."""
    steps: Mapping[float, int]
    """Their number in a usual interval, by their length."""
    acts_after_s: Array | None
    """How long after its sample each command acts, shape (samples,); None: at once."""
    held_v: float | None

    def __post_init__(self) -> None:
        """Build no grid yet."""
        self.samples_s = accumulate_times(self.between_s)
        self._built: dict[float, SampleGrid] = {}

    def __getitem__(self, step_s: float) -> SampleGrid:
        """Return the grid with steps of this length."""
        if step_s not in self._built:
            samples = len(self.between_s) + 1
            self._built[step_s] = build_grid(
                self.between_s, samples, self.steps[step_s], self.acts_after_s, self.held_v
            )
        return self._built[step_s]


@dataclass
class RunPiece:
    """A record, or the part of one between two gaps."""

    inputs: dict[str, Array]
    shown: Array
    """What the sensors showed, shape (channels, samples)."""
    masked: Mask
    """As `shown`."""
    rates: dict[str, Array]
    grids: StepGrids
    starts_at_rest: bool
    name: str = ""
    """Of its record."""
    begin_s: float = 0.0
    """Where it begins in its record."""


class Runs:
    """Records of one rig, and what a plant would have shown in their place."""

    def __init__(
        self,
        records: Sequence[Recording],
        plant: Mapping[str, float],
        like: Runs | None = None,
        jobs: int = 1,
    ) -> None:
        """Cut records at gaps into blocks. Raise TooLittleRecorded where nothing can be simulated.

        Held-out records are simulated `like` those that are fitted, `jobs` records side by side.
        """
        self.jobs = jobs
        self.actuator = ACTUATORS[round(plant.get(ACTUATOR, 0.0))]
        self.period_s = float(np.median([np.median(np.diff(r.t_s)) for r in records or ()]))
        motion = judge_motion(records, self.actuator, self.period_s)
        self.imposed: bool = like.imposed if like else motion[0]
        self.windowed: bool = like.windowed if like else motion[1]
        self.channels = _choose_channels(records, self.actuator, self.imposed)
        self._window = round(WINDOW_S / self.period_s)
        levels = round(np.log2(BLOCK_S / self.period_s))
        self.block: int = like.block if like else 1 << max(LEAST_LEVELS, min(LEVELS, levels))
        self._atmosphere_pa = plant["atmospheric_pressure_pa"]
        least = {FINE_STEP_S: LEAST_STEPS, COARSE_STEP_S: LEAST_STEPS, SCORE_STEP_S: 1}
        self.steps_s = {s: max(n, round(self.period_s / s)) for s, n in least.items()}
        """The steps of a simulation, with their number in a usual sample."""
        self.stretches = [s for record in records for s in self._cut(record)]
        if not self.stretches:
            raise TooLittleRecorded(
                f"no record is as long as a block of {self.block * self.period_s:g} s"
            )
        self._lay_out()
        steps = [getattr(record, "steps", {}) for record in records]
        told = (min((s[c] for s in steps if s.get(c)), default=0.0) for c in self.channels)
        rows = zip(self.shown, told, strict=True)
        self.resolutions = [max(find_resolution(row.ravel()), step) for row, step in rows]
        """The step with which each channel was digitised; mended samples are off it."""
        self._last: tuple[Any, Array] | None = None
        self._whole = self

    def find_start_error2(self) -> Array:
        """Return the mean square error of each channel by the speeds with which windows begin.

        A speed that is wrong by e leaves e t after a time t, of a mass that nothing slows.
        """
        if not self.windowed or self.imposed:
            return np.zeros(len(self.channels))
        errors = np.concatenate([s.rates["speed_error"] for s in self.stretches])
        return np.full(1, float(np.mean(errors**2)) * (self._window * self.period_s) ** 2 / 3.0)

    @property
    def drivers(self) -> tuple[str, ...]:
        """The measured columns that drive a simulation; a command is known, and not measured."""
        inputs = self.stretches[0].inputs
        if self.imposed or ("valve_v" in inputs and self.actuator != "direct"):
            return ()
        names = ("force_n", "pressure_pa") if self.actuator == "direct" else ("pressure_pa",)
        return tuple(name for name in names if name in inputs)

    def with_added(self, added: Sequence[Mapping[str, Array]]) -> Runs:
        """Return the same records, with so much added to the inputs of each stretch."""
        view = copy(self)
        view._whole, view._last = view, None
        view.stretches = [
            replace(s, inputs={k: c + more.get(k, 0.0) for k, c in s.inputs.items()})
            for s, more in zip(self.stretches, added, strict=True)
        ]
        return view

    @property
    def whole(self) -> Runs:
        """All blocks of these records."""
        return self._whole

    def part(self, counts: Mask) -> Runs:
        """Return the same records, of which only these blocks count, shape (n_blocks,)."""
        view = copy(self)
        view._whole, view._counts = self, counts
        view._note_hidden()
        return view

    # --- what was measured ---

    def _cut(self, record: Recording) -> list[RunPiece]:
        t_s = np.ascontiguousarray(record.t_s, dtype=np.float64)
        counts = getattr(record, "counts", None)
        gaps = np.flatnonzero(np.diff(t_s) > GAP * self.period_s) + 1
        found = []
        for begin, end in zip([0, *gaps], [*gaps, len(t_s)], strict=True):
            if end - begin < self.block // 2:
                continue
            cut = slice(begin, end)
            columns = {
                name: np.ascontiguousarray(getattr(record, name)[cut], dtype=np.float64)
                for name in ("valve_v", "pressure_pa", "position_m", "force_n")
                if getattr(record, name) is not None
            }
            acts_after = getattr(record, "acts_after_s", None)
            held_v = getattr(record, "held_v", None) if begin == 0 else None
            late_s = None if acts_after is None else acts_after[cut]
            grids = StepGrids(np.diff(t_s[cut]), self.steps_s, late_s, held_v)
            counted = None if counts is None else counts[cut]
            found.append(self._make_stretch(columns, grids, begin == 0, counted))
            found[-1].name, found[-1].begin_s = record.name, float(t_s[begin])
        return found

    def set_instants(self, acts_after_s: Sequence[Array]) -> None:
        """Let the commands of each stretch act so long after their samples, s."""
        for stretch, late_s in zip(self.stretches, acts_after_s, strict=True):
            now_s = stretch.grids.acts_after_s
            if now_s is None or not np.array_equal(late_s, now_s):
                stretch.grids = replace(stretch.grids, acts_after_s=late_s)
                self._whole._last = None

    def _make_stretch(
        self, columns: dict[str, Array], grids: StepGrids, is_first: bool, counts: Mask | None
    ) -> RunPiece:
        shown = np.stack([columns[c] for c in self.channels])
        masked = ~np.isfinite(shown)
        shown = np.stack([fill_gone(row, gone) for row, gone in zip(shown, masked, strict=True)])
        for row, gone in zip(shown, masked, strict=True):
            gone |= find_frozen(grids.samples_s, row)
        if counts is not None:
            masked |= ~np.asarray(counts, dtype=bool)
        pressures = columns.get("pressure_pa")
        vented = pressures is None or abs(pressures[0] - self._atmosphere_pa) < OFF_REST_PA
        at_rest = is_first and vented and self.actuator != "direct"
        if not at_rest and not self.imposed:
            masked[:, : round(WARM_S / self.period_s)] = True
        rates: dict[str, Array] = {}
        if self.actuator == "direct":
            position_m, period_s = columns["position_m"], self.period_s
            if self.imposed:
                rates = find_rates(position_m, period_s, SPEED_S, grids.samples_s)
            else:
                rates = find_starts(position_m, period_s, grids.samples_s)
        if self.imposed:
            masked |= has_no_speed(rates["speed"], grids.samples_s)
        return RunPiece(columns, shown, masked, rates, grids, at_rest)

    def _lay_out(self) -> None:
        """Fit the stretches into blocks; the last block of each may be filled up to half."""
        sizes = []
        for stretch in self.stretches:
            n, whole = stretch.shown.shape[1], stretch.shown.shape[1] // self.block * self.block
            sizes.append(whole + self.block if n - whole >= self.block // 2 else whole)
        self.sizes = sizes
        self.n_blocks = sum(sizes) // self.block
        self.shown = self.pack([s.shown for s in self.stretches])
        masked = self.pack([s.masked.astype(float) for s in self.stretches], rest=1.0) > 0.5
        self.masked: Mask = masked
        for channel, gone in zip(self.channels, masked, strict=True):
            if gone.all():
                raise TooLittleRecorded(
                    f"{channel}: no sample counts: all are near a gap, a frozen sensor, or the "
                    "begin of a record; record for longer"
                )
        self.when_s = self.pack([s.grids.samples_s[None] for s in self.stretches])[0]
        commands = [s.inputs.get("valve_v", np.zeros(1))[None] for s in self.stretches]
        self._commands_v = self.pack(commands).ravel()
        self._counts = np.ones(self.n_blocks, dtype=bool)
        self._note_hidden()

    def _note_hidden(self) -> None:
        """Note what does not count: samples that say nothing, and blocks of the other part."""
        self.hidden: Mask = self.masked | ~self._counts[:, None]
        ends = np.cumsum([0, *self.sizes])
        self._fills = [find_neighbours(row.ravel(), ends) for row in self.hidden]

    def find_fresh_starts(self) -> NDArray[np.int64]:
        """Return the samples, but the first, from which a simulation knows nothing of before."""
        ends = np.cumsum([0, *self.sizes])
        every = self._window if self.windowed else sum(self.sizes)
        starts = [np.arange(a, b, every) for a, b in pairwise(ends.tolist())]
        return np.concatenate(starts)[1:]

    def pack(self, parts: Sequence[Array], rest: float | None = None) -> Array:
        """Return rows of all stretches as blocks, shape (rows, n_blocks, block)."""
        rows = np.empty((len(parts[0]), sum(self.sizes)))
        at = 0
        for part, size in zip(parts, self.sizes, strict=True):
            n = min(size, part.shape[1])
            rows[:, at : at + n] = part[:, :n]
            if n < size:
                rows[:, at + n : at + size] = part[:, n - 1 : n] if rest is None else rest
            at += size
        return rows.reshape(len(rows), self.n_blocks, self.block)

    def fill_masked(self, residual: Array) -> Array:
        """Fill what is masked from its neighbours, in place: every model's residual alike."""
        rows = residual.reshape(len(residual), -1)
        for row, (at, left, right, share) in zip(rows, self._fills, strict=True):
            if len(at):
                row[at] = (1.0 - share) * row[left] + share * row[right]
        return residual

    def find_kept(self, level: NDArray[np.int64]) -> Mask:
        """Return which Haar coefficients have at least half of their samples."""
        seen = 1.0 - self.hidden
        parts, rest = [], seen
        for _ in range(int(level[-1])):
            rest = 0.5 * (rest[..., 0::2] + rest[..., 1::2])
            parts.append(rest)
        return np.asarray(np.concatenate([*parts, rest], axis=-1) >= 0.5)

    # --- what a plant would have shown ---

    def simulate(self, values: Mapping[str, float], step_s: float) -> Array:
        """Return the readings of a plant, as `shown`; FAR where it leaves its model's range.

        They are not to be changed: the next call may return the same.
        """
        plain, chain = join_waves(values)
        air_pa = chain.get(f"{CHAIN}atmosphere")
        if air_pa is not None:
            plain["atmospheric_pressure_pa"] = air_pa
        early: tuple[str, ...] = ("valve_v", "t_s", ADDED_PA, ADDED_M)
        if self.windowed:
            early += (LATE_M, CLOCK_M, APART_M)
        command = {k: v for k, v in chain.items() if k.endswith(early)}
        key = (step_s, *sorted((plain | command).items()))
        last = self._whole._last
        if last is None or last[0] != key:
            rows = self._drive(parameters_of(plain), step_s, command)
            rows.setflags(write=False)
            self._whole._last = last = key, rows
        return self._change_readings(last[1].copy(), chain) if chain else last[1]

    def _drive(self, p: PlantParameters, step_s: float, command: Mapping[str, float]) -> Array:
        drive = partial(self._drive_stretch, p, step_s=step_s, command=command)
        side_by_side = min(self.jobs, len(self.stretches)) > 1
        run_each = _start_threads(self.jobs).map if side_by_side else map
        parts = [*run_each(drive, self.stretches)]
        rows = self.pack(parts)
        if not np.isfinite(rows).all():
            np.nan_to_num(rows, copy=False, nan=FAR, posinf=FAR, neginf=-FAR)
        return rows

    def _drive_stretch(
        self, p: PlantParameters, stretch: RunPiece, step_s: float, command: Mapping[str, float]
    ) -> Array:
        inputs, grid = stretch.inputs, stretch.grids[step_s]
        longer = 1.0 + command.get(f"{CHAIN}clock.t_s", 0.0)
        if longer != 1.0:
            grid = grid._replace(
                samples_s=grid.samples_s / longer, acts_s=grid.acts_s / longer,
                step_s=grid.step_s / longer, ends_s=grid.ends_s / longer,
            )  # fmt: skip
        if self.imposed:
            rates = stretch.rates
            return required_force_n(
                p, grid.samples_s, inputs["position_m"], rates["speed"], rates["push"],
                inputs.get("pressure_pa"),
            )[None]  # fmt: skip
        if self.actuator == "direct":
            return self._drive_mechanism(p, stretch, grid, command)
        if "valve_v" not in inputs:
            start = self._start(p, stretch, command)
            response = drive_mechanics(p, inputs["pressure_pa"], grid, start=start)
            return response.position_m[None]
        commands = inputs["valve_v"]
        if command:
            commands = commands * command.get(f"{CHAIN}factor.valve_v", 1.0)
            when_s = grid.samples_s * (1.0 + command.get(f"{CHAIN}clock.valve_v", 0.0))
            when_s = when_s + command.get(f"{CHAIN}late.valve_v", 0.0)
            commands = np.interp(when_s, grid.samples_s, commands)
        start = self._start(p, stretch, command)
        coupled = drive_coupled(p, commands, grid, start=start)
        return np.stack([getattr(coupled, channel) for channel in self.channels])

    def _start(self, p: PlantParameters, stretch: RunPiece, chain: Mapping[str, float]) -> Any:
        """Return the first state; None for a vented muscle. Friction may hold a piston anywhere."""
        lies_anywhere = self.actuator == "cylinder" and "position_m" in stretch.inputs
        if stretch.starts_at_rest and not lies_anywhere:
            return None
        first = {name: float(np.median(c[:5])) for name, c in stretch.inputs.items()}
        added_pa = chain.get(ADDED_PA, 0.0)
        pressure_pa = first.get("pressure_pa", self._atmosphere_pa + added_pa) - added_pa
        position_m = first.get("position_m", 0.0) - chain.get(ADDED_M, 0.0)
        return rest_state(p, keep_in_stroke(p, position_m), pressure_pa)

    def _drive_mechanism(
        self, p: PlantParameters, stretch: RunPiece, grid: SampleGrid, chain: Mapping[str, float]
    ) -> Array:
        """Return the position; a late reading, or one of another clock, shows it at other times."""
        inputs, rates, n = stretch.inputs, stretch.rates, len(grid.samples_s)
        if chain:
            rate = 1.0 + chain.get(CLOCK_M, 0.0)
            late_s = chain.get(LATE_M, 0.0) + chain.get(APART_M, 0.0)
            shown_s = (grid.samples_s + late_s) / rate
            rates = {k: np.interp(shown_s, grid.samples_s, c) for k, c in rates.items()}
        pressure = inputs.get("pressure_pa")
        if pressure is None:
            pressure = np.full(n, p.paper.atmospheric_pressure_pa)
        again = NO_RESTARTS
        if self.windowed:
            every = np.arange(self._window, n, self._window)
            again = Restarts(every, rates["smooth"][every], rates["speed"][every])
        start = rest_state(p, float(rates["smooth"][0]), float(pressure[0]))
        start = start._replace(velocity_m_per_s=float(rates["speed"][0]))
        response = drive_mechanics(
            p, pressure, grid, force_n=inputs.get("force_n"), start=start, restarts=again
        )
        return response.position_m[None]

    def _change_readings(self, rows: Array, chain: Mapping[str, float]) -> Array:
        """Do to the readings what the measuring chain does."""
        out = rows.reshape(len(rows), -1)
        for row, channel in zip(out, self.channels, strict=True):
            late_s = sum(chain.get(f"{CHAIN}{n}.{channel}", 0.0) for n in ("late", "apart"))
            rate = 1.0 + chain.get(f"{CHAIN}clock.{channel}", 0.0)
            width_s = chain.get(f"{CHAIN}smooth.{channel}", 0.0)
            at = 0
            for size in self.sizes:
                part, when_s = row[at : at + size], self.when_s.ravel()[at : at + size]
                if late_s or rate != 1.0:
                    part[:] = _read_at(rate * when_s - late_s, when_s, part)
                if width_s > 0.0:
                    part[:] = gaussian_filter1d(part, max(width_s / self.period_s, 0.05))
                at += size
            row *= chain.get(f"{CHAIN}factor.{channel}", 1.0)
            for name in ("zero", "home", "added"):
                row += chain.get(f"{CHAIN}{name}.{channel}", 0.0)
            if f"{CHAIN}cross.{channel}" in chain:
                row += chain[f"{CHAIN}cross.{channel}"] * self._commands_v
            if channel == "pressure_pa" and f"{CHAIN}atmosphere" in chain:
                row += self._atmosphere_pa - chain[f"{CHAIN}atmosphere"]
        return rows


def _read_at(t_s: Array, when_s: Array, readings: Array) -> Array:
    """Return readings at other times; between samples by cubes: lines would damp quick motions."""
    number = np.interp(t_s, when_s, np.arange(len(when_s)))
    return np.asarray(map_coordinates(readings, [number], order=3, mode="nearest"))


@cache
def _start_threads(jobs: int) -> ThreadPoolExecutor:
    """Return threads that drive records side by side: a kernel in C needs no interpreter."""
    return ThreadPoolExecutor(jobs, "drive")


def hold_out(runs: Runs) -> tuple[Runs, Runs | None]:
    """Return the part that is fitted, and two short stretches of each record that are not.

    The latter is None where no record has as many blocks.
    """
    number = [
        TWELFTHS * (b + 0.5) / n for n in np.array(runs.sizes) // runs.block for b in range(n)
    ]
    held = np.isin(np.floor(number), HELD_OUT)
    shows = (~runs.masked[:, held]).any(axis=(1, 2)).all()
    return (runs.part(~held), runs.part(held)) if shows else (runs, None)


def _choose_channels(records: Sequence[Recording], actuator: str, imposed: bool) -> tuple[str, ...]:
    """Return what the simulation predicts; raise TooLittleRecorded where an input is missing."""
    if not records:
        raise TooLittleRecorded("no records: one at least is needed")
    measured = [
        name
        for name in ("valve_v", "pressure_pa", "position_m", "force_n")
        if all(getattr(r, name) is not None for r in records)
    ]
    if actuator == "direct":
        if "position_m" not in measured or not {"force_n", "pressure_pa"} & {*measured}:
            raise TooLittleRecorded(
                "a direct mechanism needs position_m, and force_n or pressure_pa"
            )
        return ("force_n",) if imposed else ("position_m",)
    if "valve_v" in measured:
        wanted = ("pressure_pa",) if actuator == "chamber" else ("position_m", "pressure_pa")
        channels = tuple(name for name in wanted if name in measured)
    else:
        both = {"pressure_pa", "position_m"} <= {*measured} and actuator in ("muscle", "cylinder")
        channels = ("position_m",) if both else ()
    if not channels:
        raise TooLittleRecorded(
            f"a {actuator} needs valve_v and a sensor, or pressure_pa and position_m"
        )
    return channels


def join_waves(values: Mapping[str, float]) -> tuple[dict[str, float], dict[str, float]]:
    """Return the plant's numbers, and those of the measuring chain.

    The two sizes of a wave become the amplitude and phase that the plant knows.
    """
    plain = {name: float(v) for name, v in values.items() if not name.startswith(CHAIN)}
    chain = {name: float(v) for name, v in values.items() if name.startswith(CHAIN)}
    for name in [n for n in chain if n.endswith(".sine")]:
        family = name.removesuffix(".sine").removeprefix(CHAIN)
        sine, cosine = chain.pop(name), chain.pop(f"{CHAIN}{family}.cosine")
        is_term = family.endswith("_term")
        size, phase = ("size", "phase") if is_term else ("amplitude_pa", "phase_rad")
        plain[f"{family}.{size}"] = float(np.hypot(sine, cosine))
        plain[f"{family}.{phase}"] = float(np.arctan2(cosine, sine))
    return plain, chain
