"""A course for another process, which takes it up at once, however many segments it has.

    number of items | place and size of each | items

The items are a head, a text, the segments and the cues, each packed on its own: the process that
follows the course unpacks one when it comes to it. Both are of one program and one user.
"""

from __future__ import annotations

import pickle
import struct
from array import array
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from pamctl.control.course import Course, Segment, start_at_position
from pamctl.control.course_table import SEGMENT_WORDS, pack_course

_COUNT = struct.Struct("<Q")
_PLACE = struct.Struct("<QQ")
_BEFORE_SEGMENTS = 2
_LONGEST_TABLE = 1 << 13
"""Numbers; to take up a longer one would take too much of a tick."""

Read = Callable[[int, int], bytes]
"""Returns so many bytes from a place on: `read(start, size)`."""


def pack_handed_course(course: Course, text: bytes) -> bytes:
    """Pack a course that has not begun, and a text about it."""
    table = course.table
    if table is not None and len(table) > _LONGEST_TABLE:
        table = None
    head = (len(course.segments), course.duration_s, course.end_reason, table)
    items = [head, text, *course.segments, *course.cues]
    places, packed = array("Q"), bytearray()
    known: dict[int, tuple[int, int]] = {}  # a wave repeats the same segments many thousand times
    begin = _COUNT.size + len(items) * _PLACE.size
    for item in items:
        if id(item) not in known:
            piece = pickle.dumps(item)
            known[id(item)] = begin + len(packed), len(piece)
            packed += piece
        places.extend(known[id(item)])
    return b"".join((_COUNT.pack(len(items)), places.tobytes(), packed))


class _Items(Sequence[Any]):
    """Some of the items; the one that was asked for last is kept."""

    def __init__(self, read: Read, begin: int, end: int) -> None:
        self._read, self._begin, self._end = read, begin, end
        self._at, self._item = -1, None

    def __len__(self) -> int:
        return self._end - self._begin

    def __getitem__(self, index: Any) -> Any:
        at = range(self._begin, self._end)[index]
        if at != self._at:
            place = self._read(_COUNT.size + at * _PLACE.size, _PLACE.size)
            self._at, self._item = at, pickle.loads(self._read(*_PLACE.unpack(place)))
        return self._item


class _StartingAt(Sequence[Segment]):
    """Segments, of which the first one is another."""

    def __init__(self, first: Segment, segments: Sequence[Segment]) -> None:
        self._first, self._segments = first, segments

    def __len__(self) -> int:
        return len(self._segments)

    def __getitem__(self, index: Any) -> Any:
        return self._segments[index] if index else self._first

    def __iter__(self) -> Iterator[Segment]:
        return (self[index] for index in range(len(self)))


def take_up_course(read: Read, start_m: float) -> tuple[Course, bytes]:
    """Return the course, begun at a position as `start_at_position` does it, and the text.

    `read` is called as long as the course is followed.
    """
    (count,) = _COUNT.unpack(read(0, _COUNT.size))
    head, text = _Items(read, 0, _BEFORE_SEGMENTS)
    cues_at = _BEFORE_SEGMENTS + head[0]
    segments: Sequence[Segment] = _Items(read, _BEFORE_SEGMENTS, cues_at)
    _, duration_s, end_reason, table = head
    (first,) = start_at_position((segments[0],), start_m)
    if first != segments[0]:
        segments = _StartingAt(first, segments)
        table = table and pack_course((first,)) + table[SEGMENT_WORDS:]
    cues = _Items(read, cues_at, count)
    return Course.restore(segments, duration_s, end_reason, table, cues), text
