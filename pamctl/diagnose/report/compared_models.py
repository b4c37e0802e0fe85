"""The models that a page compares, and their simulations of the held-out records."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.extend import assemble_plant
from pamctl.diagnose.fitting.drives import PRESSURE, RUNAWAY, Drive
from pamctl.diagnose.fitting.held_out_rms import simulate_held_out
from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.report.phrases import spell_names
from pamctl.log.moments import Moment
from pamctl.plant.model import PlantSettings


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
    moments: tuple[Moment, ...] = ()


def simulate_stages(diagnosis: Diagnosis) -> list[HeldOutRun]:
    """Simulate every stage on every held-out record.

    The blocks are coupled and the command alone drives them. Where the records drive only one
    block, that block alone is simulated.
    """
    model, listed = diagnosis.model, list_model_stages(diagnosis)
    if model is None or not listed:
        return []
    evidence = model.evidence
    stages = {stage.key: simulate_held_out(evidence, stage.plant) for stage in listed}
    blocks = next(iter(stages.values())).blocks
    moments = {record.name: record.moments for record in diagnosis.holdout}
    runs = [
        _collect_run(
            {channel: evidence.holdout[block][k] for channel, block in blocks.items()},
            {key: {c: runs[k] for c, runs in s.simulated.items()} for key, s in stages.items()},
        )
        for k in range(len(evidence.holdout[evidence.blocks[0]]))
    ]
    return [replace(run, moments=moments.get(run.name, ())) for run in runs]


def _collect_run(
    drives: Mapping[str, Drive], simulated: Mapping[str, Mapping[str, Array]]
) -> HeldOutRun:
    """Collect a run from its drives by channel, and its simulations by stage and channel."""
    signals = tuple(
        HeldOutSignal(
            channel,
            drive.measured,
            {key: run[channel] for key, run in simulated.items()},
            drive.deviation,
        )
        for channel, drive in drives.items()
    )
    first = drives.get("pressure_pa") or next(iter(drives.values()))
    t_s = np.concatenate([[0.0], np.cumsum(first.step_s)])
    counted = np.ones(len(t_s), dtype=bool) if first.rows is None else first.rows
    command_v = first.valve_v if first.block == PRESSURE else None
    return HeldOutRun(first.name, t_s, command_v, counted, signals)
