"""A measured file as columns of numbers, each found by its name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pamctl.log.framing import LogError
from pamctl.log.ticks import suggest_nearest

Floats = NDArray[np.float64]


class ImportRefused(LogError):
    """A measured file cannot be imported. The message says what, where, and what to do."""


@dataclass(frozen=True)
class MeasuredTable:
    """Columns, and what the file calls a row."""

    columns: Mapping[str, Floats]
    """Arrays of shape (n,); of a MAT file they may differ in length."""
    rows: NDArray[np.int64]
    """Number of each row as the file's reader counts them: lines of a CSV, indices from 1."""
    called: Mapping[str, str] = field(default_factory=dict)
    """What a column is called, where that is not its name: the label of a Simulink signal."""

    def __getitem__(self, name: str) -> Floats:
        """Return a column; raise LogError, with what there is, if there is none of the name."""
        if name in self.columns:
            return self.columns[name]
        listed = ", ".join(list(self.columns)[:20]) or "none"
        hint = suggest_nearest(name, self.columns)
        raise ImportRefused(f"there is no column {name!r}{hint}; there are {listed}")
