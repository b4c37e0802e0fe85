"""The model driven by the logged command, against the measurement.

    coupled         command            -> position, pressure
    pressure block  command, position  -> pressure
    mechanics       pressure, force    -> position

The coupled model shows how far a simulation is from this run. Each block alone is driven by the
other's measured signal, so an error of one block does not appear in the other. A diagnosis begins
there. Imported logs are compared in the signals that they hold.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.evidence.measured_columns import find_starts, judge_motion
from pamctl.diagnose.evidence.run_pieces import GAP, WARM_S, WINDOW_S
from pamctl.log import Log, LogError, Signals, signals
from pamctl.log.record_problems import find_frozen
from pamctl.plant.drive import NO_RESTARTS, Restarts, drive_coupled, drive_mechanics, drive_pressure
from pamctl.plant.effects.description import USED_SIGNALS, Actuator, describe_unused
from pamctl.plant.model import plant_parameters
from pamctl.plant.parameters import PlantParameters, PlantState, rest_state
from pamctl.plant.sample_grid import accumulate_times, build_grid, count_steps, find_period_s
from pamctl.settings.config_files import DEFAULT_NAMES, find_config_file
from pamctl.settings.resolve import SECTIONS, RawSettings, read_section_file, validate_settings
from pamctl.signals import Phase

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

NEAR_NULL_V = 0.1
"""A smaller command hardly opens the valve."""
_SHORTEST = 20
"""Shorter stretches (ticks) are left out."""
_START_TICKS = 20


class ComparisonGap(NamedTuple):
    """Model minus measurement, in the unit of the signal; NaN if not available."""

    rms: float
    max: float


class ModelOutput(NamedTuple):
    """The model's signals, each of shape (n,); NaN where not driven, None if not possible."""

    way: str
    position_m: Floats | None
    pressure_pa: Floats | None


@dataclass(frozen=True)
class Comparison:
    """The comparison of a model with a log, over the ticks that can be compared."""

    measured: Signals
    coupled: ModelOutput
    pressure_block: ModelOutput
    mechanics: ModelOutput
    again_s: float | None = None
    """The mechanics begin again from the measured state so often; None where they run freely."""
    unused: tuple[str, ...] = ()
    """A sentence for each signal of the log that the model does not read."""
    frozen: Mask | None = None
    """Ticks at which a sensor is frozen, which count in no gap; None where there are none."""
    pauses: int = 0
    """Times at which the record went on after a pause, and the model began again."""

    @property
    def all_ways(self) -> tuple[ModelOutput, ModelOutput, ModelOutput]:
        """Every way of driving a model."""
        return self.coupled, self.pressure_block, self.mechanics

    @property
    def ways(self) -> list[ModelOutput]:
        """The ways of driving this model that gave a signal: a chamber's two are one."""
        ways = [w for w in self.all_ways if w.position_m is not None or w.pressure_pa is not None]
        is_chamber = self.coupled.pressure_pa is self.pressure_block.pressure_pa is not None
        return [w for w in ways if not (is_chamber and w is self.pressure_block)]

    def gap(self, modelled: ModelOutput, signal: str) -> ComparisonGap:
        """Return the gap of one way of driving in `position_m` or `pressure_pa`."""
        model = getattr(modelled, signal)
        if model is not None and self.frozen is not None:
            model = np.where(self.frozen, np.nan, model)
        return measure_gap(model, getattr(self.measured, signal))


