"""The tick's state as the flat doubles of a keyframe, and back.

Frozen into the log once a second, so that a replay can start there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

State = TypeVar("State")


def frozen(state: object) -> list[float]:
    """Flatten a tick's state, tuples in tuples, into doubles."""
    if isinstance(state, tuple):
        return [number for part in state for number in frozen(part)]
    return [float(state)]  # type: ignore[arg-type]


def keyframe_fields(state: object, path: str = "") -> list[str]:
    """Name the doubles that `frozen` makes: `filters.rate.pole` and the like."""
    if isinstance(state, tuple):
        names = getattr(state, "_fields", None) or map(str, range(len(state)))
        prefix = f"{path}." if path else ""
        return [
            field
            for name, part in zip(names, state, strict=True)
            for field in keyframe_fields(part, prefix + name)
        ]
    return [path]


def thawed(like: State, numbers: Sequence[float]) -> State:
    """Undo `frozen`: the doubles in the shape of another state, and with its types.

    Raises ValueError where there are more or fewer of them than `like` is made of.
    """
    if len(numbers) != len(frozen(like)):
        raise ValueError(f"{len(numbers)} numbers, but the state is made of {len(frozen(like))}")
    shaped: State = _shaped(like, iter(numbers))
    return shaped


def _shaped(like: Any, numbers: Iterator[float]) -> Any:
    if isinstance(like, tuple):
        return type(like)._make(_shaped(part, numbers) for part in like)  # type: ignore[attr-defined]
    return type(like)(next(numbers))
