"""Where the edges of a card's sample clock lie on the computer's clock.

A card that samples by its own clock does not say when. A program sees only when its blocking
read returned: never before the edge, and later by the time that the computer took to wake up.
So the earliest returns show where the edges lie, and the other returns show how late they were.
The crystals of card and computer differ by some ten microseconds a second; the grid follows.
"""

from __future__ import annotations

from hal.rig import Edge


class EdgeGrid:
    """Finds the edge that a read belongs to, from the time of its return.

    This is right for reads that return within nine tenths of a period after their edge.
    """

    def __init__(self, period_ns: int) -> None:
        """`period_ns` is the distance of two edges by the card's clock."""
        self._period_ns = period_ns
        # The grid runs this much slower than nominal, twice the difference of two good crystals:
        # a read that returns early can pull the grid back, and nothing can push it forward.
        self._creep_ns = period_ns // 10_000
        # A return this little before an edge belongs to that edge, not to the one before.
        self._slack_ns = period_ns // 20
        self._t_ns: int | None = None

    def place(self, now_ns: int) -> Edge:
        """Return the edge of a read that returned at `now_ns`; the first counts as prompt."""
        if self._t_ns is None:
            self._t_ns = now_ns
            return Edge(now_ns, now_ns, 1)
        elapsed = max(1, (now_ns - self._t_ns + self._slack_ns) // self._period_ns)
        due_ns = self._t_ns + elapsed * (self._period_ns + self._creep_ns)
        self._t_ns = min(due_ns, now_ns)
        return Edge(self._t_ns, now_ns, elapsed)
