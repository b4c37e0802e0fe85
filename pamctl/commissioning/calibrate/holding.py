"""Hold a pressure while a person reads an instrument."""

from __future__ import annotations

from collections import deque

from hal.rig import RawSample
from pamctl.commissioning.calibrate.outcome import Operator
from pamctl.commissioning.hands_on import Bench, SensorStatistics, summarise_samples

_AVERAGED = 500
_IDLE = 20


def read_while_held(
    bench: Bench, operator: Operator, point_kpa: float, question: str
) -> tuple[SensorStatistics, float]:
    """Hold a pressure (kPa gauge) until the question is answered.

    Returns what the sensors read just before the answer, and the answer. Raises `LimitError` where
    the pressure cannot be reached.
    """
    target_pa = bench.absolute_pa(point_kpa)
    bench.bring_to_pressure(target_pa)
    latest: deque[RawSample] = deque(maxlen=_AVERAGED)

    def hold_on() -> None:
        latest.extend(bench.hold_pressure(target_pa, lambda samples: len(samples) >= _IDLE))

    answer = operator.number(f"about {point_kpa:g} kPa: {question}", hold_on)
    while len(latest) < _AVERAGED:
        hold_on()
    return summarise_samples(latest), answer
