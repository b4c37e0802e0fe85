"""The words of a finding: what is wrong, and how to mend it."""

from __future__ import annotations

from math import pi

from pamctl.diagnose.fitting.numbers import AREA
from pamctl.diagnose.setup.suspects import ATMOSPHERE, CONSTANTS, READ_BACK, Suspect

_COLUMNS = {
    "valve_v": "the command",
    "pressure_pa": "the pressure",
    "position_m": "the position",
    "force_n": "the force",
    AREA: f"{AREA} of the plant file",
}
_MEND_CONSTANT = {
    "rest_length_m": "measure the vented, unloaded muscle between its end caps",
    "braid_length_m": "measure a thread of the braid, stretched straight",
    "braid_turns": "count the turns of a thread around the muscle",
    "tank_pressure_pa": "read the regulator's gauge, and add the atmosphere's pressure",
    "temperature_k": "measure the temperature of the supplied air",
    "heat_capacity_ratio": "it is 1.40 for dry air: check which gas is used",
    "mass_kg": "weigh what moves",
    ATMOSPHERE: "read a barometer (not one reduced to sea level)",
}


def describe(suspect: Suspect, value: float, said: float | None) -> str:
    """Say what was found."""
    number, unit = suspect.number, suspect.unit
    if suspect.kind in ("drift", "change_at_instant"):
        return _describe_change(suspect, value)
    if suspect.kind == "plant_constant":
        return f"{number} is {value:.5g} {unit}".rstrip() + f", the plant file says {said:.5g}"
    column = _COLUMNS.get(number, number)
    if suspect.kind == "null_offset":
        return f"the valve is closed at a command of {1e3 * value:+.1f} mV, not at 0"
    if suspect.kind == "skew":
        word = "late" if value > 0.0 else "early"
        late = f"{column} is logged {1e3 * abs(value):.2f} ms too {word} against the others"
        lost = suspect.variant == READ_BACK
        return f"{late}: some commands stand in two rows, and others in none" if lost else late
    if suspect.kind == "clock_rate" and number == "t_s":
        word = "long" if value > 0.0 else "short"
        return f"all times are {100.0 * abs(value):.2g} % too {word}"
    if suspect.kind == "clock_rate":
        return f"{column} runs away from the others by {1e6 * value:+.0f} us in each second"
    if suspect.kind == "filtered":
        hz = 1.0 / (2.0 * pi * value)
        return f"{column} was filtered forwards and backwards, near {hz:.3g} Hz"
    if suspect.kind == "sign":
        return f"{column} has the wrong sign"
    if suspect.kind == "bow":
        low, high = suspect.between
        share = 100.0 * value / (high - low)
        return (
            f"{column} is not linear: half way from {low:.4g} to {high:.4g} Pa it is shown "
            f"{value:+.4g} Pa off, {share:+.2f} % of that span"
        )
    if suspect.kind == "gauge" and value > 0.0:
        return f"{column} is {value:.5g} Pa above absolute pressure: the atmosphere counts twice"
    if suspect.kind == "gauge":
        return f"{column} is gauge pressure: {-value:.5g} Pa are missing to absolute pressure"
    if suspect.kind == "decimated_command":
        return f"the command was logged once in {value:.0f} samples, and the rig got it more often"
    return f"{column} is shown {value:.4g} times as large as it is"


def _describe_change(suspect: Suspect, value: float) -> str:
    number = suspect.number
    share = number in CONSTANTS
    size = f"{100.0 * value:+.1f} %" if share else f"{value:+.3g} {suspect.unit}"
    if suspect.kind == "change_at_instant":
        if suspect.variant:
            when = f"after {100.0 * suspect.after_s:.0f} % of every record"
        else:
            when = f"at {suspect.after_s:.1f} s of {suspect.record or 'every record'}"
        return f"{number} changed by {size} {when}"
    if suspect.over_s:
        span = "from start to end" if suspect.variant else f"within {suspect.over_s:.1f} s"
        return f"{number} drifts by {size} {span} of a record"
    return f"{number} differs between the records: {size} from the lowest to the highest"


def advise_mending(suspect: Suspect, value: float, *, corrected: bool = True) -> str:
    """Say how to mend it; `corrected` if the extended plant file has it mended already."""
    number = suspect.number
    if suspect.kind == "plant_constant":
        how = _MEND_CONSTANT.get(number, "measure it")
        return f"plant.yaml has the corrected {number}; {how}" if corrected else how
    if suspect.kind in ("drift", "change_at_instant"):
        return (
            "look at what changes with time there: temperature, wear, a joint, a hose, the supply; "
            "let the rig warm up, and record again in one go"
        )
    if suspect.kind == "null_offset":
        return (
            "run `pamctl calibrate valve --out RIG.yaml`, or add the offset to the driver's null; "
            f"a record is mended by subtracting {value:.4g} V from valve_v"
        )
    if suspect.variant == READ_BACK:
        return "log each command where it is given, in the row of its tick"
    if suspect.kind == "skew":
        return (
            f"log all columns with one clock; this record is mended by moving {number} "
            f"{1e3 * abs(value):.2f} ms {'earlier' if value > 0.0 else 'later'}"
        )
    if suspect.kind == "clock_rate" and number == "t_s":
        return "compare the length of a long record with a watch: is the sample rate as stated?"
    if suspect.kind == "clock_rate":
        return "log all columns with one clock; two clocks never run alike"
    if suspect.kind == "filtered":
        return "give the data as they were measured; here the simulation is filtered alike"
    if suspect.kind == "decimated_command":
        return "log the command at every sample"
    if suspect.kind == "bow":
        return "calibrate the sensor at three pressures or more, and import with that curve"
    if suspect.kind == "gauge" and value > 0.0:
        return "add the atmosphere's pressure once: in the calibration, or in the import map"
    if suspect.kind == "gauge":
        return "add the atmosphere's pressure in the calibration, or in the import map"
    if suspect.kind == "sign" and number == AREA:
        return "plant.yaml has the other sign: pressure pushes towards smaller x if it is negative"
    if suspect.kind == "sign":
        return f"change the sign of {number} in the import map or in the calibration"
    return f"divide {number} by {value:.4g}: in the calibration, or in the import map"
