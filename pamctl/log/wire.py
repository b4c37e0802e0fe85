"""The bytes of messages and ticks: numpy types encode and decode many at a time.

If all fields of a tick are present and have a fixed width, its length is constant. Then its wire
format is a structured array: tag, value, tag, value. Ticks of any other form are decoded one by
one, by the descriptor that the log carries.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass
from mcap.opcode import Opcode
from numpy.typing import NDArray

from pamctl.log.framing import FRAME, LogError
from pamctl.log.record_walk import BODY_AT, message_type
from pamctl.log.schema import TICK_MESSAGE, tick_descriptor
from pamctl.signals import Field

SEQUENCE = 0xFFFFFFFF
"""MCAP's sequence has 32 bits: at 1 kHz the tick exceeds it after 49 days."""


def make_message_records(
    data: NDArray[Any], times_ns: NDArray[Any], sequences: NDArray[Any]
) -> NDArray[Any]:
    """Make n message records from n messages of equal length; the channel is filled in later."""
    records = np.empty(len(data), message_type(data.itemsize))
    records["opcode"] = Opcode.MESSAGE
    records["length"] = records.itemsize - FRAME.size
    records["sequence"] = sequences & SEQUENCE
    records["log_time"] = records["publish_time"] = times_ns
    records["body"] = data.view(records["body"].dtype)
    return records


def make_message_record(data: bytes, time_ns: int, sequence: int) -> NDArray[Any]:
    """Make one message record; the message must not be empty."""
    one = np.frombuffer(data, f"V{len(data)}")
    return make_message_records(one, np.array([time_ns]), np.array([sequence]))


_FIXED_WIDTH: dict[int, tuple[int, str]] = {
    FieldDescriptorProto.TYPE_DOUBLE: (1, "<f8"),
    FieldDescriptorProto.TYPE_FIXED64: (1, "<u8"),
    FieldDescriptorProto.TYPE_SFIXED64: (1, "<i8"),
    FieldDescriptorProto.TYPE_FLOAT: (5, "<f4"),
    FieldDescriptorProto.TYPE_FIXED32: (5, "<u4"),
    FieldDescriptorProto.TYPE_SFIXED32: (5, "<i4"),
    # A bool is a varint, but always one byte long.
    FieldDescriptorProto.TYPE_BOOL: (0, "u1"),
}
"""Protobuf wire type and numpy type of the field types that have a fixed width."""

_FLOATS = (FieldDescriptorProto.TYPE_DOUBLE, FieldDescriptorProto.TYPE_FLOAT)
_NO_NUMBERS = (
    FieldDescriptorProto.TYPE_MESSAGE,
    FieldDescriptorProto.TYPE_GROUP,
    FieldDescriptorProto.TYPE_STRING,
    FieldDescriptorProto.TYPE_BYTES,
)
_MOST_DESCRIPTOR_BYTES = 1 << 16
"""Of pamctl's ticks it has 3 kB; each field of it costs memory, also where a tick lacks it."""


class UnknownLayout(LogError):
    """The embedded descriptor does not describe a row of numbers; the message says why."""


@dataclass(frozen=True)
class TickLayout:
    """The wire format of messages of fixed length."""

    names: tuple[str, ...]
    bools: frozenset[str]
    blank: NDArray[Any]
    """A message of shape () with its tags and zero values: `NAME.tag` before each `NAME`."""

    @classmethod
    def of_fields(cls, fields: Sequence[Field]) -> TickLayout:
        """Return the layout of a tick with these columns."""
        layout = cls.of_descriptor(tick_descriptor(fields), TICK_MESSAGE)
        assert layout is not None, "every column has a fixed width"
        return layout

    @classmethod
    def of_descriptor(cls, descriptor_set: bytes, message: str) -> TickLayout | None:
        """Return the layout of an embedded message; None if its length is not fixed."""
        fields = sorted(_find_fields(descriptor_set, message), key=lambda field: field.number)
        if any(field.type not in _FIXED_WIDTH for field in fields):
            return None
        tags = {f.name: _encode_varint(f.number << 3 | _FIXED_WIDTH[f.type][0]) for f in fields}
        wire = [
            column
            for field in fields
            for column in (
                (f"{field.name}.tag", "u1", (len(tags[field.name]),)),
                (field.name, _FIXED_WIDTH[field.type][1]),
            )
        ]
        blank = np.zeros((), wire)
        for name, tag in tags.items():
            blank[f"{name}.tag"] = tuple(tag)
        bools = frozenset(f.name for f in fields if f.type == FieldDescriptorProto.TYPE_BOOL)
        return cls(tuple(tags), bools, blank)

    @property
    def dtype(self) -> np.dtype[Any]:
        """The numpy type of one message."""
        return self.blank.dtype

    def encode(self, columns: NDArray[Any]) -> NDArray[Any]:
        """Turn a structured array of shape (n,) into n messages."""
        messages = np.frombuffer(bytearray(self.blank.tobytes() * len(columns)), self.dtype)
        for name in self.names:
            messages[name] = columns[name]
        return messages

    def fits(self, octets: NDArray[np.uint8]) -> bool:
        """Tell whether messages, as bytes of shape (n, size), have the expected tags."""
        at, low, high = self._limits
        found = octets[:, at]
        return bool(((low <= found) & (found <= high)).all())

    @cached_property
    def _limits(self) -> tuple[NDArray[Any], ...]:
        """Positions of tags and bools within a message, their least and their greatest bytes."""
        marked, most = np.zeros((), self.dtype), self.blank.copy()
        for name in self.names:
            marked[f"{name}.tag"] = 1
        for name in self.bools:
            marked[name] = most[name] = 1
        octets = [np.frombuffer(a.tobytes(), np.uint8) for a in (self.blank, most, marked)]
        at = np.flatnonzero(octets[2])
        return at, octets[0][at], octets[1][at]


