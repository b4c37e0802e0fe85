"""The tick's state as the flat doubles of a keyframe, and back.

Frozen into the log once a second, so that a replay can start there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

State = TypeVar("State")


def freeze_state(state: object) -> list[float]:
    """Flatten a tick's state, tuples in tuples, into doubles."""
    if isinstance(state, tuple):
        return [number for part in state for number in freeze_state(part)]
    return [float(state)]  # type: ignore[arg-type]


def keyframe_fields(state: object, path: str = "") -> list[str]:
    """Name the doubles that `freeze_state` makes: `filters.rate.pole` and the like."""
    if isinstance(state, tuple):
        names = getattr(state, "_fields", None) or map(str, range(len(state)))
        prefix = f"{path}." if path else ""
        return [
            field
            for name, part in zip(names, state, strict=True)
            for field in keyframe_fields(part, prefix + name)
        ]
    return [path]


def thaw_state(like: State, numbers: Sequence[float]) -> State:
    """Undo `freeze_state`: the doubles in the shape of another state, and with its types.

    Raises ValueError where there are more or fewer of them than `like` is made of.
    """
    if len(numbers) != len(freeze_state(like)):
        raise ValueError(
            f"{len(numbers)} numbers, but the state is made of {len(freeze_state(like))}"
        )
    shaped: State = _shape_numbers(like, iter(numbers))
    return shaped


def _shape_numbers(like: Any, numbers: Iterator[float]) -> Any:
    if isinstance(like, tuple):
        return type(like)._make(_shape_numbers(part, numbers) for part in like)  # type: ignore[attr-defined]
    return type(like)(next(numbers))
