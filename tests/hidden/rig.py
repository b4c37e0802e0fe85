"""A rig whose truth is hidden: excite it, and get what its sensors showed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hidden.effects import Size, apply
from hidden.equations.motion import fill_closed_loop, fill_open_loop, settle
from hidden.equations.truth import Truth
from hidden.excitations import Excitation
from hidden.sensors import ADC_STEP_PA, AO_STEP_V, ENCODER_STEP_M, Sensors, remember
from pamctl.kernel.calls import machine

Array = NDArray[np.float64]

COLUMNS = ("t_s", "valve_v", "pressure_pa", "position_m", "force_n")


@dataclass(frozen=True)
class Record:
    """What a user has after a run: columns of one length, absent where nothing was measured."""

    name: str
    t_s: Array
    valve_v: Array | None = None
    pressure_pa: Array | None = None
    position_m: Array | None = None
    force_n: Array | None = None

    def columns(self) -> dict[str, Array]:
        """Return the measured columns, in the order of a CSV file."""
        found = {name: getattr(self, name) for name in COLUMNS}
        return {name: column for name, column in found.items() if column is not None}

    def without(self, *names: str) -> Record:
        """Return the record of a rig that lacks these columns."""
        return replace(self, **dict.fromkeys(names))


FLOORS = {"pressure_pa": 300.0, "position_m": 5e-6}
"""A sensor's noise; a count's error, and what the pressure's noise does to a muscle that sticks."""


def in_floors(records: Sequence[Record]) -> Array:
    """Return pressure and position of records in floors, one row a channel that they have."""
    columns = [record.columns() for record in records]
    rows = [
        np.concatenate([own[name] / floor for own in columns])
        for name, floor in FLOORS.items()
        if name in columns[0]
    ]
    return np.stack(rows)


@dataclass(frozen=True)
class Passage:
    """A record, and beside it what nobody measures: for the tests of the rigs themselves."""

    record: Record
    true_pressure_pa: Array
    true_position_m: Array


@dataclass(frozen=True)
class HiddenRig:
    """One rig: its truth, its sensors, and the seed of everything random on it."""

    truth: Truth
    sensors: Sensors
    seed: int
    step_s: float = 0.0
    """0: as small as this truth needs."""

    def run(self, excitation: Excitation) -> Passage:
        """Excite the rig from rest, vented, and return what was measured."""
        step_s = self.step_s or needed_step_s(self.truth)
        rng = np.random.default_rng([self.seed, excitation.seed, len(excitation.name)])
        t_s = self._ticks(excitation, rng)
        noise = self._noise(len(t_s), rng)
        state = settle(self.truth, excitation.rest_v, step_s)
        volts, forces = np.zeros(len(t_s)), np.zeros(len(t_s))
        seen = np.empty((4, len(t_s)))
        if excitation.wanted_m is not None:
            machine(fill_closed_loop)(
                self.truth, state, t_s, self._scaled(excitation.wanted_m), excitation.rest_s,
                excitation.rest_v, excitation.gains, self._reading(state.geared_m), noise,
                step_s, seen, volts,
            )  # fmt: skip
        else:
            if excitation.volts is not None:
                volts = np.round(excitation.volts / AO_STEP_V) * AO_STEP_V
            if excitation.force_n is not None:
                volts, forces = np.zeros(len(t_s)), excitation.force_n
            machine(fill_open_loop)(self.truth, state, t_s, volts, forces, step_s, seen)
        return self._measured(excitation, t_s, volts, forces, seen, state.geared_m, noise, rng)

    def _ticks(self, excitation: Excitation, rng: np.random.Generator) -> Array:
        """Return when the loop really read: late by a little, now and then by more."""
        grid = np.arange(excitation.samples) * 1e-3
        if self.sensors.perfect:
            return grid
        late = rng.exponential(self.sensors.clock_jitter_s, len(grid))
        late[rng.random(len(grid)) < 1e-3] += rng.uniform(50e-6, 300e-6)
        return grid + np.minimum(late, 0.5e-3)

    def _noise(self, n: int, rng: np.random.Generator) -> Array:
        s = self.sensors
        if s.perfect:
            return np.zeros(n)
        keep, first = np.exp(-1.0 / 4.0), rng.normal()
        slow = remember(keep, first, rng.normal(size=n) * np.sqrt(1.0 - keep**2))
        white = np.sqrt(1.0 - s.coloured_share) * rng.normal(size=n)
        return s.pressure_noise_pa * (white + np.sqrt(s.coloured_share) * slow)

    def _reading(self, rest_m: float) -> tuple[float, float, float, float, float]:
        """Return (counts per metre, phase, pressure gain, offset, AO step) for the closed loop."""
        s = self.sensors
        per_m = s.encoder_scale / ENCODER_STEP_M
        phase = s.encoder_phase - (rest_m * per_m if s.encoder_homed else 0.0)
        return per_m, phase, s.pressure_gain, s.pressure_offset_pa, AO_STEP_V

    def _scaled(self, wanted_m: Array) -> Array:
        # the loop divides its counts by the scaled counts per metre: undone in the record
        return wanted_m / self.sensors.encoder_scale

    def _measured(
        self,
        excitation: Excitation,
        t_s: Array,
        volts: Array,
        forces: Array,
        seen: Array,
        rest_m: float,
        noise: Array,
        rng: np.random.Generator,
    ) -> Passage:
        s = self.sensors
        atmosphere = self.truth.atmosphere_pa
        pressure = atmosphere + s.pressure_gain * (seen[0] - atmosphere) + s.pressure_offset_pa
        position = s.encoder_scale * (seen[1] - (rest_m if s.encoder_homed else 0.0))
        if not s.perfect:
            pressure = np.round((pressure + noise) / ADC_STEP_PA) * ADC_STEP_PA
            counts = np.floor(position / ENCODER_STEP_M + s.encoder_phase)
            position = counts * ENCODER_STEP_M
            t_s = np.round(t_s, 6)
        record = Record(excitation.name, t_s, volts, pressure, position)
        if excitation.force_n is not None:
            felt = forces if s.perfect else forces + rng.normal(0.0, s.force_noise_n, len(t_s))
            record = Record(excitation.name, t_s, position_m=position, force_n=felt)
        kept = _missing(len(t_s), s.missed_ticks, rng)
        cut = {name: column[kept] for name, column in record.columns().items()}
        return Passage(replace(record, **cut), seen[2][kept], seen[3][kept])