def compare_model(
    log: Log,
    plant: PlantParameters,
    actuator: Actuator | None = None,
    progress: Callable[[float, str], object] = lambda share, block: None,
) -> Comparison:
    """Drive a model by a log; raise `LogError` if the log cannot drive it.

    A chamber must be said to be one: it does not move, whatever position is beside it. A mechanism
    that forgets nothing begins again from the measured state in windows, as in a diagnosis; and
    every model after a pause of the record, whose first moments count in no gap.
    `progress` gets the share that is done, and the block that is driven.
    """
    measured = select_comparable(log, plant)
    actuator = actuator or ("direct" if plant.direct else "muscle")
    unused = [
        name
        for name in ("valve_v", "pressure_pa", "position_m", "force_n")
        if getattr(measured, name) is not None and name not in USED_SIGNALS[actuator]
    ]
    usual_s = _find_usual_s(measured)
    pauses = np.flatnonzero(np.diff(measured.t_s) > GAP * usual_s) + 1
    without: dict[str, Any] = dict.fromkeys(unused)
    used = replace(measured, **without)
    is_chamber = actuator == "chamber"
    if is_chamber and (used.valve_v is None or used.pressure_pa is None):
        raise LogError(
            f"{log.path}: a chamber needs valve_v to drive it, and pressure_pa to compare it with"
        )
    stretches = list(_find_stretches(used, pauses))
    if not stretches:
        raise LogError(f"{log.path} has no {_SHORTEST} complete ticks in a row")
    rows = {name: np.full(len(measured), np.nan) for name in ("x", "p", "block_p", "block_x")}
    commanded = used.valve_v is not None
    pressed = used.pressure_pa is not None and not is_chamber
    pulled = used.force_n is not None
    again_s = WINDOW_S if judge_motion([used[s] for s in stretches], actuator, usual_s)[1] else None
    was_homed = not log.is_imported and bool(np.any(log["phase"] == Phase.HOMING))
    for number, stretch in enumerate(stretches):
        part = used[stretch]
        start = _find_start(plant, part, follows_homing=stretch.start == 0 and was_homed)
        # The mechanics have no command, and need no step where one acts.
        steps = count_steps(find_period_s(part.dt_s[1:]))
        grid = build_grid(part.dt_s[1:], len(part), steps, part.acts_after_s, part.held_v)
        if commanded and part.valve_v is not None:
            progress(number / len(stretches), "coupled")
            driven = drive_coupled(plant, part.valve_v, grid, start=start)
            rows["x"][stretch], rows["p"][stretch] = driven.position_m, driven.pressure_pa
        if commanded and part.valve_v is not None and part.position_m is not None:
            progress((number + 0.4) / len(stretches), "pressure block")
            rows["block_p"][stretch] = drive_pressure(
                plant, part.valve_v, part.position_m, grid, start=start
            ).pressure_pa
        del grid  # of a long log, a third of all memory; the mechanics need another one
        if pressed or pulled:
            progress((number + 0.7) / len(stretches), "mechanics")
            vented_pa = np.full(len(part), plant.atmospheric_pressure_pa)
            again = None if again_s is None else _begin_again(plant, part, again_s)
            rows["block_x"][stretch] = drive_mechanics(
                plant,
                vented_pa if part.pressure_pa is None else part.pressure_pa,
                part.dt_s[1:],
                force_n=part.force_n if pulled else None,
                start=start if again is None else again[0],
                steps=steps,
                restarts=NO_RESTARTS if again is None else again[1],
            ).position_m
    for row, begin in product(rows.values(), pauses):
        row[begin : begin + round(WARM_S / usual_s)] = np.nan
    drives_block = commanded and used.position_m is not None
    block_pa = rows["p"] if is_chamber else rows["block_p"] if drives_block else None
    return Comparison(
        measured,
        ModelOutput(
            "coupled",
            rows["x"] if commanded and not is_chamber else None,
            rows["p"] if commanded else None,
        ),
        ModelOutput("pressure block", None, block_pa),
        ModelOutput("mechanics", rows["block_x"] if pressed or pulled else None, None),
        again_s,
        tuple(describe_unused(name, actuator) for name in unused),
        _find_frozen(used),
        len(pauses),
    )


def _find_frozen(used: Signals) -> Mask | None:
    sensors = (used.pressure_pa, used.position_m, used.force_n)
    found = [find_frozen(used.t_s, s) for s in sensors if s is not None]
    frozen = np.logical_or.reduce(found) if found else np.zeros(len(used), bool)
    return frozen if frozen.any() else None


def _begin_again(
    plant: PlantParameters, part: Signals, every_s: float
) -> tuple[PlantState, Restarts]:
    """Return the measured state at the begin of a stretch, and at its every so many seconds."""
    assert part.position_m is not None
    period_s = _find_usual_s(part)
    rates = find_starts(part.position_m, period_s, accumulate_times(part.dt_s[1:]))
    step = max(1, round(every_s / period_s))
    rows = np.arange(step, len(part), step)
    pressure_pa = plant.atmospheric_pressure_pa
    if part.pressure_pa is not None:
        pressure_pa = float(part.pressure_pa[0])
    start = rest_state(plant, float(rates["smooth"][0]), pressure_pa)
    start = start._replace(velocity_m_per_s=float(rates["speed"][0]))
    return start, Restarts(rows, rates["smooth"][rows], rates["speed"][rows])


def _find_usual_s(part: Signals) -> float:
    return float(np.median(part.dt_s[1:]))


