"""Write a log: its channels, and the description of the run."""

from __future__ import annotations

import platform
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib.metadata import version
from io import BufferedWriter
from pathlib import Path

import pamctl
from pamctl.json_text import to_json
from pamctl.log.container import Container, PackedChunk
from pamctl.log.run_meta import RunMeta
from pamctl.log.schema import (
    JSON_SCHEMAS,
    SCHEMA_VERSION,
    TICK_MESSAGE,
    TICK_TOPIC,
    tick_descriptor,
    units_of_columns,
)

LIBRARY = f"pamctl/{pamctl.__version__}"

_MEDIA_TYPES = {".json": "application/json", ".yaml": "application/yaml"}

NO_SCHEMA = ("", "", b"")


class LogWriter:
    """A log under construction. The caller opens, syncs and closes its stream."""

    def __init__(self, stream: BufferedWriter) -> None:
        """Write the file's header."""
        self._file = Container(stream, LIBRARY)
        self._schemas: dict[tuple[str, str, bytes], int] = {NO_SCHEMA: 0}
        self._channels: dict[tuple[str, int], int] = {}
        self._attached: set[str] = set()
        self._said: set[tuple[str, bytes]] = set()
        self.chunks = 0
        """Number of chunks written."""
        self.add = self._file.messages
        """`add(channel, records)`: records of equal length; their channel is overwritten."""

    def channel(
        self,
        topic: str,
        encoding: str,
        schema: tuple[str, str, bytes],
        metadata: Mapping[str, str] | None = None,
    ) -> int:
        """Return the id of a channel; register it at first use.

        `schema` is name, encoding and data, all empty for no schema.
        """
        if schema not in self._schemas:
            self._schemas[schema] = self._file.schema(*schema)
        key = (topic, self._schemas[schema])
        if key not in self._channels:
            self._channels[key] = self._file.channel(topic, encoding, key[1], metadata or {})
        return self._channels[key]

    def attachment(self, name: str, data: bytes, time_ns: int = 0, media_type: str = "") -> None:
        """Attach a file, unless one of this name is attached; the suffix gives the media type."""
        if name not in self._attached:
            self._attached.add(name)
            known = media_type or _MEDIA_TYPES.get(Path(name).suffix, "text/plain")
            self._file.attachment(name, data, time_ns, known)

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record, unless the same record was added before."""
        said = (name, to_json(values))
        if said not in self._said:
            self._said.add(said)
            self._file.metadata(name, values)

    def end_chunk(self, packed: PackedChunk | None = None) -> None:
        """Write everything added so far as a chunk, and hand it to the operating system.

        `packed` may hold the same content, compressed. Only the caller ends chunks: if the writer
        did so by size, the caller would not know which messages are in the file.
        """
        self._file.end_chunk(packed)
        self.chunks += 1

    def finish(self) -> None:
        """Write the index and the footer, and hand them to the operating system."""
        self._file.finish()


def begin_log(writer: LogWriter, meta: RunMeta) -> dict[str, int]:
    """Write the description of the run; return the channel of each topic."""
    # Readers keep one record of each name: the run's own values belong into the same record.
    said = {"pamctl": {}, **meta.metadata}
    for name, values in said.items():
        writer.metadata(name, {**_describe_origin(meta), **values} if name == "pamctl" else values)
    writer.attachment("config.json", to_json(meta.config), meta.start_wall_ns)
    for name, text in meta.attachments.items():
        writer.attachment(name, text.encode(), meta.start_wall_ns)
    tick_schema = (TICK_MESSAGE, "protobuf", tick_descriptor(meta.tick_fields))
    tick_metadata = {
        "schema_version": str(SCHEMA_VERSION),
        "units": to_json(units_of_columns(meta.tick_fields)).decode(),
        **({"origin": meta.origin} if meta.origin else {}),
    }
    return {
        TICK_TOPIC: writer.channel(TICK_TOPIC, "protobuf", tick_schema, tick_metadata),
        **{
            topic: writer.channel(topic, "json", (name, "jsonschema", schema))
            for topic, (name, schema) in JSON_SCHEMAS.items()
        },
    }


def _describe_origin(meta: RunMeta) -> dict[str, str]:
    return {
        "version": pamctl.__version__,
        "schema_version": str(SCHEMA_VERSION),
        "start": datetime.fromtimestamp(meta.start_wall_ns / 1e9, UTC).isoformat(),
        "host": platform.node(),
        "kernel": platform.release(),
        "machine": platform.machine(),
        "python": sys.version.split()[0],
        **{name: version(name) for name in ("mcap", "numpy", "protobuf")},
        **({"origin": meta.origin} if meta.origin else {}),
    }
