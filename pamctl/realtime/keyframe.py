"""The tick's state as the flat doubles of a keyframe, and back by their names.

The state is frozen into the log once a second, so that a replay can start there.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

State = TypeVar("State")


def freeze_state(state: object) -> list[float]:
    """Flatten a tick's state, tuples in tuples, into doubles."""
    if isinstance(state, tuple):
        return [number for part in state for number in freeze_state(part)]
    return [] if state is None else [float(state)]  # type: ignore[arg-type]


def keyframe_fields(state: object, path: str = "") -> list[str]:
    """Name the doubles that `freeze_state` makes: `filters.rate.pole` and the like."""
    if state is None:
        return []
    if not isinstance(state, tuple):
        return [path]
    return [
        field
        for name, part in zip(_name_parts(state, path), state, strict=True)
        for field in keyframe_fields(part, name)
    ]


def thaw_state(like: State, numbers: Mapping[str, float]) -> State:
    """Return the doubles of a keyframe, by name, in the shape of another state.

    A number of `like` that the keyframe lacks keeps its value: the keyframe is older. Names that
    `like` does not have are left out.
    """
    shaped: State = _shape_numbers(like, numbers, "")
    return shaped


def _shape_numbers(like: Any, numbers: Mapping[str, float], path: str) -> Any:
    if like is None:
        return None
    if not isinstance(like, tuple):
        return type(like)(numbers.get(path, like))
    names = _name_parts(like, path)
    parts = (_shape_numbers(p, numbers, name) for p, name in zip(like, names, strict=True))
    return type(like)._make(parts)  # type: ignore[attr-defined]


def _name_parts(state: tuple[Any, ...], path: str) -> list[str]:
    names = getattr(state, "_fields", None) or map(str, range(len(state)))
    prefix = f"{path}." if path else ""
    return [prefix + name for name in names]