Decoder = Callable[[Sequence[bytes]], dict[str, NDArray[Any]]]


def make_decoder(descriptor_set: bytes, message: str) -> Decoder:
    """Return a decoder of messages of any length, by their own descriptor.

    A missing float is NaN. No integer can mean "missing": the decoder raises UnknownLayout.
    """
    fields = _find_fields(descriptor_set, message)
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(descriptor_set).file:
        pool.Add(file)
    parse = GetMessageClass(pool.FindMessageTypeByName(message)).FromString

    def read_field(field: FieldDescriptorProto, messages: Sequence[Any]) -> NDArray[Any]:
        name = field.name
        if not field.proto3_optional:
            return np.array([getattr(one, name) for one in messages], _kind_of_field(field))
        values = [getattr(one, name) if one.HasField(name) else None for one in messages]
        if field.type not in _FLOATS and None in values:
            raise UnknownLayout(f"a tick lacks its {name}")
        return np.array(values, _kind_of_field(field))

    def decode(payloads: Sequence[bytes]) -> dict[str, NDArray[Any]]:
        try:
            messages = [parse(payload) for payload in payloads]
        except DecodeError as error:
            raise UnknownLayout("a tick does not match its descriptor") from error
        return {field.name: read_field(field, messages) for field in fields}

    return decode


class TickBatch(NamedTuple):
    """n ticks that follow one another in the file."""

    log_time_ns: NDArray[np.uint64]
    sequence: NDArray[np.uint32]
    columns: Mapping[str, NDArray[Any]]
    """Columns by name, each of shape (n,); they are views, to be copied by who keeps them."""


_BATCH_TICKS = 2048
"""Ticks that are decoded together: a chunk of 250 costs as many calls of numpy."""


class TickDecoder:
    """Decodes messages of the tick channel into columns."""

    def __init__(
        self, descriptor_set: bytes, message: str, fields: Collection[str] | None = None
    ) -> None:
        """Decode these fields; default: all.

        Raise UnknownLayout if the descriptor does not describe a row of numbers.
        """
        if len(descriptor_set) > _MOST_DESCRIPTOR_BYTES:
            raise UnknownLayout(f"its descriptor has {len(descriptor_set)} bytes")
        self._layout = TickLayout.of_descriptor(descriptor_set, message)
        self._bools = self._layout.bools if self._layout else frozenset()
        self._decode = make_decoder(descriptor_set, message)
        self.none = self._decode([])
        """All columns without ticks, each of its type."""
        self.wanted = {n: c for n, c in self.none.items() if fields is None or n in fields}
        """Those that are decoded."""
        self.take: Callable[[TickBatch], None] | None = None
        """Gets each batch; without it no tick is decoded."""
        self._waiting: list[NDArray[Any]] = []
        self._count = 0

    def add(self, records: NDArray[Any]) -> None:
        """Take the next ticks; raise UnknownLayout if one lacks an integer."""
        if self.take is None:
            return
        if self._waiting and self._waiting[0].dtype != records.dtype:
            self.flush()
        self._waiting.append(records)
        self._count += len(records)
        if self._count >= _BATCH_TICKS:
            self.flush()

    def flush(self) -> None:
        """Decode the ticks that wait for more of them."""
        waiting, self._waiting, self._count = self._waiting, [], 0
        if waiting:
            octets = [records.view(np.uint8) for records in waiting]  # joined field by field: slow
            self._decode_batch(np.concatenate(octets).view(waiting[0].dtype))

    def _decode_batch(self, records: NDArray[Any]) -> None:
        assert self.take is not None
        table = self._view_table(records)
        # Ticks of another form become objects, which take many times their bytes.
        most = len(records) if table is not None else _BATCH_TICKS
        for begin in range(0, len(records), most):
            part = records[begin : begin + most]
            if table is None:
                found = self._decode([body.tobytes() for body in part["body"]])
                columns = {name: found[name] for name in self.wanted}
            else:
                bools = self._bools
                columns = {n: table[n].view(bool) if n in bools else table[n] for n in self.wanted}
            self.take(TickBatch(part["log_time"], part["sequence"], columns))

    def _view_table(self, records: NDArray[Any]) -> NDArray[Any] | None:
        """Return ticks of constant form as a structured array; None for others."""
        layout, bodies = self._layout, records["body"]
        if layout is None or bodies.itemsize != layout.dtype.itemsize:
            return None
        octets = records.view(np.uint8).reshape(len(records), records.itemsize)
        return bodies.view(layout.dtype) if layout.fits(octets[:, BODY_AT:]) else None


def _kind_of_field(field: FieldDescriptorProto) -> type:
    if field.type == FieldDescriptorProto.TYPE_BOOL:
        return bool
    return float if field.type in _FLOATS else int


def _find_fields(descriptor_set: bytes, message: str) -> Sequence[FieldDescriptorProto]:
    """Return the fields of a message, all of them plain numbers."""
    package, _, name = message.rpartition(".")
    for file in FileDescriptorSet.FromString(descriptor_set).file:
        for candidate in file.message_type:
            if (file.package, candidate.name) == (package, name):
                for field in candidate.field:
                    repeated = field.label == FieldDescriptorProto.LABEL_REPEATED
                    if repeated or field.type in _NO_NUMBERS:
                        raise UnknownLayout(f"its field {field.name} is not a plain number")
                return candidate.field
    raise UnknownLayout(f"its descriptor does not describe {message}")


def _encode_varint(value: int) -> bytes:
    groups = []
    while value > 0x7F:
        groups.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*groups, value])
