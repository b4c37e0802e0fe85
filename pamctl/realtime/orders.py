"""Orders to a running loop: one slot in shared memory, without a lock.

    sequence, emergency, size | taken | JSON

The slot lies in the ring of the loop. One process at a time writes orders. The loop takes them in
the slack of its ticks. A new order is written only after the last one was taken, so the loop never
waits. An emergency stop needs no slot: it has a word of its own, which the loop reads in every
tick. The protocol needs stores to become visible in order, as they do on x86.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from pamctl.base.texts import from_json, to_json

SESSION_SLOT_BYTES, MARK_SLOT_BYTES = 1 << 20, 1 << 14
"""A slot for all orders, with settings in them; and one for marks only."""
_HEADER_BYTES = 128
# Words of one writing process stand on a cache line of their own (8 words).
_SEQUENCE, _EMERGENCY, _SIZE = 0, 1, 2
_TAKEN = 8
_POLL_S = 5e-4


class OrderError(Exception):
    """The loop did not take an order. The message says why."""


class Orders:
    """The slot, attached to this process."""

    def __init__(self, slot: memoryview) -> None:
        """Use the memory of `slot`, which is all zeros before the first order."""
        self._words = slot[:_HEADER_BYTES].cast("Q")
        self._text = slot[_HEADER_BYTES:]

    # The writer's side.

    @property
    def is_free(self) -> bool:
        """The last order was taken."""
        return self._words[_TAKEN] == self._words[_SEQUENCE]

    def send(self, order: Mapping[str, Any]) -> None:
        """Write one order; raise `OrderError` where the one before was not taken yet."""
        text = to_json(order)
        if len(text) > len(self._text):
            raise OrderError(f"{len(text)} bytes exceed the {len(self._text)} of an order")
        if not self.is_free:
            raise OrderError("the loop has not taken the order before this one yet")
        self._text[: len(text)] = text
        self._words[_SIZE] = len(text)
        self._words[_SEQUENCE] += 1

    def wait_until_taken(
        self, patience_s: float, is_alive: Callable[[], bool] = lambda: True
    ) -> None:
        """Return once the last order was taken; raise `OrderError` if it is not in time."""
        deadline_s = time.monotonic() + patience_s
        while not self.is_free:
            if not is_alive():
                raise OrderError("the loop has ended")
            if time.monotonic() > deadline_s:
                raise OrderError(f"the loop did not take the order within {patience_s:g} s")
            time.sleep(_POLL_S)

    def give(
        self, order: Mapping[str, Any], patience_s: float, is_alive: Callable[[], bool]
    ) -> None:
        """Return once the loop has taken an order; raise `OrderError` if it does not in time."""
        self.wait_until_taken(patience_s, is_alive)
        self.send(order)
        self.wait_until_taken(patience_s, is_alive)

    def stop_now(self) -> None:
        """Demand the emergency stop. Only a new session runs again."""
        self._words[_EMERGENCY] = 1

    # The loop's side.

    @property
    def emergency(self) -> bool:
        """An emergency stop was demanded."""
        return self._words[_EMERGENCY] != 0

    def take(self) -> dict[str, Any] | None:
        """Return the next order, or None, which takes some tenths of a microsecond."""
        sequence = self._words[_SEQUENCE]
        if sequence == self._words[_TAKEN]:
            return None
        size = self._words[_SIZE]
        order: dict[str, Any] = from_json(bytes(self._text[:size]))
        self._words[_TAKEN] = sequence
        return order

    def close(self) -> None:
        """Let go of the memory: its ring can be closed then."""
        self._words.release()
        self._text.release()
