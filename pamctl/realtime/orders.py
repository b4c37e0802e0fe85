"""Orders to a running loop: one slot in shared memory, without a lock.

    sequence, emergency, size | taken | JSON

One process writes orders. The loop takes them in the slack of its ticks. A new order is written
only after the last one was taken, so neither process ever waits for the other. An emergency stop
needs no slot: it has a word of its own, which the loop reads in every tick.

The memory has no name: it is freed with the last process that holds it, however that process
ends. The protocol needs stores to become visible in order, as they do on x86.
"""

from __future__ import annotations

import mmap
import os
import time
from collections.abc import Callable, Mapping
from typing import Any

from pamctl.json_text import from_json, to_json

LARGEST_ORDER = 1 << 20
_HEADER_BYTES = 4096
# Words of one writing process stand on a cache line of their own (8 words).
_SEQUENCE, _EMERGENCY, _SIZE = 0, 1, 2
_TAKEN = 8
_POLL_S = 5e-4


class OrderError(Exception):
    """The loop did not take an order. The message says why."""


class Orders:
    """The slot, attached to this process."""

    def __init__(self, fd: int) -> None:
        """Map the memory of `fd`; this object owns `fd` from now on."""
        self.fd = fd
        self._map = mmap.mmap(fd, _HEADER_BYTES + LARGEST_ORDER)
        self._buffer = memoryview(self._map)
        self._words = self._buffer[:_HEADER_BYTES].cast("Q")

    @classmethod
    def create(cls) -> Orders:
        """Make an empty slot; its `fd` is for the loop process to inherit."""
        fd = os.memfd_create("pamctl-orders", os.MFD_CLOEXEC)
        os.ftruncate(fd, _HEADER_BYTES + LARGEST_ORDER)
        return cls(fd)

    # The writer's side.

    @property
    def is_free(self) -> bool:
        """The last order was taken."""
        return self._words[_TAKEN] == self._words[_SEQUENCE]

    def send(self, order: Mapping[str, Any]) -> None:
        """Write one order; raise `OrderError` where the one before was not taken yet."""
        text = to_json(order)
        if len(text) > LARGEST_ORDER:
            raise OrderError(f"{len(text)} bytes exceed the {LARGEST_ORDER} of an order")
        if not self.is_free:
            raise OrderError("the loop has not taken the order before this one yet")
        self._buffer[_HEADER_BYTES : _HEADER_BYTES + len(text)] = text
        self._words[_SIZE] = len(text)
        self._words[_SEQUENCE] += 1

    def wait_until_taken(
        self, patience_s: float, is_alive: Callable[[], bool] = lambda: True
    ) -> None:
        """Return once the last order was taken; raise `OrderError` if it is not in time."""
        deadline_s = time.monotonic() + patience_s
        while not self.is_free:
            if not is_alive():
                raise OrderError("the loop has ended; `pamctl status` says why")
            if time.monotonic() > deadline_s:
                raise OrderError(f"the loop did not take the order within {patience_s:g} s")
            time.sleep(_POLL_S)

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
        order: dict[str, Any] = from_json(bytes(self._buffer[_HEADER_BYTES:][:size]))
        self._words[_TAKEN] = sequence
        return order

    def close(self) -> None:
        """Unmap."""
        self._words.release()
        self._buffer.release()
        self._map.close()
        os.close(self.fd)
