"""How much a client may ask."""

from __future__ import annotations

REQUESTS_PER_S = 100.0
BURST = 200.0


class Allowance:
    """How much a client may ask: a bucket that fills with time."""

    def __init__(self, now_s: float) -> None:
        """Begin with a full one."""
        self._tokens, self._last_s = BURST, now_s

    def spend(self, now_s: float) -> bool:
        """Take one token; return whether there was one."""
        self._tokens = min(BURST, self._tokens + (now_s - self._last_s) * REQUESTS_PER_S)
        self._last_s = now_s
        if self._tokens < 1.0:
            return False
        self._tokens -= 1.0
        return True
