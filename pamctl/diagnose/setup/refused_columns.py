"""Records that were refused: which one column, read otherwise, makes them fit the plant file?

A wrong sign, a gauge pressure, another unit: each is tried on all records. What the checks then
accept is simulated with the plant file's numbers, and the nearest reading is the finding.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pamctl.diagnose.fitting.block_fit import rms
from pamctl.diagnose.fitting.drives import MECHANICS, stack_residuals
from pamctl.diagnose.fitting.evidence import prepare_evidence
from pamctl.diagnose.measured.record import Array, Record
from pamctl.diagnose.measured.refuse import BadData, check_measured_runs
from pamctl.diagnose.setup.finding_words import advise_mending, describe
from pamctl.diagnose.setup.setup_finding import SetupFinding
from pamctl.diagnose.setup.suspects import Kind, Suspect
from pamctl.plant.model import PlantSettings

LEAST_LIKE = 0.5
"""A reading is believed if the plant file's model leaves less than this share of the signal."""
FACTORS = {
    "position_m": (4.0, 0.25, 2.0, 0.5, 10.0, 100.0, 1e3, 1e6, 25.4, 39.37),
    "pressure_pa": (1e-3, 1e-5, 1e-2, 1e-6, 1.0 / 6894.76),
    "valve_v": (1e3, 20.0, 10.0),
}
"""Shown over true: edges of an encoder, and units (mm, um, inch; kPa, bar, hPa, MPa, psi; mV)."""


@dataclass(frozen=True)
class _Reading:
    kind: Kind
    column: str
    value: float
    """What the finding says: a factor, or the pressure that is missing."""
    unit: str
    about: float = 0.0
    """A wrong sign turns the column about this value."""

    def mend(self, record: Record) -> Record:
        values: Array = record[self.column]
        if self.kind == "gauge":
            mended = values - self.value
        else:
            mended = self.about + (values - self.about) / self.value
        changed: dict[str, Any] = {self.column: mended}
        return replace(record, **changed)


def explain_refusal(records: Sequence[Record], plant: PlantSettings) -> tuple[SetupFinding, ...]:
    """Return the reading of one column that makes refused records fit, if there is one."""
    if plant.actuator == "direct":  # its numbers are guesses: nothing to compare
        return ()
    if len({record.channels for record in records}) != 1:  # no reading mends that
        return ()
    likely = []
    for reading in _list_readings(records, plant):
        mended = [reading.mend(record) for record in records]
        try:
            check_measured_runs(mended, plant)
        except BadData:
            continue
        left = _measure_unlikeness(mended, plant)
        if left < LEAST_LIKE:
            likely.append((left, reading))
    if not likely:
        return ()
    left, reading = min(likely, key=lambda pair: pair[0])
    suspect = Suspect(
        reading.kind, reading.column, reading.unit, 0.0, 0.0, (), 1.0, frozenset({MECHANICS})
    )
    return (
        SetupFinding(
            reading.kind,
            reading.column,
            reading.value,
            (reading.value, reading.value),
            reading.unit,
            MECHANICS if reading.column == "position_m" else "pressure",
            1.0 / max(left, 1e-3),
            0.0,
            (),
            advise_mending(suspect, reading.value),
            describe(suspect, reading.value, None),
            is_corrected=False,
        ),
    )


def _list_readings(records: Sequence[Record], plant: PlantSettings) -> Iterator[_Reading]:
    atmosphere_pa = plant.parameters.atmospheric_pressure_pa
    for column in records[0].channels:
        yield _Reading("sign", column, -1.0, "")
        for factor in FACTORS.get(column, ()):
            yield _Reading("scale", column, factor, "")
    if "pressure_pa" in records[0].channels:
        yield _Reading("gauge", "pressure_pa", -atmosphere_pa, "Pa")
        yield _Reading("sign", "pressure_pa", -1.0, "", about=atmosphere_pa)


def _measure_unlikeness(records: Sequence[Record], plant: PlantSettings) -> float:
    """Return what the plant file's model leaves of the worse signal, as a share of it."""
    evidence = prepare_evidence(records, records, plant)
    shares = []
    for drives in evidence.train.values():
        left = rms(stack_residuals(drives, plant)) * drives[0].deviation
        span = float(np.std(np.concatenate([d.measured for d in drives])))
        shares.append(left / span if span else 1.0)
    return max(shares, default=1.0)
