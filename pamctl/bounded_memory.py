"""Results that are asked for again, kept up to a number of bytes; the oldest go first."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from typing import Generic, TypeVar

import numpy as np

Result = TypeVar("Result", bound=Sequence[object])


class BoundedMemory(Generic[Result]):
    """Arrays by what they were made from.

    A key may hold the `id` of an object: the object is kept with the result, so that no other one
    gets its `id`.
    """

    def __init__(self, most_bytes: int) -> None:
        self._most_bytes, self._bytes = most_bytes, 0
        self._known: OrderedDict[Hashable, tuple[Result, Sequence[object]]] = OrderedDict()

    def recall(
        self, key: Hashable, made_from: Sequence[object], make: Callable[[], Result]
    ) -> Result:
        """Return the result of `make`, from memory if it is there; it must not be changed."""
        if key in self._known:
            self._known.move_to_end(key)
            return self._known[key][0]
        result = make()
        self._known[key] = result, made_from
        self._bytes += _count_bytes(result)
        while self._bytes > self._most_bytes and len(self._known) > 1:
            oldest, _ = self._known.popitem(last=False)[1]
            self._bytes -= _count_bytes(oldest)
        return result


def _count_bytes(result: Sequence[object]) -> int:
    return sum(part.nbytes for part in result if isinstance(part, np.ndarray))
