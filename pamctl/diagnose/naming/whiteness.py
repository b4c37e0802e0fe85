"""Signs that a residual below its limit is not noise.

A floor may be wrong: noise is hard to estimate from a lively record. Noise is white, or has the
colour of the replicas, and does not repeat itself. What a model lacks is slow, and comes again with
the excitation.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import uniform_filter1d

from pamctl.diagnose.fitting.block_fit import rms
from pamctl.diagnose.fitting.drives import Drive
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.floor import simulate_floor
from pamctl.diagnose.locate import draw_noise
from pamctl.diagnose.measured.record import Array
from pamctl.diagnose.naming.shortlist import WORTH_ANOTHER_EFFECT
from pamctl.diagnose.naming.stretches import average_block_squares, is_clearly_above

VISIBLE_SHARE = 0.1
"""A residual above this share of the signal's variation is visible in a plot of both."""
LARGE_SHARE = 0.3
"""A sensor with so much noise cannot say that nothing is missing."""
ALIKE = 0.5
"""Correlation of neighbours above which a visible residual is no sensor noise."""
WINDOWS_S = (0.02, 0.1, 0.5)
"""The residual and its replicas are averaged over these times, to compare what is left."""
FAR_BEYOND = 1.5
"""The averaged residual is coloured above this multiple of the largest of its replicas."""
REPEATED_SHARE = 0.5
"""Share of a residual's square that comes again where the excitation does."""
MATTERS = 1.5
"""What is coloured or comes again matters above this multiple of the smallest misfit."""


@dataclass(frozen=True)
class ResidualSign:
    """Something in a residual that noise does not do."""

    block: str
    kind: str
    """`visible`, `coloured`, `repeats` or `unconfirmed`."""
    words: str

    def as_dict(self) -> dict[str, str]:
        """Return what the document holds."""
        return {"block": self.block, "kind": self.kind, "words": self.words}


def find_residual_signs(model: Model, confirmed: Model) -> tuple[ResidualSign, ...]:
    """Return what speaks against noise in the residuals of a model that is at its limits.

    `confirmed` is the same model on the samples that confirm.
    """
    return tuple(
        ResidualSign(block, kind, words)
        for block in model.evidence.blocks
        for kind, words in (
            *_find_visible(model, block),
            *_find_colour(model, block),
            *_find_repetition(model, block),
            *_find_excess(confirmed, block),
        )
    )


def _find_visible(model: Model, block: str) -> Iterator[tuple[str, str]]:
    drives = model.evidence.holdout[block]
    signal = np.concatenate([_count(d, d.measured - np.mean(d.measured)) for d in drives])
    residual = model.residuals[block]
    share = rms(residual) * drives[0].deviation / (rms(signal) or np.inf)
    neighbours = float(np.mean(residual[1:] * residual[:-1]) / np.mean(residual**2))
    if share > LARGE_SHARE or (share > VISIBLE_SHARE and neighbours > ALIKE):
        yield "visible", f"it is {100.0 * share:.0f} % of the signal's own variation"


def _count(drive: Drive, values: Array) -> Array:
    return values if drive.rows is None else values[drive.rows]


def _find_colour(model: Model, block: str) -> Iterator[tuple[str, str]]:
    """Compare what averages leave of the residual with what they leave of the replicas."""
    residual, floor = model.residuals[block], model.floors[block]
    noise = draw_noise(model, block)
    # What the rig does differently each time may have any colour.
    restless = float(np.sqrt(max(floor.repeatability**2 - floor.mean**2, 0.0)))
    least = MATTERS * model.evidence.margin(block)
    period_s = float(np.median(model.evidence.holdout[block][0].step_s))
    for window_s in WINDOWS_S:
        samples = round(window_s / period_s)
        if not 2 <= samples <= len(residual) // 4:
            continue
        left = rms(uniform_filter1d(residual, samples))
        largest = max(rms(uniform_filter1d(replica, samples)) for replica in noise)
        usual = float(np.hypot(largest, restless))
        beyond = float(np.sqrt(max(left**2 - usual**2, 0.0)))
        if left > FAR_BEYOND * usual and beyond > least:
            yield (
                "coloured",
                f"averaged over {window_s:g} s it is {left / usual:.1f} times what noise leaves",
            )
            return


def _find_repetition(model: Model, block: str) -> Iterator[tuple[str, str]]:
    """Find how much of the residual comes again where the commands do."""
    evidence = model.evidence
    drives = [*evidence.train[block], *evidence.holdout[block]]
    settings = model.fit_of(block).settings
    left = {
        index: replace(drives[index], usable=None, part=None).residual(settings)
        for index in {i for r in evidence.repeated for i in (r.one, r.other)}
    }
    pairs = [
        (left[r.one][r.start : r.start + r.length], left[r.other][r.again : r.again + r.length])
        for r in evidence.repeated
    ]
    if not pairs:
        return
    one, other = (np.concatenate(side) for side in zip(*pairs, strict=True))
    again, whole = float(np.mean(one * other)), float(0.5 * np.mean(one**2 + other**2))
    share = again / whole
    # Two slow noises may look alike over a short while.
    by_chance = whole * np.sqrt(model.floors[block].memory / len(one))
    if share > REPEATED_SHARE and again - by_chance > (MATTERS * evidence.margin(block)) ** 2:
        yield "repeats", f"{100.0 * share:.0f} % of it comes again where the excitation does"


def _find_excess(confirmed: Model, block: str) -> Iterator[tuple[str, str]]:
    """Find a residual above its limit on the samples that confirm, which are fewer.

    A model without effects gets more room: false alarms must be rare. Several effects together get
    none: two wrong neighbours may just reach the limit that chose them.
    """
    limit = confirmed.floors[block].limit * (1.0 if confirmed.effects else WORTH_ANOTHER_EFFECT)
    is_above = not confirmed.is_explained(block) and (
        len(confirmed.effects) > 1
        or (
            is_clearly_above(average_block_squares(confirmed, block), limit)
            and not _may_be_noise(confirmed, block)
        )
    )
    if is_above:
        ratio = confirmed.ratio(block)
        yield "unconfirmed", f"it is {ratio:.1f} times its floor on the data that confirm"


def _may_be_noise(confirmed: Model, block: str) -> bool:
    """Tell whether a perfect model could leave as much of the samples that confirm.

    They may show a number that the fitted samples leave open: noise has moved it there.
    """
    evidence = confirmed.evidence
    own = simulate_floor(
        confirmed.fit_of(block),
        evidence.holdout[block],
        evidence.noises,
        margin=evidence.margin(block),
    )
    return confirmed.rms[block] <= own.limit
