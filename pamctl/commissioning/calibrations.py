"""What is measured: the pressure sensor's line, the encoder's, and the valve's sign and null.

The two scales are lines through the origin: the sensor's at the atmosphere, the encoder's at the
start of each move. The null is found on the muscle itself. At a pressure between supply and
atmosphere, a valve that is open to one side makes the pressure rise or fall. Two searches find the
commands between which the pressure does neither; the null lies in the middle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from hal.calibration import output_v
from pamctl.commissioning.bench import Bench, SensorStatistics, summarise_samples
from pamctl.commissioning.guided import (
    CalibrationError,
    CalibrationOutcome,
    Operator,
    RigValue,
    read_while_held,
)
from pamctl.commissioning.rig_checks import judge_valve_sign, pulse_valve

PRESSURE_POINTS_KPA = (100.0, 200.0, 300.0)
_CODE_V = 10.0 / 65536
"""One code of a +-5 V input: the resolution."""
_CORRELATED = 4.0
"""How much noisier the mean of a held pressure is than that of a pressure at rest: the hold follows
the sensor's noise, which stays correlated over 14 samples."""
_WORST_PRESSURE_SHARE = 0.03
"""Residual over the highest reading, above which the points do not lie on a line."""
_PRESSURE_HINTS = {
    1.0 / 6.895: "were the readings in psi? They must be kPa",
    0.01: "were the readings in bar? They must be kPa",
    0.001: "were the readings in MPa? They must be kPa",
    1000.0: "were the readings in Pa? They must be kPa",
}


def calibrate_pressure(
    bench: Bench, operator: Operator, points_kpa: Sequence[float]
) -> CalibrationOutcome:
    """Vent and take the zero; hold each pressure (kPa gauge) and ask what the gauge reads.

    Raises `CalibrationError` or `LimitError`.
    """
    zero = _measure_zero(bench)
    volts, readings_pa, noises_v = [], [], []
    for point_kpa in points_kpa:
        held, reading_kpa = read_while_held(
            bench,
            operator,
            point_kpa,
            "what does the reference gauge read, in kPa (gauge)?",
        )
        if not (math.isfinite(reading_kpa) and reading_kpa > 0.0):
            raise CalibrationError(f"a gauge under pressure cannot read {reading_kpa:g} kPa")
        volts.append(held.sensor_v - zero.sensor_v)
        readings_pa.append(reading_kpa * 1e3)
        noises_v.append(math.hypot(_mean_noise_v(zero), _CORRELATED * _mean_noise_v(held)))
    bench.hold(bench.safe_valve_v, bench.period_s)
    zero_value = RigValue(
        ("calibration", "sensor_zero_v"),
        round(zero.sensor_v, 6),
        "V",
        2.0 * _mean_noise_v(zero),
        f"mean of {zero.samples} samples at the atmosphere, noise {zero.noise_v * 1e3:.2f} mV",
    )
    figures = {"zero": zero._asdict(), "sensor_v": volts, "reading_pa": readings_pa}
    if not points_kpa:
        return CalibrationOutcome((zero_value,), (), figures)
    gain = slope(volts, readings_pa)
    _require_near("sensor_pa_per_v", gain, bench.settings.sensor_pa_per_v, _PRESSURE_HINTS)
    residuals_pa = [pa - gain * v for v, pa in zip(volts, readings_pa, strict=True)]
    if max(map(abs, residuals_pa)) > _WORST_PRESSURE_SHARE * max(readings_pa):
        shown = ", ".join(f"{residual * 1e-3:+.1f}" for residual in residuals_pa)
        raise CalibrationError(
            f"the readings do not lie on a line through zero (residuals {shown} kPa); was one "
            "mistyped, or read as absolute pressure?"
        )
    return CalibrationOutcome(
        (
            zero_value,
            RigValue(
                ("calibration", "sensor_pa_per_v"),
                round(gain, 2),
                "Pa/V",
                _slope_uncertainty(gain, volts, residuals_pa, max(noises_v)),
                f"gauge at {', '.join(f'{p * 1e-3:g}' for p in readings_pa)} kPa, residuals "
                f"{', '.join(f'{r * 1e-3:+.2f}' for r in residuals_pa)} kPa",
            ),
        ),
        (),
        {**figures, "residual_pa": residuals_pa},
    )


