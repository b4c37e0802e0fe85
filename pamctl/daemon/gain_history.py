"""Who changed which gain when, since the daemon was started; and what can be taken back."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

_KEPT_CHANGES = 20


@dataclass(frozen=True)
class GainEdit:
    """Gains that were changed together."""

    time_s: float
    """Wall clock."""
    by: str
    """The name that the client gave; empty if it gave none."""
    gains: Mapping[str, tuple[Any, Any]]
    """Values before and after, by name."""
    is_undo: bool = False
    is_undone: bool = False

    def describe(self) -> str:
        """Return `lambda_per_s 37.82 to 60`, for the log and for people."""
        said = ", ".join(
            f"{name} {_spell(before)} to {_spell(after)}"
            for name, (before, after) in self.gains.items()
        )
        return f"{said} (undo)" if self.is_undo else said


class GainHistory:
    """The newest changes of gains, oldest first."""

    def __init__(self) -> None:
        """Begin without a change."""
        self._changes: deque[GainEdit] = deque(maxlen=_KEPT_CHANGES)

    def note(
        self,
        before: Mapping[str, Any],
        after: Mapping[str, Any],
        by: str,
        undoes: GainEdit | None = None,
    ) -> GainEdit | None:
        """Remember a change, which may take back an earlier one. None if nothing has changed."""
        gains = {
            name: (before.get(name), value)
            for name, value in after.items()
            if before.get(name) != value
        }
        if undoes is not None:
            kept = [replace(c, is_undone=True) if c is undoes else c for c in self._changes]
            self._changes = deque(kept, _KEPT_CHANGES)
        if not gains:
            return None
        change = GainEdit(time.time(), by, gains, is_undo=undoes is not None)
        self._changes.append(change)
        return change

    def find_undoable(self) -> GainEdit | None:
        """Return the newest change that was not taken back, and takes nothing back itself."""
        left = (c for c in reversed(self._changes) if not c.is_undo and not c.is_undone)
        return next(left, None)

    def clear(self) -> None:
        """Forget all: other gains were loaded, perhaps of another law."""
        self._changes.clear()

    def tell(self) -> list[dict[str, Any]]:
        """Return the changes for a status."""
        undoable = self.find_undoable()
        return [
            {"time_s": c.time_s, "by": c.by, "what": c.describe(), "undoable": c is undoable}
            for c in self._changes
        ]


def _spell(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
