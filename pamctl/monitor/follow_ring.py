"""The measured signals of a run while it goes on, from its ring; the run does not notice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pamctl.log.measured_signals import Signals, signals
from pamctl.log.reader import Log
from pamctl.recording.ring import Ring
from pamctl.recording.rows import RowKind, row_dtype

_BEFORE = 4
"""Ticks before the new ones that are read again: a delayed output is that of an earlier tick."""


class RingFollower:
    """Reads what is new in a ring. The rows must be asked for before a quarter of it is full."""

    def __init__(self, path: Path) -> None:
        """Attach; raise `RingError` if there is no such ring."""
        self._ring = Ring.watch(path)
        self._row = row_dtype(self._ring.meta.tick_fields)
        self._next_row = self._ring.head
        self._before: NDArray[np.void] = np.zeros(0, self._row)

    @property
    def is_over(self) -> bool:
        """The loop has put its last row."""
        return bool(self._ring.loop_done)

    @property
    def period_s(self) -> float:
        """The loop's period."""
        rate_hz = self._ring.meta.config.get("rig", {}).get("loop", {}).get("rate_hz", 1000.0)
        return 1.0 / float(rate_hz)

    @property
    def longest_wait_s(self) -> float:
        """The longest time between two calls of `read` in which no row is lost, and half of it."""
        return 0.5 * self._ring.rows / 4 * self.period_s

    def read(self) -> tuple[Signals, float] | None:
        """Return the new signals, and the monotonic time of the first (s); None if there is none.

        Raises `LogError` where the log will have no calibration of the valve.
        """
        batch = self._ring.copy_recent(self._next_row)
        if batch.first_row != self._next_row:
            self._before = self._before[:0]  # rows were lost
        self._next_row = batch.end_row
        rows = np.frombuffer(batch.data, self._row)
        rows = rows[rows["kind"] == RowKind.TICK]
        if not len(rows):
            return None
        together = np.concatenate([self._before, rows])
        fresh = slice(len(self._before), None)
        self._before = together[-_BEFORE:]
        return signals(self._make_log(together))[fresh], float(rows["t_ns"][0]) * 1e-9

    def _make_log(self, rows: NDArray[np.void]) -> Log:
        meta = self._ring.meta
        return Log(
            path=Path(meta.log_path),
            columns={f.name: rows["columns"][f.name].copy() for f in meta.tick_fields},
            time_ns=rows["t_ns"].astype(np.uint64),
            units={},
            events=[],
            gains=[],
            keyframes=[],
            config=dict(meta.config),
            attachments={},
            metadata=meta.metadata,
            counts={},
            is_imported=False,
        )

    def close(self) -> None:
        """Detach."""
        self._ring.close()