def select_comparable(log: Log, plant: PlantParameters) -> Signals:
    """Return the signals of a log after homing: the zeros differ before it.

    Raises `LogError` if the model cannot be driven or compared.
    """
    measured = signals(log)
    is_driven = measured.force_n is not None or measured.pressure_pa is not None
    if plant.direct and not (is_driven and measured.position_m is not None):
        raise LogError(
            f"{log.path}: a mechanism needs force_n, or pressure_pa on its piston, to drive it, "
            "and position_m to compare it with"
        )
    here = [
        name
        for name in ("valve_v", "pressure_pa", "position_m")
        if getattr(measured, name) is not None
    ]
    if len(here) < 2 and not plant.direct:
        raise LogError(
            f"{log.path} holds {' and '.join(here) or 'no signal'} only: a model needs one signal "
            "of valve_v, pressure_pa, position_m to drive it, and another to compare it with; a "
            "mechanism that a force drives needs a plant with `actuator: direct`"
        )
    homing = np.flatnonzero(measured.phase == Phase.HOMING)
    return measured[int(homing[-1]) + 1 if len(homing) else 0 :]


def measure_gap(model: Floats | None, measured: Floats | None) -> ComparisonGap:
    """Return the gap over the ticks at which both are known."""
    if model is None or measured is None:
        return ComparisonGap(np.nan, np.nan)
    apart = np.abs(model - measured)
    apart = apart[np.isfinite(apart)]
    if not len(apart):
        return ComparisonGap(np.nan, np.nan)
    return ComparisonGap(float(np.sqrt(np.mean(apart**2))), float(apart.max()))


def _find_stretches(measured: Signals, pauses: NDArray[np.intp]) -> Iterator[slice]:
    """Yield stretches without lost ticks or pauses, in which all signals are numbers."""
    whole = np.ones(len(measured), bool)
    for signal in (measured.valve_v, measured.pressure_pa, measured.position_m, measured.force_n):
        if signal is not None:
            whole &= np.isfinite(signal)
    # Where the log lost ticks, the command is unknown.
    lost = np.abs(np.diff(measured.t_s) - measured.dt_s[1:]) > 0.5 * np.median(measured.dt_s)
    breaks = {0, len(measured), *(np.flatnonzero(lost) + 1).tolist(), *pauses.tolist()}
    breaks |= set((np.flatnonzero(np.diff(whole.astype(np.int8))) + 1).tolist())
    for begin, end in pairwise(sorted(breaks)):
        if whole[begin] and end - begin >= _SHORTEST:
            yield slice(begin, end)


def _find_start(plant: PlantParameters, part: Signals, *, follows_homing: bool) -> PlantState:
    """Return the state at the first sample: vented after homing, otherwise at rest as measured."""
    if follows_homing:
        return rest_state(plant, 0.0, plant.atmospheric_pressure_pa)
    quiet = part.valve_v is not None and bool(
        np.all(np.abs(part.valve_v[:_START_TICKS]) < NEAR_NULL_V)
    )
    samples = slice(0, _START_TICKS if quiet else 1)

    def level(signal: Floats | None, otherwise: float) -> float:
        return otherwise if signal is None else float(np.mean(signal[samples]))

    return rest_state(
        plant,
        level(part.position_m, 0.0),
        level(part.pressure_pa, plant.atmospheric_pressure_pa),
    )


OWN_PLANT = "the log's own"


def compare_plants(
    log: Log,
    names: Sequence[str],
    progress: Callable[[float, float, str], object] = lambda done, of, doing: None,
) -> dict[str, Comparison]:
    """Compare a log with each plant; by default with the log's own plant, or the default plant.

    `progress` gets how many plants are done of how many, and what is done now. Raises
    `ConfigError` and `LogError`.
    """
    if not names and "plant" in log.config:
        raw = RawSettings(log.config["plant"], {(): f"{log.path}:config.json"})
        plants = {OWN_PLANT: validate_settings(SECTIONS["plant"], raw, title="plant")}
    else:
        plants = {
            name: read_section_file("plant", find_config_file("plant", name))
            for name in names or [DEFAULT_NAMES["plant"]]
        }
    return {
        name: compare_model(
            log,
            plant_parameters(settings),
            settings.actuator,
            lambda share, block, name=name, done=done: progress(  # type: ignore[misc]
                done + share, len(plants), f"{name}, {block}"
            ),
        )
        for done, (name, settings) in enumerate(plants.items())
    }
