"""The bytes of a tick: one numpy type encodes and decodes them.

If all fields of a message are present and have a fixed width, its length is constant. Then its
wire format is a structured array: tag, value, tag, value.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass
from numpy.typing import NDArray

from pamctl.log.framing import LogError
from pamctl.log.schema import TICK_MESSAGE, tick_descriptor
from pamctl.signals import Field

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
_COMPOSITE = (FieldDescriptorProto.TYPE_MESSAGE, FieldDescriptorProto.TYPE_GROUP)
_TEXT = (FieldDescriptorProto.TYPE_STRING, FieldDescriptorProto.TYPE_BYTES)


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
        at, tags = self._tags
        return bool((octets[:, at] == tags).all()) and bool(
            (octets[:, self._bool_places] <= 1).all()
        )

    @cached_property
    def _tags(self) -> tuple[NDArray[np.intp], NDArray[np.uint8]]:
        """Positions of the tags within a message, and their bytes."""
        at = self._find_bytes_of(f"{name}.tag" for name in self.names)
        return at, np.frombuffer(self.blank.tobytes(), np.uint8)[at]

    @cached_property
    def _bool_places(self) -> NDArray[np.intp]:
        """Positions of the bools within a message."""
        return self._find_bytes_of(self.bools)

    def _find_bytes_of(self, parts: Iterable[str]) -> NDArray[np.intp]:
        marked = np.zeros((), self.dtype)
        for part in parts:
            marked[part] = 1
        return np.flatnonzero(np.frombuffer(marked.tobytes(), np.uint8))

    def decode(
        self, messages: NDArray[Any], fields: Collection[str] | None = None
    ) -> dict[str, NDArray[Any]]:
        """Return the columns of messages that fit, each of shape (n,); default: all of them."""
        return {
            name: messages[name].astype(bool) if name in self.bools else messages[name].copy()
            for name in self.names
            if fields is None or name in fields
        }


Decoder = Callable[[Iterable[bytes]], dict[str, NDArray[Any]]]


def make_decoder(descriptor_set: bytes, message: str) -> Decoder:
    """Return a decoder of messages of any length, by their own descriptor.

    A missing float is NaN. No integer can mean "missing": the decoder raises UnknownLayout.
    """
    fields = _find_fields(descriptor_set, message)
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(descriptor_set).file:
        pool.Add(file)
    parse = GetMessageClass(pool.FindMessageTypeByName(message)).FromString

    def decode(payloads: Iterable[bytes]) -> dict[str, NDArray[Any]]:
        try:
            messages = [parse(payload) for payload in payloads]
        except DecodeError as error:
            raise UnknownLayout("a tick does not match its descriptor") from error
        return {
            field.name: np.array([_read_value(m, field) for m in messages], _kind_of_field(field))
            for field in fields
        }

    return decode


def _kind_of_field(field: FieldDescriptorProto) -> type:
    if field.type == FieldDescriptorProto.TYPE_BOOL:
        return bool
    return float if field.type in _FLOATS else int


def _read_value(message: Any, field: FieldDescriptorProto) -> Any:
    if not field.proto3_optional or message.HasField(field.name):
        return getattr(message, field.name)
    if field.type in _FLOATS:
        return float("nan")
    raise UnknownLayout(f"a tick lacks its {field.name}")


def _find_fields(descriptor_set: bytes, message: str) -> Sequence[FieldDescriptorProto]:
    """Return the fields of a message, all of them plain numbers."""
    package, _, name = message.rpartition(".")
    for file in FileDescriptorSet.FromString(descriptor_set).file:
        for candidate in file.message_type:
            if (file.package, candidate.name) == (package, name):
                return [_require_number(field) for field in candidate.field]
    raise UnknownLayout(f"its descriptor does not describe {message}")


def _require_number(field: FieldDescriptorProto) -> FieldDescriptorProto:
    repeated = field.label == FieldDescriptorProto.LABEL_REPEATED
    if repeated or field.type in _COMPOSITE or field.type in _TEXT:
        raise UnknownLayout(f"its field {field.name} is not a plain number")
    return field


def _encode_varint(value: int) -> bytes:
    groups = []
    while value > 0x7F:
        groups.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*groups, value])
