"""Read what is said of a run without its ticks, and without numpy: the daemon does it too."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Metadata

from pamctl.log.annotate.annotation import ANNOTATION, Annotation
from pamctl.log.framing import (
    Damage,
    LogError,
    map_log_file,
    translate_parse_errors,
    walk_records,
)

__all__ = ["LogError", "read_annotation"]


def read_annotation(path: Path) -> Annotation:
    """Return what is said of a run, from its metadata alone; raise LogError if it is no log.

    A log that is not finished says what stands before its end.
    """
    values: Mapping[str, str] = {}
    try:
        for record in walk_records(map_log_file(path)):
            if record.opcode == Opcode.METADATA:
                with translate_parse_errors(record):
                    metadata = Metadata.read(record.stream())
                values = metadata.metadata if metadata.name == ANNOTATION else values
    except Damage as damage:
        if damage.offset == 0:
            raise LogError(f"{path} is not a log: {damage}") from damage
    return Annotation.from_metadata(values)
