"""Whether a measurement can be what its columns are said to be: units, signs, the clock of a log.

An error stops an import. An implausible unit is an error of the kind `unit`, which the user may
overrule. No advice says which way round a rig works: that is asked.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from pamctl.base.texts import to_json
from pamctl.log.check import LogFindings
from pamctl.log.importing.column_map import (
    KEYS,
    ColumnMap,
    ImportMap,
    TimeMap,
    ValveMap,
    quote,
)
from pamctl.log.importing.column_roles import (
    OF_THE_AIR_PA,
    ChosenColumns,
    names_quantity,
)
from pamctl.log.importing.command_range import Doubt, doubt_command
from pamctl.log.importing.headers import NEED_A_GAIN
from pamctl.log.importing.measured_table import Floats, Ints, TableColumn
from pamctl.log.importing.shown_map import NEVER_ABSOLUTE_PA
from pamctl.log.record_problems import find_record_problems, measured_columns
from pamctl.log.row_problems import nominal_period_s

LONGEST_S = 2.0**62 * 1e-9
"""146 years: half the range of a log's clock in signed nanoseconds. Beyond it a double is off by
more than the microsecond by which two clocks of one log may differ.
"""
SHORTEST_PERIOD_S = 1e-9
"""Resolution of a log's clock."""
LONGEST_PERIOD_S = 0.5
"""Slower rows are more likely milliseconds that were taken for seconds."""
_WAYS_ON = {
    "backwards": "where a second recording begins, import each part: `lines: {{first: 1, last: "
    "{before}}}` and `lines: {{first: {row}}}` in the map",
    "duplicated": "export more digits of the time, or keep one of the rows, or say "
    "`time: {{rate_hz: RATE}}` in the map if they are even",
    "missing": "repair these rows, or say `time: {{rate_hz: RATE}}` in the map if they are even",
    "reversed": "sort the rows by their time",
    "jitter": "--resample puts the rows on an even grid",
    "gap": "they count as missed ticks",
}


def judge_record(
    t_s: Floats, quantities: Mapping[str, Floats], rows: Ints, findings: LogFindings, time_name: str
) -> None:
    """Report what is wrong with the record: see `record_problems`. `rows` are those of the file."""
    columns = measured_columns(quantities)
    for problem in find_record_problems(t_s, columns, f"the time ({time_name})"):
        text = problem.describe(rows)
        is_told = problem.column in quantities or problem.text.endswith("keep it once")
        if problem.kind in _WAYS_ON and not is_told:
            at = problem.stretches[0][0]
            names = {"row": rows[at], "before": rows[max(at - 1, 0)]}
            text += f"; {_WAYS_ON[problem.kind].format(**names)}"
        add = findings.error if problem.is_fatal else findings.warning
        add(problem.kind, text)


def judge_clock(t_s: Floats, findings: LogFindings, time_name: str) -> None:
    """Check that times in order fit into a log's clock, and are seconds."""
    beyond = np.abs(t_s / LONGEST_S - t_s[0] / LONGEST_S) > 1.0  # the difference may overflow
    period_s = nominal_period_s(t_s)
    if beyond.any():
        findings.error(
            "time",
            f"the time ({time_name}) goes on for more than {LONGEST_S:.3g} s; a log's clock in ns "
            "cannot hold more",
        )
    elif period_s < SHORTEST_PERIOD_S:
        detail = f"rows are {period_s:.6g} s apart; a log's clock counts ns"
        findings.error("time", f"the time ({time_name}) has another unit: {detail}")


def judge_units(
    chosen: ChosenColumns,
    quantities: Mapping[str, Floats],
    findings: LogFindings,
    *,
    has_map: bool,
    is_accepted: bool,
) -> ImportMap:
    """Report values that no rig has; return the map as it might be better.

    `quantities` are those of the map, and the time. Beside a map of the user's, the unit that a
    column's name states counts; without one, another name is a way on too.
    """
    import_map = chosen.map
    for quantity, column in quantities.items():
        values = column[np.isfinite(column)]
        part: ColumnMap = getattr(import_map, KEYS[quantity])
        named = chosen.columns.get(quantity) if has_map else None
        doubts = _doubt_quantity(part, named) or _doubt(part, values) if len(values) else ()
        for text, name, change in doubts:
            span = f"{values.min():.6g} to {values.max():.6g}"
            said = named and named.header.measures == quantity and named.header.unit
            if said and "unit" in change and said != part.unit:
                text, change = f"is this {said}, as the column's name says?", {"unit": said}
            if change and all(getattr(part, key) == value for key, value in change.items()):
                text = "no rig has that: is it another column, or does it need another gain?"
                name, change = "", {}
            if name:
                ((key, value),) = change.items()
                said = to_json(value).decode().strip('"')
                rename = f", or call it {name}" if not has_map else ""
                text += f" Then say `{key}: {said}` in the map{rename}"
            if is_accepted:
                findings.warning("unit", f"{quantity} is {span}: {text}")
            else:
                right = "if it is right, `pamctl log import FILE OUT.mcap --accept-units` takes it"
                findings.error("unit", f"{quantity} is {span}: {text}; {right}")
            better = part.model_copy(update=change)
            import_map = import_map.model_copy(update={KEYS[quantity]: better})
    judge_sign(quantities, findings)
    judge_zero(import_map, quantities, findings)
    return import_map


