"""Split the records in three parts: fitted on, chosen by, confirmed by.

Data that chose a model do not confirm it. The numbers are fitted on the first part. The second part
ranks the models and decides the verdict. The third part is used once, after the verdict, for the
figures that are printed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.fitting.drives import Drive
from pamctl.diagnose.fitting.evidence import Evidence
from pamctl.diagnose.measured.record import Record


class Part(Enum):
    """What a sample serves for."""

    FIT = "fit"
    CHOOSE = "choose"
    CONFIRM = "confirm"


HELD_OUT = (Part.CHOOSE, Part.CHOOSE, Part.CONFIRM)
"""Stretches of a held-out record, in turn. Every excitation then chooses and confirms."""
SINGLE_RUN = (Part.FIT, Part.CHOOSE, Part.FIT, Part.CHOOSE, Part.FIT, Part.CONFIRM)
"""Stretches of a run that serves for everything. A fit needs few samples; a choice needs many."""
STRETCH_S = 1.0
"""Stretches of held-out records, unless they would be too many or too few. Residuals a quarter of
this apart count as independent."""
MOST_STRETCHES = 60
TURNS = 2
"""How often the parts of a single run come in turn. Its stretches are long: an excitation that was
fitted should not also be the one that chooses."""


@dataclass(frozen=True)
class ConfirmedOn:
    """The data that the printed figures rest on."""

    records: tuple[str, ...]
    duration_s: float
    how: str

    def as_dict(self) -> dict[str, object]:
        """Return what the document holds."""
        return {"records": [*self.records], "duration_s": self.duration_s, "how": self.how}


def split_by_run(records: Sequence[Record]) -> tuple[list[Record], list[Record]]:
    """Hold out every third run, at least one; a single run is fitted and held out."""
    if len(records) == 1:
        return list(records), list(records)
    held = set(range(1, len(records), 3))
    return (
        [r for i, r in enumerate(records) if i not in held],
        [r for i, r in enumerate(records) if i in held],
    )


def keep_for_choice(evidence: Evidence, *, is_cut: bool) -> Evidence:
    """Return the evidence for fits and choices: the held-out drives without what confirms.

    With `is_cut` the drives of a single run are both fitted and held out, in stretches. Single
    samples would not do: neighbours are nearly equal. The blocks are always simulated over the
    whole run, since only its beginning is a known state.
    """
    chosen = _select_part(evidence.holdout, Part.CHOOSE, is_cut=is_cut)
    train = _select_part(evidence.train, Part.FIT, is_cut=True) if is_cut else evidence.train
    return replace(evidence, train=train, holdout=chosen)


def keep_for_confirmation(evidence: Evidence, *, is_cut: bool) -> Evidence:
    """Return the evidence whose held-out drives count only the samples that confirm."""
    return replace(evidence, holdout=_select_part(evidence.holdout, Part.CONFIRM, is_cut=is_cut))


def describe_confirmation(evidence: Evidence, *, is_cut: bool) -> ConfirmedOn:
    """Say what the figures of `keep_for_confirmation` rest on."""
    drives = next(iter(evidence.holdout.values()))
    duration_s = sum(d.samples * float(np.median(d.step_s)) for d in drives)
    runs = "a single run" if len(drives) == 1 else "each run"
    how = (
        f"{runs} in long stretches: half are fitted, a third choose, a sixth confirm"
        if is_cut
        else "records that were not fitted, in stretches: two of three choose, the third confirms"
    )
    return ConfirmedOn(tuple(d.name for d in drives), duration_s, how)


def _select_part(
    drives: dict[str, tuple[Drive, ...]], part: Part, *, is_cut: bool
) -> dict[str, tuple[Drive, ...]]:
    return {
        block: tuple(replace(d, part=find_samples(d, part, is_cut=is_cut)) for d in some)
        for block, some in drives.items()
    }


def find_samples(drive: Drive, part: Part, *, is_cut: bool) -> NDArray[np.bool_]:
    """Return which samples of a record serve for a part, shape (n,)."""
    order = SINGLE_RUN if is_cut else HELD_OUT
    samples = len(drive.measured)
    by_time = float(np.sum(drive.step_s)) / STRETCH_S
    turns = TURNS if is_cut else int(np.clip(by_time, len(order), MOST_STRETCHES)) // len(order)
    stretch = np.arange(samples) * turns * len(order) // samples
    return np.isin(stretch % len(order), [i for i, p in enumerate(order) if p is part])
