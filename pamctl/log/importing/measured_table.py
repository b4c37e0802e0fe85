"""A measured file as columns of numbers by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pamctl.log.columns import suggest_nearest
from pamctl.log.framing import LogError

Floats = NDArray[np.float64]


class ImportRefused(LogError):
    """A measured file cannot be imported. The message says what, where, and what to do."""


@dataclass(frozen=True)
class MeasuredTable:
    """Columns by name, and the numbers of the rows in the file."""

    columns: Mapping[str, Floats]
    """Arrays of shape (n,); in a MAT file their lengths may differ."""
    rows: NDArray[np.int64]
    """Number of each row in the file: the line of a CSV file, the index from 1 in a MAT file."""
    called: Mapping[str, str] = field(default_factory=dict)
    """The labels of Simulink signals, by column."""
    units: Mapping[str, str] = field(default_factory=dict)
    """Units that the file states apart from the names, by column."""
    notes: tuple[str, ...] = ()
    """What the user must know of the file, such as that its end is missing."""

    def __getitem__(self, name: str) -> Floats:
        """Return a column; raise ImportRefused with the existing names if there is none."""
        if name in self.columns:
            return self.columns[name]
        listed = ", ".join(list(self.columns)[:20]) or "none"
        hint = suggest_nearest(name, self.columns)
        raise ImportRefused(f"there is no column {name!r}{hint}; there are {listed}")
