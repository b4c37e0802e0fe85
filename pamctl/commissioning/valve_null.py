"""The valve: its sign, the supply's pressure, and the command at which it is closed.

The null is found on the muscle itself. At a pressure between supply and atmosphere, a valve that
is open to one side makes the pressure rise or fall. Two searches find the commands between which
the pressure does neither; the null lies in the middle.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from hal.calibration import output_v
from pamctl.commissioning.bench import Bench, SensorStatistics, summarise_samples
from pamctl.commissioning.guided import CalibrationError, CalibrationOutcome, CalibrationValue
from pamctl.commissioning.rig_checks import judge_valve_sign, pulse_valve

RESOLUTION_V = 0.5e-3
"""About an output code and a half."""
_STANDING_S = 0.02
"""Wait after a change of the command, for the spool and the sensor."""
_COMING_TO_REST_S = 0.3
"""Wait before it: a muscle that still moves changes its volume, and so the pressure of the enclosed
air. Its time constant is c / k, 59 ms on the paper's rig."""
_ENDS_S = 0.05
_DWELL_S = 0.15
_NEARBY_V = 0.1
_CODE_V = 10.0 / 65536
_LEAST_SUPPLY_KPA = 50.0


class _NullEdge(NamedTuple):
    """Where the pressure begins to rise, or to fall."""

    command_v: float
    blur_v: float
    """How far beyond the valve's own edge a change becomes visible: the smallest visible change
    over its growth with the command."""


def calibrate_valve(bench: Bench, span_v: float = 1.0) -> CalibrationOutcome:
    """Move the muscle to find sign, supply and null.

    The null is searched within `span_v` (V) of the file's. Raises `CalibrationError`, `LimitError`.
    """
    sign = judge_valve_sign(bench, pulse_valve(bench))
    if sign.level != "ok":
        raise CalibrationError(f"{sign.found}; {sign.fix}")
    # Against the sensor's zero of today: the file's zero may be off by more than the supply.
    zero = bench.settle(bench.homing.vent_v)
    supply = bench.settle(bench.homing.fill_v)
    supply_pa = (
        bench.settings.atmospheric_pressure_pa
        + (supply.sensor_v - zero.sensor_v) * bench.settings.sensor_pa_per_v
    )
    if bench.gauge_kpa(supply_pa) < _LEAST_SUPPLY_KPA:
        raise CalibrationError(
            f"the supply gives only {bench.gauge_kpa(supply_pa):.0f} kPa gauge; open it, or "
            "calibrate the pressure sensor first"
        )
    middle_pa = 0.5 * (supply_pa + bench.settings.atmospheric_pressure_pa)
    upper = _find_edge(bench, middle_pa, span_v, 1, supply)
    lower = _find_edge(bench, middle_pa, span_v, -1, supply)
    bench.hold(bench.safe_valve_v, bench.period_s)
    return _evaluate_edges(bench, upper, lower, supply_pa)


def _find_edge(
    bench: Bench, at_pa: float, span_v: float, side: int, supply: SensorStatistics
) -> _NullEdge:
    """Halve the span until the edge on one side is known; `side`: 1 is rising, -1 falling."""
    least_v = max(4.0 * math.sqrt(2.0 / (_ENDS_S / bench.period_s)) * supply.noise_v, 2.0 * _CODE_V)

    def moves(command_v: float) -> bool:
        return side * _measure_change_v(bench, at_pa, command_v) > least_v

    still_v, moving_v = -side * span_v, side * span_v
    _require_bracket(moves, still_v, moving_v, span_v, side)
    while abs(moving_v - still_v) > RESOLUTION_V:
        middle_v = 0.5 * (still_v + moving_v)
        if moves(middle_v):
            moving_v = middle_v
        else:
            still_v = middle_v
    edge_v = 0.5 * (still_v + moving_v)
    growth = side * _measure_change_v(bench, at_pa, edge_v + side * _NEARBY_V) / _NEARBY_V
    return _NullEdge(edge_v, least_v / max(growth, least_v / _NEARBY_V))


def _measure_change_v(bench: Bench, at_pa: float, command_v: float) -> float:
    """Return the change of the sensor's voltage over a dwell that begins at a pressure."""
    bench.bring_to_pressure(at_pa)
    still = round(_COMING_TO_REST_S / bench.period_s)
    bench.hold_pressure(at_pa, lambda samples: len(samples) >= still)
    bench.hold(command_v, _STANDING_S)
    begin = summarise_samples(bench.hold(command_v, _ENDS_S))
    bench.hold(command_v, _DWELL_S - _ENDS_S)
    return summarise_samples(bench.hold(command_v, _ENDS_S)).sensor_v - begin.sensor_v


def _require_bracket(
    moves: Callable[[float], bool], still_v: float, moving_v: float, span_v: float, side: int
) -> None:
    what = "rise" if side > 0 else "fall"
    if moves(still_v) or not moves(moving_v):
        raise CalibrationError(
            f"the pressure does not begin to {what} between -{span_v:g} and {span_v:g} V around "
            "the file's null; is the supply open, does the muscle leak, is driver_offset_v far "
            "off? Widen with --span"
        )


def _evaluate_edges(
    bench: Bench, upper: _NullEdge, lower: _NullEdge, supply_pa: float
) -> CalibrationOutcome:
    null_v = 0.5 * (upper.command_v + lower.command_v)
    blur_v = upper.blur_v + lower.blur_v
    width_v = max(0.0, upper.command_v - lower.command_v - blur_v)
    uncertainty_v = RESOLUTION_V + 0.5 * blur_v
    cal = bench.settings
    offset_v = round(output_v(bench.calibration, null_v), 5)
    seen = f"dead band {width_v * 1e3:.0f} mV" if width_v > uncertainty_v else "no dead band seen"
    values = [
        CalibrationValue(
            ("calibration", "driver_offset_v"),
            offset_v,
            "V",
            uncertainty_v * cal.driver_gain,
            f"rises above {upper.command_v * 1e3:+.1f} mV of the old null, falls below "
            f"{lower.command_v * 1e3:+.1f} mV; {seen}",
        )
    ]
    reach_v = min(offset_v - cal.driver_low_v, cal.driver_high_v - offset_v) / cal.driver_gain
    if reach_v < bench.limits.command_v:
        values.append(
            CalibrationValue(
                ("limits", "command_v"),
                math.floor(reach_v * 1e3) * 1e-3,
                "V",
                0.0,
                "the range of the driver on either side of this null",
            )
        )
    supply_kpa = supply_pa * 1e-3
    return CalibrationOutcome(
        tuple(values),
        (
            f"the supply gives {supply_kpa:.1f} kPa absolute ({bench.gauge_kpa(supply_pa):.1f} "
            f"gauge): tank_pressure_pa: {supply_pa:.0f} in the plant file",
        ),
        {
            "rises_above_v": upper.command_v,
            "falls_below_v": lower.command_v,
            "dead_band_v": width_v,
            "supply_pressure_pa": supply_pa,
        },
    )