def _measure_zero(bench: Bench) -> SensorStatistics:
    cal = bench.settings
    zero = bench.settle(bench.homing.vent_v, averaged_s=1.0)
    lowest, highest = cal.sensor_zero_lowest_v, cal.sensor_zero_highest_v
    if not lowest <= zero.sensor_v <= highest:
        raise CalibrationError(
            f"the vented sensor gives {zero.sensor_v:.3f} V, outside {lowest:g} to {highest:g} V; "
            "check that the muscle is vented, and the sensor's supply and wiring"
        )
    return zero


def _mean_noise_v(rest: SensorStatistics) -> float:
    return math.hypot(rest.mean_noise_v, _CODE_V / math.sqrt(12.0))


def slope(x: Sequence[float], y: Sequence[float]) -> float:
    """Return the steepness of the best line through the origin (least squares)."""
    return sum(a * b for a, b in zip(x, y, strict=True)) / sum(a * a for a in x)


def _slope_uncertainty(
    scale: float, x: Sequence[float], residuals: Sequence[float], noise: float
) -> float:
    """Return two standard deviations of a slope: each x has `noise`, and the points scatter."""
    spread = math.sqrt(sum(a * a for a in x))
    by_noise = 2.0 * scale * noise / spread
    if len(x) < 2:
        return by_noise
    variance = sum(r * r for r in residuals) / (len(x) - 1)
    return max(by_noise, 2.0 * math.sqrt(variance) / spread)


def _require_near(name: str, found: float, nominal: float, hints: Mapping[float, str]) -> None:
    """Refuse a scale that is more than a quarter off the file's; `hints` explain known ratios."""
    ratio = found / nominal
    if 0.8 <= ratio <= 1.25:
        return
    known = (hint for at, hint in hints.items() if 0.9 <= ratio / at <= 1.1)
    why = next(
        known, f"if the part is another one, put its data sheet's {name} into the file first"
    )
    raise CalibrationError(
        f"{name} would be {found:.6g}, {ratio:.3g} times the file's {nominal:.6g}: {why}"
    )


ENCODER_POINTS_KPA = (250.0,)
_LEAST_COUNTS = 100
_COUNT_NOISE = 1.0 / math.sqrt(6.0)
"""Of a displacement, in counts: each of its two ends is known to a count."""
_WORST_ENCODER_SHARE = 0.02
_AVERAGED_S = 0.2
_IDLE_S = 0.02
_ENCODER_HINTS = {
    4.0: "four times; is the encoder decoded once instead of four times a cycle?",
    2.0: "twice; is the encoder decoded two times instead of four times a cycle?",
    0.25: "a quarter; is the scale in the file that of a whole cycle?",
    1.0 / 25.4: "was the displacement in inches? It must be mm",
    0.1: "was the displacement in cm? It must be mm",
    1000.0: "was the displacement in um? It must be mm",
}


class _Move(NamedTuple):
    counts: float
    displacement_m: float


def calibrate_encoder_by_hand(
    bench: Bench, operator: Operator, displacements_mm: Sequence[float]
) -> CalibrationOutcome:
    """Ask for the carriage to be moved by gauge blocks; the vented muscle follows.

    With an empty list it asks for one displacement. Raises `CalibrationError` or `LimitError`.
    """

    def stay() -> None:
        bench.hold(bench.safe_valve_v, _IDLE_S)

    moves = []
    for known_mm in displacements_mm or (None,):
        operator.wait("put the carriage against its stop, with the muscle extended", stay)
        before = summarise_samples(bench.hold(bench.safe_valve_v, _AVERAGED_S)).counts
        block = "a gauge block" if known_mm is None else f"the gauge block of {known_mm:g} mm"
        operator.wait(f"move the carriage by {block} in the direction of contraction", stay)
        after = summarise_samples(bench.hold(bench.safe_valve_v, _AVERAGED_S)).counts
        moved_mm = known_mm
        if moved_mm is None:
            moved_mm = operator.number("how far did it move, in mm?", stay)
        moves.append(_Move(after - before, _require_length_m(moved_mm)))
    return _evaluate_moves(bench, moves, "gauge blocks of")