RESTS = 0.01
"""Share of the record that a level must last to be the one of a vented muscle."""


def judge_zero(
    import_map: ImportMap, quantities: Mapping[str, Floats], findings: LogFindings
) -> None:
    """Warn where a gauge pressure rests at the atmosphere's: it was absolute already.

    The opposite is an error: no absolute pressure falls to zero.
    """
    part, values = import_map.pressure, quantities.get("pressure_pa")
    if part is None or not part.gauge or values is None or not np.isfinite(values).any():
        return
    measured = values[np.isfinite(values)] - import_map.atmospheric_pressure_pa
    low, high = np.quantile(measured, (0.001, 0.999))
    rests = float(np.mean(measured < low + 0.03 * (high - low)))
    if OF_THE_AIR_PA[0] <= low <= OF_THE_AIR_PA[1] < high and rests >= RESTS:
        findings.warning(
            "gauge",
            f"pressure_pa rests at {low + import_map.atmospheric_pressure_pa:.4g} Pa, twice the "
            f"atmosphere's: the column itself falls to {low:.4g} Pa, as an absolute pressure does "
            "where all is vented; then say `gauge: false` in the map",
        )


def judge_sign(quantities: Mapping[str, Floats], findings: LogFindings) -> None:
    """Check that the muscle contracts with pressure, if both were measured."""
    if not {"pressure_pa", "position_m"} <= quantities.keys():
        return
    pressure, position = quantities["pressure_pa"], quantities["position_m"]
    good = np.isfinite(pressure) & np.isfinite(position)
    if np.count_nonzero(good) < 2 or min(np.ptp(pressure[good]), np.ptp(position[good])) == 0.0:
        return
    with np.errstate(over="ignore", invalid="ignore"):
        together = np.corrcoef(pressure[good], position[good])[0, 1]
    if together < -0.5:
        findings.warning(
            "sign",
            "position_m falls as pressure_pa rises; contraction must be positive: if the column "
            "counts the other way, say gain: -1 in the map; if it is the muscle's length, also "
            "offset: its length at rest, in the column's unit",
        )


def _doubt_quantity(part: ColumnMap, column: TableColumn | None) -> list[Doubt]:
    """Return the doubt that a column has the unit of another quantity, and no gain turns it."""
    header = column.header if column else None
    if not (column and header) or abs(getattr(part, "gain", 1.0)) != 1.0:
        return []
    if header.said_unit.lower() in NEED_A_GAIN:
        said, other = header.said_unit, header.quantity
        hint = f"is it {other}? If not, add" if other not in ("", part.quantity) else "add"
        text = f"{quote(column.name)} says {said}: {hint} `gain`, in {part.unit} per {said}"
        return [(text, "", {})]
    if not header.measures:
        return []
    is_any_sensor = header.measures == "valve_v" and not names_quantity(column, "valve_v")
    if header.measures == part.quantity or is_any_sensor:
        return []
    unit = header.unit or header.said_unit
    said = f"{quote(column.name)} says {unit}, a unit of {header.measures}"
    return [(f"{said}: are two columns exchanged? Only a gain makes {part.unit} of it", "", {})]


def _doubt(part: ColumnMap, values: Floats) -> Iterator[Doubt]:
    """Yield what is doubtful of values in SI, at most once."""
    low, high = float(values.min()), float(values.max())
    if isinstance(part, TimeMap):
        every_s = nominal_period_s(values)
        if every_s > LONGEST_PERIOD_S and part.rate_hz:
            yield f"is rate_hz in Hz, with a row every {every_s:.6g} s?", "", {}
        elif every_s > LONGEST_PERIOD_S:
            yield f"is the time in ms, with a row every {every_s:.6g} s?", "time_ms", {"unit": "ms"}
    elif isinstance(part, ValveMap):
        yield from doubt_command(part, values)
    elif part.quantity == "position_m" and max(-low, high) > 0.5:
        unit = "mm" if max(-low, high) < 1e3 else "um"
        yield f"is this {unit}?", f"position_{unit}", {"unit": unit}
    elif part.quantity == "pressure_pa" and high > 2e6:
        yield "above 20 bar; is the unit right, and is it air? pamctl models no oil", "", {}
    elif part.quantity == "pressure_pa" and high < 2e3:
        unit = "bar" if low > 0.0 and high < 20.0 else "kPa"
        names = f"pressure_{unit.lower()}, or pressure_gauge_{unit.lower()}"
        yield f"is this {unit}?", names, {"unit": unit}
    elif part.quantity == "pressure_pa" and low < NEVER_ABSOLUTE_PA:
        below = "below the atmosphere's; is this gauge pressure?"
        yield below, "pressure_gauge_...", {"gauge": True}
