"""What a reference may ask of the muscle. It is checked before a run, and not in the tick."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, NamedTuple

from pydantic import Field

from hal.configured import Configured
from pamctl.control.course import Segment, reference_at
from pamctl.signals import Reference

_STEP_S = 0.97e-3
"""Not a whole millisecond: samples of a periodic wave then fall on every part of its period."""
_MOST_SAMPLES = 50_000
_FEWEST_SAMPLES = 64


class EnvelopeSettings(Configured):
    """The fastest motion that an experiment made of forms may ask for.

    Position, pressure and valve command have their limits under `limits`.
    """

    speed_mm_per_s: Annotated[float, Field(gt=0, le=1e5)] = 500.0
    acceleration_mm_per_s2: Annotated[float, Field(gt=0, le=1e8)] = 50_000.0


class TimedReference(NamedTuple):
    """A reference, and when it comes first (s from the end of homing)."""

    t_s: float
    reference: Reference


def sample_segments(segments: Sequence[Segment], before_s: float) -> list[TimedReference]:
    """Evaluate every segment that begins before a time closely; a repeated one, once."""
    samples: list[TimedReference] = []
    seen: set[int] = set()
    begin_s = 0.0
    for segment in segments:
        if begin_s >= before_s:
            break
        if id(segment) not in seen:
            seen.add(id(segment))
            count = round(segment.duration_s / _STEP_S)
            count = min(max(count, _FEWEST_SAMPLES), _MOST_SAMPLES)
            step_s = segment.duration_s / count
            samples += (
                TimedReference(begin_s + i * step_s, reference_at(segment, i * step_s))
                for i in range(count + 1)
            )
        begin_s += segment.duration_s
    return samples