def needed_step_s(truth: Truth) -> float:
    """Return a step whose halving moves nothing by more than a fraction of a count."""
    if truth.stribeck > 0.0:
        return 5e-6  # a friction that falls with speed makes the break-away unstable
    return 10e-6 if truth.line_pa_s_per_kg > 0.0 else 20e-6


def _missing(n: int, ticks: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return which rows were recorded, when an overrun costs one or two of them."""
    kept = np.ones(n, dtype=np.bool_)
    for _ in range(ticks):
        at = int(rng.integers(n // 4, n - 4))
        kept[at : at + int(rng.integers(1, 3))] = False
    return kept


PULLED = Truth(direct=1.0, mass_kg=0.4, damping=30.0, stiffness=4000.0)
"""A carriage between springs, pulled through a load cell: nothing of the muscle is left."""


def hidden_rig(
    effects: Mapping[str, Size] | None = None,
    *,
    seed: int,
    miscalibrated: bool = True,
    actuator: str = "muscle",
) -> HiddenRig:
    """Build a rig with effects (name -> size, as in `effects.py`) that its user knows nothing of.

    Its parameters differ from the paper's by a few per cent (`miscalibrated`), its noise is
    150 to 600 Pa, its encoder was homed anywhere within a count. With `actuator="direct"` it is
    the pulled carriage instead of the muscle.
    """
    rng = np.random.default_rng([7919, seed])
    truth = PULLED if actuator == "direct" else Truth()
    off = rng.uniform(-1.0, 1.0, 6)
    if miscalibrated:
        truth = truth._replace(
            damping=truth.damping * (1.0 + 0.06 * off[0]),
            stiffness=truth.stiffness * (1.0 + 0.05 * off[1]),
            mu_k=truth.mu_k * (1.0 + 0.08 * off[2]),
            valve_m2_per_v=truth.valve_m2_per_v * (1.0 + 0.07 * off[3]),
            supply_pa=truth.supply_pa * (1.0 + 0.015 * off[4]),
            braid_m=truth.braid_m * (1.0 + 0.003 * off[5]),
        )
    sensors = Sensors(
        pressure_noise_pa=float(rng.choice([150.0, 300.0, 600.0])),
        coloured_share=float(rng.uniform(0.0, 0.4)),
        encoder_phase=float(rng.uniform(0.0, 1.0)),
    )
    truth, sensors = apply(effects or {}, truth, sensors, rng)
    return HiddenRig(truth, sensors, seed)
