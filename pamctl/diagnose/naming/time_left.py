"""How long a diagnosis will take, from what its first steps took on this computer."""

from __future__ import annotations

LONGER = (1.5, 6.0)
"""All of a diagnosis that names something, as a multiple of its part up to the recalibration.

In 50 such cases of the hidden suite it took 3.3 to 7.6 s of CPU (tenth and ninetieth percentile),
with some 1.3 s up to the recalibration; on two runs of a minute 6.7 s, with 3.2 s."""
CLOSE = 1.2
"""So near the floor nothing may be left to name: then it ends soon."""


def guess_time_left(so_far_s: float, worst_ratio: float) -> str:
    """Say how long it took so far and, where a gap is left, how long it will take in all."""
    told = f"{so_far_s:.0f} s so far"
    if worst_ratio < CLOSE:
        return told
    low_s, high_s = (so_far_s * longer for longer in LONGER)
    return f"{told}, usually {low_s:.0f} to {max(high_s, low_s + 1.0):.0f} s in all"
