"""Where the edges of a card's sample clock lie on the computer's clock.

A card that samples by a clock of its own does not say when. All that a program sees is when its
blocking read returned: never before the edge, and later by whatever the computer took to wake.
So the earliest returns show where the edges are, and the others how late they were. The card's
crystal and the computer's part by some ten microseconds a second, and the grid goes with them.
"""

from __future__ import annotations

from typing import NamedTuple


class Edge(NamedTuple):
    """One edge of the sample clock, as a blocking read met it."""

    t_ns: int
    """When the sample was taken, on the computer's clock."""
    now_ns: int
    """When the read returned: not before `t_ns`."""
    elapsed: int
    """Edges since the one that was met before; 1 where none was missed."""


class EdgeGrid:
    """Finds the edge that a read belongs to, from the time of its return.

    Right as long as reads return within nine tenths of a period of their edge, or else miss it.
    """

    def __init__(self, period_ns: int) -> None:
        """`period_ns` is the distance of two edges by the card's clock."""
        self._period_ns = period_ns
        # The grid goes this much slower than the nominal one: it can only be pulled back, by a
        # read that returns before its edge. Twice what two good crystals differ by.
        self._creep_ns = period_ns // 10_000
        # A return so little before an edge is that edge's, and not a very late one of the last.
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
