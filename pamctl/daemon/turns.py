"""Whose turn it is: one client after the other, and never more than half of the time."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager


class Turns:
    """Clients wait here for each other.

    However many they are, and however much they ask: whoever waits for nobody finds the daemon
    free at least every other moment, and so does the watch over the loop, which shares the
    interpreter.
    """

    def __init__(self) -> None:
        """Begin with nobody waiting."""
        self._lock = asyncio.Lock()  # first come, first served

    @asynccontextmanager
    async def take_turn(self) -> AsyncIterator[None]:
        """Wait for one's turn; afterwards nobody has one for as long as it took."""
        async with self._lock:
            began_s = time.monotonic()
            try:
                yield
            finally:
                await asyncio.sleep(time.monotonic() - began_s)
