"""Scale and sign of the encoder, from known displacements."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from pamctl.commissioning.calibrate.holding import read_while_held
from pamctl.commissioning.calibrate.outcome import (
    CalibrationError,
    CalibrationOutcome,
    CalibrationValue,
    Operator,
    list_residuals,
    require_near,
    slope,
    slope_uncertainty,
)
from pamctl.commissioning.hands_on import Bench, summarise_samples

DEFAULT_POINTS_KPA = (250.0,)
_LEAST_COUNTS = 100
_COUNT_NOISE = 1.0 / math.sqrt(6.0)
"""Of a displacement, in counts: each of its two ends is known to a count."""
_WORST_SHARE = 0.02
_AVERAGED_S = 0.2
_IDLE_S = 0.02
_HINTS = {
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
    require_near("encoder_m_per_count", scale, cal.encoder_m_per_count, _HINTS)
    residuals_m = list_residuals(counts, lengths_m, scale)
    if max(map(abs, residuals_m)) > _WORST_SHARE * max(lengths_m):
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
            CalibrationValue(
                ("calibration", "encoder_m_per_count"),
                float(f"{scale:.7g}"),
                "m",
                slope_uncertainty(scale, counts, residuals_m, _COUNT_NOISE),
                how,
            ),
            CalibrationValue(
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
