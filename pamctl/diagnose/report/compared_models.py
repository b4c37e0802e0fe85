"""The models that a page shows side by side, and what each makes of the held-out records."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.extend import assemble_plant
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE, Drive
from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.report.page_words import spell_names
from pamctl.plant.drive import drive_coupled
from pamctl.plant.model import PlantSettings, plant_parameters


class ModelStage(NamedTuple):
    """A model on the way from the one that was started with to the one to go on with."""

    key: str
    """The name of its level in a `Gap`."""
    label: str
    plant: PlantSettings
    colour: int


class SignalDisplay(NamedTuple):
    """How a signal is shown: users think in mm, µm and kPa."""

    title: str
    unit: str
    factor: float
    gap_unit: str
    gap_factor: float


SIGNAL_DISPLAYS: Mapping[str, SignalDisplay] = {
    "position_m": SignalDisplay("Displacement", "mm", 1e3, "µm", 1e6),
    "pressure_pa": SignalDisplay("Pressure, absolute", "kPa", 1e-3, "kPa", 1e-3),
}


def list_model_stages(diagnosis: Diagnosis) -> list[ModelStage]:
    """Return the models that this verdict sets beside each other, the last one to go on with."""
    model, base = diagnosis.model, diagnosis.base
    if model is None or base is None:
        return []
    found = [ModelStage("nominal", "as it stood", diagnosis.nominal, 3)]
    if diagnosis.verdict is not Verdict.NO_DISCREPANCY:
        found.append(ModelStage("recalibrated", "recalibrated", assemble_plant(base), 1))
    if model.effects:
        label = f"with {spell_names(*model.names)}"
        found.append(ModelStage("extended", label, assemble_plant(model), 0))
    if diagnosis.corrected is not None and diagnosis.corrected.blocks:
        found.append(ModelStage("corrected", "with an unnamed correction", diagnosis.plant, 2))
    return found


@dataclass(frozen=True)
class HeldOutSignal:
    """One measured signal of a held-out record, and the simulations of it, in SI."""

    name: str
    measured: Array
    simulated: Mapping[str, Array]
    """By the key of the stage."""
    deviation: float
    """Of its sensor."""

    def residual(self, key: str) -> Array:
        """Return measurement minus simulation."""
        return self.measured - self.simulated[key]


@dataclass(frozen=True)
class HeldOutRun:
    """A record that nothing was fitted to, in the samples that were held out."""

    name: str
    t_s: Array
    command_v: Array | None
    counted: NDArray[np.bool_]
    """Which samples were held out, where a single run was cut into stretches."""
    signals: tuple[HeldOutSignal, ...]


def simulate_held_out(diagnosis: Diagnosis) -> list[HeldOutRun]:
    """Simulate every stage on every held-out record: coupled, by the command alone, where one is.

    Of records that drive one block only, that block is simulated.
    """
    model = diagnosis.model
    if model is None:
        return []
    drives = model.evidence.holdout
    shown = list_model_stages(diagnosis)
    if len(drives) == 2:
        pairs = zip(drives[PRESSURE], drives[MECHANICS], strict=True)
        return [_simulate_both_blocks(pressure, mechanics, shown) for pressure, mechanics in pairs]
    (block,) = drives
    return [_simulate_one_block(drive, shown) for drive in drives[block]]


def _simulate_both_blocks(pressure: Drive, mechanics: Drive, shown: list[ModelStage]) -> HeldOutRun:
    driven = {
        stage.key: drive_coupled(plant_parameters(stage.plant), pressure.valve_v, pressure.step_s)
        for stage in shown
    }
    position = HeldOutSignal(
        "position_m",
        mechanics.measured,
        {key: found.position_m for key, found in driven.items()},
        mechanics.deviation,
    )
    gauge = HeldOutSignal(
        "pressure_pa",
        pressure.measured,
        {key: found.pressure_pa for key, found in driven.items()},
        pressure.deviation,
    )
    return _collect_run(pressure, pressure.valve_v, (position, gauge))


def _simulate_one_block(drive: Drive, shown: list[ModelStage]) -> HeldOutRun:
    name = "pressure_pa" if drive.block == PRESSURE else "position_m"
    simulated = {stage.key: drive.simulate(stage.plant) for stage in shown}
    command_v = drive.valve_v if drive.block == PRESSURE else None
    signal = HeldOutSignal(name, drive.measured, simulated, drive.deviation)
    return _collect_run(drive, command_v, (signal,))


def _collect_run(
    drive: Drive, command_v: Array | None, signals: tuple[HeldOutSignal, ...]
) -> HeldOutRun:
    t_s = np.concatenate([[0.0], np.cumsum(drive.step_s)])
    counted = np.ones(len(t_s), dtype=bool) if drive.rows is None else drive.rows
    return HeldOutRun(drive.name, t_s, command_v, counted, signals)
