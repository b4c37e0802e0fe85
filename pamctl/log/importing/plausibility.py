"""Check a measurement before its import: times, gaps, and implausible units.

Errors stop an import. An implausible unit is an error of the kind `unit`, which the user may
overrule. Warnings go into the log.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pamctl.log.check import LogFindings
from pamctl.log.importing.imported_log import nominal_period_s
from pamctl.log.importing.quantities import TIME

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]

GAP_PERIODS = 1.5
JITTER = 0.05
"""Deviation from the even grid that is reported, as a share of the period."""
LONGEST_S = 2.0**62 * 1e-9
"""146 years: half the range of a log's clock in signed nanoseconds. Beyond it a double is off by
more than the microsecond by which two clocks of one log may differ.
"""
SHORTEST_PERIOD_S = 1e-9
"""Resolution of a log's clock."""
LONGEST_PERIOD_S = 0.5
"""Slower rows are more likely milliseconds that were taken for seconds."""
_SHOWN_ROWS = 5


def judge_time(t_s: Floats, rows: Rows, findings: LogFindings, column: str = TIME) -> None:
    """Check times of shape (n,). Without errors, they rise strictly and fit into a log's clock.

    `column` is the name of the time column in the source.
    """
    if len(t_s) < 2:
        there = "is 1 row" if len(t_s) else "are 0 rows"
        findings.error("rows", f"there {there}; a measurement needs at least two")
        return
    if not np.isfinite(t_s).all():
        where = _name_rows(rows, ~np.isfinite(t_s))
        findings.error("time", f"the time ({column}) is missing or not finite in {where}")
        return
    beyond = np.abs(t_s / LONGEST_S - t_s[0] / LONGEST_S) > 1.0  # the difference may overflow
    if beyond.any():
        detail = f"is more than {LONGEST_S:.3g} s from the first at {_name_rows(rows, beyond)}"
        findings.error(
            "time", f"the time ({column}) {detail}; a log's clock in ns cannot hold more"
        )
        return
    step = np.diff(t_s)
    if (step < 0).any():
        findings.error("time", f"the time goes backwards at {_name_rows(rows[1:], step < 0)}")
    if (step == 0).any():
        detail = f"the previous row's time is repeated at {_name_rows(rows[1:], step == 0)}"
        findings.error("time", f"{detail}; drop those rows, or export more digits of the time")
    if findings.kinds["time"]:
        return
    period_s = nominal_period_s(t_s)
    if period_s < SHORTEST_PERIOD_S:
        detail = f"rows are {period_s:.6g} s apart; a log's clock counts ns"
        findings.error("time", f"the time ({column}) has another unit: {detail}")
        return
    gap = step > GAP_PERIODS * period_s
    if gap.any():
        detail = f"of up to {step.max():.6g} s before {_name_rows(rows[1:], gap)}"
        findings.warning(
            "gap", f"{np.count_nonzero(gap)} gaps {detail}; they count as missed ticks"
        )
    off = np.abs(step[~gap] - period_s).max() / period_s
    if off > JITTER:
        detail = f"the time steps differ from {period_s:.6g} s by up to {off:.0%}"
        findings.warning("jitter", f"{detail}; --resample puts the rows on an even grid")
    if period_s > LONGEST_PERIOD_S:
        findings.error("unit", f"a row every {period_s:.6g} s: is the time in ms?")


def judge_values(quantities: Mapping[str, Floats], rows: Rows, findings: LogFindings) -> None:
    """Check quantities in SI, each of shape (n,)."""
    for name, values in quantities.items():
        good = np.isfinite(values)
        if not good.any():
            findings.error("not-finite", f"{name} has no values")
            continue
        if not good.all():
            where = _name_rows(rows, ~good)
            findings.warning("not-finite", f"{name} is missing or not finite in {where}")
        if np.ptp(values[good]) == 0.0:
            findings.warning("constant", f"{name} is {values[good][0]:.6g} throughout")
        if name in _DOUBTS and (doubt := _DOUBTS[name](values[good])):
            findings.error("unit", f"{name} is {_show_range(values[good])}: {doubt}")


def judge_sign(quantities: Mapping[str, Floats], findings: LogFindings) -> None:
    """Check that the muscle contracts with pressure, if both were measured."""
    if not {"pressure_pa", "position_m"} <= quantities.keys():
        return
    pressure, position = quantities["pressure_pa"], quantities["position_m"]
    good = np.isfinite(pressure) & np.isfinite(position)
    if np.count_nonzero(good) < 2 or min(np.ptp(pressure[good]), np.ptp(position[good])) == 0.0:
        return
    if np.corrcoef(pressure[good], position[good])[0, 1] < -0.5:
        detail = "position_m falls as pressure_pa rises; contraction must be positive"
        findings.warning("sign", f"{detail}: map it with gain: -1")


def _doubt_valve(values: Floats) -> str:
    low, high = values.min(), values.max()
    if low >= -0.05 and (high > 5.05 or 4.0 < np.median(values) < 6.0):
        return "are these the driver's 0..10 V? The command is -5..5 V; map it with offset: -5.0"
    return "the command is within -5..5 V" if max(-low, high) > 5.05 else ""


def _doubt_pressure(values: Floats) -> str:
    low, high = values.min(), values.max()
    if low >= 80e3:
        return "above 20 bar; is the unit right?" if high > 2e6 else ""
    if low > 0.0 and high < 20.0:
        return "is this bar? Then call it pressure_bar, or pressure_gauge_bar"
    if high < 2e3:
        return "is this kPa? Then call it pressure_kpa, or pressure_gauge_kpa"
    return "below the atmosphere's; is this gauge pressure? Then call it pressure_gauge_..."


def _doubt_position(values: Floats) -> str:
    return "is this mm? Then call it position_mm" if np.abs(values).max() > 0.5 else ""


_DOUBTS = {
    "valve_v": _doubt_valve,
    "pressure_pa": _doubt_pressure,
    "position_m": _doubt_position,
}


def _show_range(values: Floats) -> str:
    return f"{values.min():.6g} to {values.max():.6g}"


def _name_rows(rows: Rows, where: NDArray[np.bool_]) -> str:
    """Name the rows with True in `where`: the first few, and the number of the others."""
    found = rows[where]
    listed = ", ".join(str(row) for row in found[:_SHOWN_ROWS].tolist())
    more = f" and {len(found) - _SHOWN_ROWS} more" if len(found) > _SHOWN_ROWS else ""
    return f"row{'s' if len(found) > 1 else ''} {listed}{more}"
