"""What may be wrong about the set-up, in words: a number of the plant file, or a column."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import log, pi, sqrt
from typing import NamedTuple

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.evidence.ladder import Finding
from pamctl.diagnose.evidence.measuring_chain import SCALE
from pamctl.diagnose.plant_numbers import UNITS

SETUP_UNITS: Mapping[str, str] = {
    "late": "s", "smooth": "s", "clock": "s/s", "atmosphere": "Pa", "added": "Pa",
}  # fmt: skip
"""Units of the numbers between a plant and a file, by their first word."""
_LABELS = {
    "plant_constant": "", "skew": "skew of ", "clock_rate": "clock of ", "filtered": "filter of ",
    "sign": "sign of ", "added": "atmosphere in ", "end_stop": "end stop of ",
    "crosstalk": "crosstalk of ",
}  # fmt: skip
_FAULTS = {
    "skew": "a late or early", "clock": "another clock of", "filter": "a smoothed",
    "sign": "a wrong sign of", "crosstalk": "crosstalk in", "scale": "a wrong scale of",
}  # fmt: skip
"""Nouns for the labels."""
CALLED = {
    "valve_v": "the command",
    "pressure_pa": "the pressure",
    "position_m": "the position",
    "force_n": "the force",
}
_MEND_NUMBER = {
    "mass_kg": "weigh what moves",
    "rest_length_m": "measure the vented, unloaded muscle between its end caps",
    "temperature_k": "measure the temperature of the supplied air",
    "tank_pressure_pa": "read the regulator's gauge, and add the atmosphere's pressure",
    "atmospheric_pressure_pa": "read a barometer (not one reduced to sea level)",
}


def label_fault(kind: str, number: str) -> str:
    """Name what may be wrong about a number, in a few words: `skew of position_m`."""
    return f"{_LABELS.get(kind, f'{kind} of ')}{number}"


def name_fault(label: str) -> str:
    """Return a fault of a column as a noun: `skew of position_m` is a late or early position_m."""
    fault, _, column = label.partition(" of ")
    return f"{_FAULTS[fault]} {column}" if fault in _FAULTS else label


class SetupFault(NamedTuple):
    """One number of the set-up that is not what the plant file or the record says."""

    kind: str
    number: str
    value: float
    ci90: tuple[float, float]
    unit: str
    said: float | None
    """What the plant file says; None for a column."""
    cannot_be_told_from: list[str]
    how_to_mend: str
    text: str

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
        if kind == "end_stop":
            off_m = diagnosis.evidence.weigher.base.get(n.name, 0.0)
            n = replace(n, value=n.value - off_m, low=n.low - off_m, high=n.high - off_m)
            unit = "m"
        text, mend = say_fault(kind, number, n.value, unit, said)
        if kind == SCALE:  # one of several columns, and no data tell which
            *drivers, number = number.split(" or ")
            others = [*(label_fault(SCALE, driver) for driver in drivers), *others]
        return cls(kind, number, n.value, (n.low, n.high), unit, said, others, mend, text)


def say_fault(
    kind: str, number: str, value: float, unit: str, said: float | None
) -> tuple[str, str]:
    """Say what is wrong about a number of the set-up, and what to do about it."""
    column = CALLED.get(number, number)
    one_clock = "log all columns with one clock"
    match kind:
        case "plant_constant":
            return (
                f"{number} is {value:.5g} {unit}, the plant file says {said:.5g}",
                f"plant.yaml has the corrected {number}; {_MEND_NUMBER.get(number, 'measure it')}",
            )
        case "skew":
            word, way = ("late", "earlier") if value > 0.0 else ("early", "later")
            ms = f"{1e3 * abs(value):.2f} ms"
            return (
                f"{column} is logged {ms} too {word} against the others",
                f"{one_clock}; this record is mended by moving {number} {ms} {way}",
            )
        case "clock_rate":
            word, runs = ("long", "fast") if value > 0.0 else ("short", "slow")
            text = f"{column} runs away from the others by {1e6 * value:+.0f} us in each second"
            if number == "t_s":
                percent = f"{100.0 * abs(value):.2g} %"
                text = f"all times are {percent} too {word}: the record's clock runs {runs}"
            return text, f"{one_clock}; two clocks never run alike"
        case "filtered":
            hz = sqrt(log(2.0)) / (2.0 * pi * max(value, 1e-9))  # half the power passes
            return (
                f"{column} is smoothed over {1e3 * value:.3g} ms, forwards and backwards",
                f"give the data as they were measured: this filter ends near {hz:.3g} Hz",
            )
        case "added":
            return (
                f"{column} is {1e-3 * value:.4g} kPa too high: the atmosphere was added twice",
                f"{number} is absolute already: take the atmosphere out of the import map",
            )
        case "crosstalk":
            each = f"{1e-3 * value:.3g} kPa" if number == "pressure_pa" else f"{1e3 * value:.3g} mm"
            return (
                f"{column} also shows the command: {each} for each volt",
                "part the cables of valve and sensor, and ground their shields at one end",
            )
        case "scale":
            *drivers, position = (CALLED[name] for name in number.split(" or "))
            size = f"{100.0 * abs(value - 1.0):.3g} % too {'large' if value > 1.0 else 'small'}"
            return (
                f"{position} is {size} for {' and '.join(drivers)}: the scale of one is wrong",
                "measure both, the position beside a gauge, the force by a known weight; "
                "plant.yaml takes the position's, with sizes of the other laws that go with it",
            )
        case "end_stop":
            way = "farther" if value > 0.0 else "nearer"
            return (
                f"the piston stops {1e3 * abs(value):.3g} mm {way} than the plant file says: "
                "another stroke, or another zero of the position",
                "set the position to zero with the piston at its end, and measure the stroke",
            )
        case "decimated_command":
            return (
                f"{column} changes only every {1e3 * value:.3g} ms in the file, and the pressure "
                "answers commands in between",
                f"log {number} at every tick",
            )
    return (  # a sign
        f"{column} has the wrong sign",
        f"change the sign of {number} in the import map or in the calibration",
    )
