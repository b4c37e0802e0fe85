"""The log's channels: ticks as protobuf, everything else as JSON.

A tick is the proto3 message `pamctl.Tick` with one `optional` field of fixed width for each
column. Field numbers are the positions of the columns. Each log carries its own descriptor, so
that a reader of another version finds values by name.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence

from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)

from pamctl.base.texts import to_json
from pamctl.signals import Field

SCHEMA_VERSION = 1
"""Increased whenever `TICK_FIELDS` changes."""

TICK_TOPIC = "/pam/tick"
EVENT_TOPIC = "/pam/event"
GAINS_TOPIC = "/pam/gains"
KEYFRAME_TOPIC = "/pam/keyframe"
TICK_MESSAGE = "pamctl.Tick"

CUT = "cut"
"""Name of the metadata record that says of what a log is a piece."""
IMPORTED = "imported"
"""Value of `origin` in the tick channel's metadata if another system measured the data.

Such a log has the columns of `imported_fields` and no others, an empty configuration, and the
metadata record `import`: the source, how its columns were read, and what was wrong with them.
"""
IMPORTED_QUANTITIES = ("valve_v", "pressure_pa", "position_m", "force_n")
"""The quantities that an imported log may hold beside time, in the order of the columns."""


def imported_fields(quantities: Collection[str]) -> tuple[Field, ...]:
    """Return the columns of an imported log with these quantities.

    `valve_v` is the command as really applied. `tick` counts nominal periods, so that a gap is
    counted in `missed` as in a log of pamctl.
    """
    grid = (Field("tick", int, "timing"), Field("t_s", float, "timing"))
    steps = (Field("dt_s", float, "timing"), Field("missed", int, "timing"))
    present = (name for name in IMPORTED_QUANTITIES if name in quantities)
    return (*grid, *steps, *(Field(name, float, "measurement") for name in present))


_PROTO_TYPES: dict[type, FieldDescriptorProto.Type.ValueType] = {
    float: FieldDescriptorProto.TYPE_DOUBLE,
    int: FieldDescriptorProto.TYPE_SFIXED64,
    bool: FieldDescriptorProto.TYPE_BOOL,
}

_UNIT = re.compile(r"_(m|s|ns|v|pa|n|kg|hz|rad|counts)(?:_per_(m|s|v)([23])?)?$")
_SYMBOLS = {"v": "V", "pa": "Pa", "n": "N", "hz": "Hz"}


def tick_descriptor(fields: Sequence[Field]) -> bytes:
    """Return the serialised FileDescriptorSet of `pamctl.Tick` with these columns."""
    message = DescriptorProto(name="Tick")
    for index, field in enumerate(fields):
        message.oneof_decl.add(name=f"_{field.name}")
        message.field.add(
            name=field.name,
            number=index + 1,
            type=_PROTO_TYPES[field.kind],
            label=FieldDescriptorProto.LABEL_OPTIONAL,
            proto3_optional=True,
            oneof_index=index,
        )
    file = FileDescriptorProto(
        name="pamctl/tick.proto", package="pamctl", syntax="proto3", message_type=[message]
    )
    return FileDescriptorSet(file=[file]).SerializeToString(deterministic=True)


def unit_of_column(name: str) -> str:
    """Return the unit that the suffix of a name states; `1` for a number without a unit."""
    suffix = _UNIT.search(name)
    if suffix is None:
        return "1"
    unit, divisor, power = suffix.groups(default="")
    top, bottom = _SYMBOLS.get(unit, unit), _SYMBOLS.get(divisor, divisor)
    exponent = f"^{power}" if power else ""
    return f"{top}/{bottom}{exponent}" if divisor else top


def units_of_columns(fields: Sequence[Field]) -> dict[str, str]:
    """Return the unit of each column."""
    return {field.name: unit_of_column(field.name) for field in fields}


_WHERE = {
    "tick": {"type": "integer", "description": "The tick it belongs to; /pam/tick has the rest."},
    "t_ns": {"type": "integer", "description": "The rig's monotonic clock.", "x-unit": "ns"},
    "row": {"type": "integer", "description": "Unique within the run, and rising."},
}
_NUMBER = {"anyOf": [{"type": "number"}, {"enum": ["nan", "inf", "-inf"]}]}


def _build_json_schema(title: str, description: str, properties: Mapping[str, object]) -> bytes:
    return to_json(
        {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            "title": title,
            "description": description,
            "type": "object",
            "properties": {**_WHERE, **properties},
            "required": [*_WHERE, *properties],
        }
    )


JSON_SCHEMAS: dict[str, tuple[str, bytes]] = {
    EVENT_TOPIC: (
        "pamctl.Event",
        _build_json_schema("Event", "What happened, when it did.", {"event": {"type": "string"}}),
    ),
    GAINS_TOPIC: (
        "pamctl.Gains",
        _build_json_schema("Gains", "The law's gains, whenever they change.", {}),
    ),
    KEYFRAME_TOPIC: (
        "pamctl.Keyframe",
        _build_json_schema(
            "Keyframe",
            "Frozen state, after this tick, from which a replay can start.",
            {"state": {"type": "object", "additionalProperties": _NUMBER}},
        ),
    ),
}
"""Name and JSON schema of each topic beside the ticks."""
