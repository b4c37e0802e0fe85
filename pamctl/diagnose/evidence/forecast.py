"""How long a search still takes: foretold by a law at its begin, then by what its rounds took."""

from __future__ import annotations

import time

from pamctl.diagnose.evidence.fit import WeighedModel, Weigher

ASKED, FITTED = 6.5, 550
"""Simulations for each hypothesis until nothing is found, and for the fits of each finding. Of 20
rigs of several kinds 18 took between half and twice of what is foretold for what was found."""
DEARER = 2.0
"""Times the first fit's: a simulation for a finding, with its tangent."""
JUDGED = 0.6
"""Times the search: the last round, which finds nothing, and the fits of rivals."""


def foretell(weigher: Weigher, base: WeighedModel, asked: int, fit_s: float) -> str:
    """Say how long the search will take, from what a simulation of the first fit took."""
    none_s, each_s = ASKED * asked * fit_s, DEARER * FITTED * fit_s
    is_much = weigher.is_much_left(base)
    return (
        f"recalibrated{', and much is left' if is_much else ''}; about {none_s:.0f} s of processor "
        f"time if nothing is missing, {none_s + each_s:.0f} s if one thing is, and {each_s:.0f} s "
        "for each further one, found or exchanged"
    )


def foretell_more(weigher: Weigher, m: WeighedModel, round_s: float) -> str:
    """Say what was found, how long that took, and how long the rest will, if rounds stay alike."""
    took_s = time.process_time() - weigher.begun_s
    return (
        f"found after {took_s:.0f} s of processor time: {', '.join(m.names)}; about "
        f"{(1 + JUDGED) * round_s:.0f} s for each further one, {JUDGED * took_s:.0f} s to judge all"
    )
