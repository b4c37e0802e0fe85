"""Faults of the set-up in words: what is wrong, and how to mend it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import log, pi, sqrt
from typing import Any

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.evidence.ladder import Finding
from pamctl.diagnose.plant_numbers import UNITS

SETUP_UNITS: Mapping[str, str] = {"late": "s", "smooth": "s", "clock": "s/s", "atmosphere": "Pa"}
"""Units of the numbers between a plant and a file, by their first word."""
_LABELS = {
    "plant_constant": "", "skew": "skew of ", "clock_rate": "clock of ", "filtered": "filter of ",
    "sign": "sign of ",
}  # fmt: skip
_COLUMNS = {
    "valve_v": "the command",
    "pressure_pa": "the pressure",
    "position_m": "the position",
    "force_n": "the force",
}
_MEND_NUMBER = {
    "rest_length_m": "measure the vented, unloaded muscle between its end caps",
    "temperature_k": "measure the temperature of the supplied air",
    "tank_pressure_pa": "read the regulator's gauge, and add the atmosphere's pressure",
    "atmospheric_pressure_pa": "read a barometer (not one reduced to sea level)",
}


def label_fault(kind: str, number: str) -> str:
    """Name what may be wrong about a number, in a few words: `skew of position_m`."""
    return f"{_LABELS.get(kind, f'{kind} of ')}{number}"


@dataclass(frozen=True)
class SetupFault:
    """One number of the set-up that is not what the plant file or the record says."""

    kind: str
    number: str
    value: float
    ci90: tuple[float, float]
    unit: str
    said: float | None
    """What the plant file says; None for a column."""
    cannot_be_told_from: tuple[str, ...]

    @classmethod
    def read(cls, diagnosis: Diagnosis, finding: Finding, others: list[str]) -> SetupFault:
        """Return the fault that a finding is; `others` are what the data do not tell it from."""
        assert finding.hypothesis.setup is not None
        assert diagnosis.evidence is not None
        kind, number = finding.hypothesis.setup
        n = finding.numbers[0]
        short = n.name.lstrip("~").split(".")[0]
        said = diagnosis.evidence.weigher.base.get(number) if kind == "plant_constant" else None
        unit = UNITS.get(number, "") if kind == "plant_constant" else SETUP_UNITS.get(short, "")
        return cls(kind, number, n.value, (n.low, n.high), unit, said, tuple(others))

    @property
    def text(self) -> str:
        """What is wrong."""
        number, value, unit = self.number, self.value, self.unit
        column = _COLUMNS.get(number, number)
        if self.kind == "plant_constant":
            return f"{number} is {value:.5g} {unit}".rstrip() + f", the plant file says {self.said}"
        if self.kind == "skew":
            word = "late" if value > 0.0 else "early"
            return f"{column} is logged {1e3 * abs(value):.2f} ms too {word} against the others"
        if self.kind == "clock_rate":
            return f"{column} runs away from the others by {1e6 * value:+.0f} us in each second"
        if self.kind == "filtered":
            return f"{column} is smoothed over {1e3 * value:.3g} ms, forwards and backwards"
        if self.kind == "sign":
            return f"{column} has the wrong sign"
        return f"{label_fault(self.kind, number)} is {value:.5g} {unit}".rstrip()

    @property
    def how_to_mend(self) -> str:
        """What to do about it."""
        number, value = self.number, self.value
        if self.kind == "plant_constant":
            how = _MEND_NUMBER.get(number, "measure it")
            return f"plant.yaml has the corrected {number}; {how}"
        if self.kind == "skew":
            way = "earlier" if value > 0.0 else "later"
            return (
                f"log all columns with one clock; this record is mended by moving {number} "
                f"{1e3 * abs(value):.2f} ms {way}"
            )
        if self.kind == "clock_rate":
            return "log all columns with one clock; two clocks never run alike"
        if self.kind == "filtered":
            hz = sqrt(log(2.0)) / (2.0 * pi * max(value, 1e-9))  # half the power passes
            return f"give the data as they were measured: this filter ends near {hz:.3g} Hz"
        return f"change the sign of {number} in the import map or in the calibration"

    def as_dict(self) -> dict[str, Any]:
        """Return what the document holds."""
        return {
            "kind": self.kind,
            "number": self.number,
            "value": self.value,
            "ci90": [*self.ci90],
            "unit": self.unit,
            "said": self.said,
            "cannot_be_told_from": [*self.cannot_be_told_from],
            "how_to_mend": self.how_to_mend,
            "text": self.text,
        }
