"""Split the records for fitting and judging: whole runs, or long stretches of a single run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pamctl.diagnose.fitting.drives import Drive
from pamctl.diagnose.fitting.evidence import Evidence
from pamctl.diagnose.measured.record import Record

STRETCHES = 9
"""Number of stretches of a single run; every third is held out."""


def split_by_run(records: Sequence[Record]) -> tuple[list[Record], list[Record]]:
    """Hold out every third run, at least one; `split_by_stretch` is for a single run."""
    if len(records) == 1:
        return list(records), list(records)
    held = set(range(1, len(records), 3))
    return (
        [r for i, r in enumerate(records) if i not in held],
        [r for i, r in enumerate(records) if i in held],
    )


def split_by_stretch(evidence: Evidence) -> Evidence:
    """Use two thirds of each run for the fit and one to judge by, in long stretches.

    Single samples would not do: neighbours are nearly equal. The blocks are always simulated over
    the whole run, since only its beginning is a known state.
    """
    return replace(
        evidence,
        train={b: tuple(_take_third(d, False) for d in ds) for b, ds in evidence.train.items()},
        holdout={b: tuple(_take_third(d, True) for d in ds) for b, ds in evidence.holdout.items()},
    )


def _take_third(drive: Drive, held_out: bool) -> Drive:
    stretch = np.arange(len(drive.measured)) * STRETCHES // len(drive.measured)
    rows = (stretch % 3 == 1) == held_out
    return replace(drive, rows=rows if drive.rows is None else rows & drive.rows)
