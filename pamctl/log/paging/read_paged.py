"""Read a log as `pamctl.log.read` does, but leave its ticks in the file.

One pass verifies every checksum and keeps all but the ticks. A page of ticks is decoded where it
is asked for, so that an hour needs no more memory than a minute.
"""

from __future__ import annotations

from pathlib import Path

from mcap.opcode import Opcode

from pamctl.log.contents import Contents
from pamctl.log.framing import (
    Damage,
    LogError,
    map_log_file,
    record_at,
    release_pages,
    unpack_chunk,
)
from pamctl.log.paging.grid_rows import GridRows
from pamctl.log.paging.pages import PAGE_TICKS, WALL_TIME, Page, Pages
from pamctl.log.reader import Log, build_log, fill_contents, read
from pamctl.log.ticks import TickBatch, TickColumns, TickDecoder


def read_paged(path: str | Path) -> Log:
    """Read a log whose columns stay in the file; raise LogError as `read` does.

    A column is read as `column[i]`, `column[a:b]` or `np.asarray(column)`. The file must stay as
    it is while the log is in use.
    """
    path = Path(path)
    found = _Survey()
    contents = found.contents
    fill_contents(path, contents)
    if found.has_loose_ticks:  # in no chunk: another program wrote them
        return read(path)
    assert contents.ticks is not None
    decoder = _PageDecoder(path, contents, found.chunks)
    pages = Pages(contents.ticks.none, found.rows, found.grid, decoder.decode)
    return build_log(path, contents, pages, pages.time_ns)


class _Survey:
    """Takes the ticks of a first pass: notes where they are, and forgets them."""

    def __init__(self) -> None:
        self.contents = Contents((), self._take, ("tick", "missed"))
        self.grid = GridRows()
        self.has_loose_ticks = False
        self.rows: list[int] = []
        """The first row of each page."""
        self.chunks: list[list[int]] = []
        """Where the chunks of each page begin in the file."""
        self._count = 0

    def _take(self, batch: TickBatch) -> None:
        at = self.contents.chunk_at
        self.has_loose_ticks |= at < 0
        if not self.rows or (
            at != self.chunks[-1][-1] and self._count - self.rows[-1] >= PAGE_TICKS
        ):
            self.rows.append(self._count)
            self.chunks.append([at])
        elif at != self.chunks[-1][-1]:
            self.chunks[-1].append(at)
        self._count += len(batch.log_time_ns)
        self.grid.take(batch.columns["tick"], batch.columns["missed"])


class _PageDecoder:
    """Decodes the ticks of a page."""

    def __init__(self, path: Path, contents: Contents, chunks: list[list[int]]) -> None:
        self._path, self._file, self._chunks = path, map_log_file(path), chunks
        self._channel = contents.tick_channel
        schema = contents.schemas[contents.channels[self._channel].schema_id]
        self._decoder = TickDecoder(schema, self._take)
        self._ticks = TickColumns()

    def _take(self, batch: TickBatch) -> None:
        self._ticks.take(batch)

    def decode(self, number: int) -> Page:
        """Return the columns of a page; raise LogError if the file is not what it was."""
        self._ticks = TickColumns()
        try:
            for at in self._chunks[number]:
                self._take_chunk(at)
        except Damage as damage:
            raise LogError(f"{self._path} was changed while it was read: {damage}") from damage
        return {
            **self._ticks.columns(self._decoder.none),
            WALL_TIME: self._ticks.times(),
        }

    def _take_chunk(self, at: int) -> None:
        record = record_at(self._file, at)
        chunk, at = unpack_chunk(record), 0
        release_pages(self._file, record.start, record.end)
        while at < len(chunk):
            inside = record_at(chunk, at)
            is_tick = inside.opcode == Opcode.MESSAGE and self._channel == int.from_bytes(
                inside.body[:2], "little"
            )
            at = self._decoder.run(chunk, inside)[1] if is_tick else inside.end