def calibrate_encoder_by_muscle(
    bench: Bench, operator: Operator, points_kpa: Sequence[float]
) -> CalibrationOutcome:
    """Fill the muscle to each pressure (kPa gauge), and ask for the contraction measured there.

    Raises `CalibrationError` or `LimitError`.
    """
    start = bench.settle(bench.homing.vent_v)
    moves = []
    for point_kpa in points_kpa:
        held, contraction_mm = read_while_held(
            bench,
            operator,
            point_kpa,
            "how far has the muscle contracted from the vented state, in mm?",
        )
        moves.append(_Move(held.counts - start.counts, _require_length_m(contraction_mm)))
    end = bench.settle(bench.homing.vent_v)
    outcome = _evaluate_moves(bench, moves, "contractions of")
    back = end.counts - start.counts
    return outcome._replace(figures={**outcome.figures, "return_counts": back})


def _require_length_m(displacement_mm: float) -> float:
    if not (math.isfinite(displacement_mm) and displacement_mm > 0.0):
        raise CalibrationError(
            f"a displacement of {displacement_mm:g} mm cannot give the scale; it must be "
            "positive, in the direction of contraction (the sign is found from the counts)"
        )
    return displacement_mm * 1e-3


def _evaluate_moves(bench: Bench, moves: Sequence[_Move], what: str) -> CalibrationOutcome:
    sign = _find_common_sign(moves)
    counts = [sign * move.counts for move in moves]
    lengths_m = [move.displacement_m for move in moves]
    scale = slope(counts, lengths_m)
    cal = bench.settings
    _require_near("encoder_m_per_count", scale, cal.encoder_m_per_count, _ENCODER_HINTS)
    residuals_m = [m - scale * n for n, m in zip(counts, lengths_m, strict=True)]
    if max(map(abs, residuals_m)) > _WORST_ENCODER_SHARE * max(lengths_m):
        shown = ", ".join(f"{residual * 1e6:+.0f}" for residual in residuals_m)
        raise CalibrationError(
            f"the displacements do not agree on one scale (residuals {shown} um); was one "
            "mistyped, or did the carriage slip?"
        )
    turned = sign != cal.encoder_sign
    meaning = "counts rise" if sign > 0 else "counts fall"
    how = (
        f"{what} {', '.join(f'{m * 1e3:g}' for m in lengths_m)} mm over "
        f"{', '.join(f'{n:.0f}' for n in counts)} counts, residuals "
        f"{', '.join(f'{r * 1e6:+.1f}' for r in residuals_m)} um"
    )
    return CalibrationOutcome(
        (
            RigValue(
                ("calibration", "encoder_m_per_count"),
                float(f"{scale:.7g}"),
                "m",
                _slope_uncertainty(scale, counts, residuals_m, _COUNT_NOISE),
                how,
            ),
            RigValue(
                ("calibration", "encoder_sign"),
                sign,
                "",
                0.0,
                f"{meaning} as the muscle contracts"
                + (": the opposite of what the file said" if turned else ""),
            ),
        ),
        (),
        {"counts": [move.counts for move in moves], "displacement_m": lengths_m}
        | {"residual_m": residuals_m},
    )


def _find_common_sign(moves: Sequence[_Move]) -> int:
    for move in moves:
        if abs(move.counts) < _LEAST_COUNTS:
            raise CalibrationError(
                f"the encoder counted {move.counts:.0f} for {move.displacement_m * 1e3:g} mm; "
                "check that it is plugged in (`pamctl doctor --actuate`), and that the carriage "
                "moved; a simulated rig has no carriage to push: use --by muscle there"
            )
    signs = {1 if move.counts > 0 else -1 for move in moves}
    if len(signs) > 1:
        raise CalibrationError(
            "the moves differ in direction; each must go in the direction of contraction"
        )
    return signs.pop()


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
        raise CalibrationError(f"{sign.message}; {sign.fix}")
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
        RigValue(
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
            RigValue(
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
