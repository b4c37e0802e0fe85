"""The models that a page compares, and their simulations of the held-out records."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.extend import assemble_plant
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE, RUNAWAY, Drive
from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.report.phrases import spell_names
from pamctl.plant.drive import drive_coupled
from pamctl.plant.model import PlantSettings, plant_parameters


class ModelStage(NamedTuple):
    """One of the models between the start model and the model to go on with."""

    key: str
    """The name of its level in a `HeldOutGap`."""
    label: str
    plant: PlantSettings
    colour: int


LARGE_GAP = 1e4
"""A gap of more of its units is shown in the unit of the signal: 20 mm, not 2e+04 µm."""


class SignalDisplay(NamedTuple):
    """How a signal is shown: users think in mm, µm and kPa."""

    title: str
    unit: str
    factor: float
    gap_unit: str
    gap_factor: float

    def choose_unit(self, size: float) -> tuple[float, str]:
        """Return factor and unit for a gap of this size in SI: a large one is shown as a signal."""
        if size * self.gap_factor < LARGE_GAP:
            return self.gap_factor, self.gap_unit
        return self.factor, self.unit


SIGNAL_DISPLAYS: Mapping[str, SignalDisplay] = {
    "position_m": SignalDisplay("Displacement", "mm", 1e3, "µm", 1e6),
    "pressure_pa": SignalDisplay("Pressure, absolute", "kPa", 1e-3, "kPa", 1e-3),
    "force_n": SignalDisplay("Force", "N", 1.0, "N", 1.0),
}


def list_model_stages(diagnosis: Diagnosis) -> list[ModelStage]:
    """Return the models that this verdict compares; the last one is the model to go on with."""
    model, base = diagnosis.model, diagnosis.base
    if model is None or base is None:
        return []
    stages = [ModelStage("nominal", "start model", diagnosis.nominal, 3)]
    if diagnosis.verdict is not Verdict.NO_DISCREPANCY:
        stages.append(ModelStage("recalibrated", "recalibrated", assemble_plant(base), 1))
    if model.effects:
        label = f"with {spell_names(*model.names)}"
        stages.append(ModelStage("extended", label, assemble_plant(model), 0))
    if diagnosis.correction is not None and diagnosis.correction.blocks:
        stages.append(ModelStage("corrected", "with an unnamed correction", diagnosis.plant, 2))
    return stages


@dataclass(frozen=True)
class HeldOutSignal:
    """One measured signal of a held-out record, and its simulations, in SI."""

    name: str
    measured: Array
    simulated: Mapping[str, Array]
    """By the key of the stage."""
    deviation: float
    """Standard deviation of its sensor."""

    def residual(self, key: str) -> Array:
        """Return measurement minus simulation; a model that runs away stays drawable."""
        most = RUNAWAY * self.deviation
        return np.nan_to_num(self.measured - self.simulated[key], nan=most).clip(-most, most)


@dataclass(frozen=True)
class HeldOutRun:
    """A record that was not used for any fit."""

    name: str
    t_s: Array
    command_v: Array | None
    counted: NDArray[np.bool_]
    """The samples that were held out: all, unless a single run was cut into stretches."""
    signals: tuple[HeldOutSignal, ...]


def simulate_held_out(diagnosis: Diagnosis) -> list[HeldOutRun]:
    """Simulate every stage on every held-out record.

    The blocks are coupled and the command alone drives them. Where the records drive only one
    block, that block alone is simulated.
    """
    model = diagnosis.model
    if model is None:
        return []
    drives = model.evidence.holdout
    stages = list_model_stages(diagnosis)
    if len(drives) == 2:
        pairs = zip(drives[PRESSURE], drives[MECHANICS], strict=True)
        return [_simulate_both_blocks(pressure, mechanics, stages) for pressure, mechanics in pairs]
    (block,) = drives
    return [_simulate_one_block(drive, stages) for drive in drives[block]]


def _simulate_both_blocks(
    pressure: Drive, mechanics: Drive, stages: list[ModelStage]
) -> HeldOutRun:
    simulated = {
        stage.key: drive_coupled(plant_parameters(stage.plant), pressure.valve_v, pressure.grid)
        for stage in stages
    }
    position = HeldOutSignal(
        "position_m",
        mechanics.measured,
        {key: run.position_m for key, run in simulated.items()},
        mechanics.deviation,
    )
    absolute = HeldOutSignal(
        "pressure_pa",
        pressure.measured,
        {key: run.pressure_pa for key, run in simulated.items()},
        pressure.deviation,
    )
    return _collect_run(pressure, pressure.valve_v, (position, absolute))


def _simulate_one_block(drive: Drive, stages: list[ModelStage]) -> HeldOutRun:
    simulated = {stage.key: drive.simulate(stage.plant) for stage in stages}
    command_v = drive.valve_v if drive.block == PRESSURE else None
    signal = HeldOutSignal(drive.channel, drive.measured, simulated, drive.deviation)
    return _collect_run(drive, command_v, (signal,))


def _collect_run(
    drive: Drive, command_v: Array | None, signals: tuple[HeldOutSignal, ...]
) -> HeldOutRun:
    t_s = np.concatenate([[0.0], np.cumsum(drive.step_s)])
    counted = np.ones(len(t_s), dtype=bool) if drive.rows is None else drive.rows
    return HeldOutRun(drive.name, t_s, command_v, counted, signals)
