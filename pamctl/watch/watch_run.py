"""Follow one rig, second by second: columns in, state of both blocks out.

    ring -> columns of about a second -> signals -> record of a window -> misfits -> sums -> alarm

The sums go on from run to run; a window never reaches over a gap, nor into homing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pamctl.diagnose.record import Array, Record
from pamctl.log.measured_signals import Signals, signals
from pamctl.log.reader import Log
from pamctl.plant.model import PlantSettings
from pamctl.recording.ring import Ring
from pamctl.recording.rows import RowKind, row_dtype
from pamctl.signals import Phase
from pamctl.watch.judge_window import (
    JUDGED_S,
    RUN_IN_S,
    MisfitAlarm,
    MisfitSums,
    SensorNoise,
    WindowJudge,
    WindowMisfit,
    read_sensor_noise,
)

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


LEARN_S = 8.0
"""Measurement from which the sensors' noise is estimated, before the first window is judged."""
KEEP_S = LEARN_S + RUN_IN_S + JUDGED_S
"""Measurement that is kept for the noise and the next window."""
LONGEST_GAP_S = 0.05
"""Windows do not reach over a longer gap."""
SILENT = 5
"""Windows without excitation in a row, after which the monitor says that it cannot tell."""
BASELINE_WINDOWS = 8
"""Windows from which the rig's own floor is taken, beside the model's."""
MOST_OF_BASELINE = 1.5
"""A rig may leave this multiple of the model's floor from the first; more is a misfit."""
CHANNELS = ("pressure_pa", "position_m")


@dataclass(frozen=True)
class BlockReport:
    """What the monitor knows of one block."""

    block: str
    state: str
    """`fits`, `off`, or `cannot tell`."""
    over_floor: float
    """The newest window: misfit over its floor."""
    activity: str
    alarm: MisfitAlarm | None


class RunWatch:
    """The model of a rig against its measurement; one for the life of a daemon."""

    def __init__(self, plant: PlantSettings) -> None:
        self._plant = plant
        self._stated = {**plant.noise.stated} if plant.noise else {}
        self._noises: dict[str, SensorNoise] | None = None
        self._sums = MisfitSums()
        self._kept: deque[Record] = deque()
        """Consecutive pieces without a gap between them, on the clock of `take`."""
        self._judged_to_s = -np.inf
        self._silent: dict[str, int] = {}
        self._first_ratios: dict[str, list[float]] = {}
        self.blocks: dict[str, BlockReport] = {}
        """The newest report of each block."""
        self.windows = 0

    def begin_run(self) -> None:
        """Leave the run before; the sums and the noise are kept."""
        self._kept.clear()
        self._judged_to_s = -np.inf

    def take(self, signals: Signals, start_s: float) -> dict[str, BlockReport]:
        """Take the ticks since the last call; return the reports that changed.

        `start_s` is the time of `signals.t_s[0]` on a clock that goes on from run to run.
        """
        for piece in _cut_usable(signals, start_s):
            self._add(piece)
        if self._noises is None and not self._learn():
            return {}
        changed: dict[str, BlockReport] = {}
        while (window := self._next_window()) is not None:
            changed |= self._judge(window)
        return changed

    def _add(self, piece: Record) -> None:
        start_s = piece.t_s[0]
        if self._kept and start_s - self._kept[-1].t_s[-1] > LONGEST_GAP_S:
            self.begin_run()
        self._kept.append(piece)
        while len(self._kept) > 1 and start_s - self._kept[1].t_s[0] > KEEP_S:
            self._kept.popleft()

    def _learn(self) -> bool:
        """Estimate the noise once there is enough measurement; return whether it is known."""
        if not self._kept:
            return False
        record = _join(self._kept)
        if record.duration_s < LEARN_S:
            return False
        record = replace(record, stated_noise=self._stated)
        self._noises = {name: read_sensor_noise(record, name) for name in CHANNELS}
        return True

    def _next_window(self) -> Record | None:
        """Return the next window with its run-in, once it is whole."""
        if not self._kept:
            return None
        begin_s = max(float(self._kept[0].t_s[0]), self._judged_to_s - RUN_IN_S)
        end_s = begin_s + RUN_IN_S + JUDGED_S
        if self._kept[-1].t_s[-1] < end_s:
            return None
        record = _join([p for p in self._kept if p.t_s[-1] >= begin_s])
        a, b = np.searchsorted(record.t_s, [begin_s, end_s])
        self._judged_to_s = end_s
        return record.cut_samples(int(a), int(b), "window")

    def _judge(self, window: Record) -> dict[str, BlockReport]:
        assert self._noises is not None
        self.windows += 1
        changed = {}
        for misfit in WindowJudge(self._plant, self._noises).judge(window, self.windows):
            block = misfit.block
            misfit = self._raise_floor(misfit)
            self._sums.take(misfit, self._judged_to_s - JUDGED_S)
            self._silent[block] = 0 if misfit.shows else self._silent.get(block, 0) + 1
            alarm = self._sums.find_alarm(block)
            state = "off" if alarm else "cannot tell" if self._silent[block] >= SILENT else "fits"
            over = misfit.rms / max(misfit.floor, 1e-30)
            changed[block] = BlockReport(block, state, over, misfit.activity, alarm)
        self.blocks |= changed
        return changed

    def _raise_floor(self, misfit: WindowMisfit) -> WindowMisfit:
        """Return a misfit over the floor of this rig, as its first windows show it.

        A second of rest tells little of the slow part of a sensor's noise, and no plant file is
        exact. What is there from the first, and small, is no change.
        """
        ratios = self._first_ratios.setdefault(misfit.block, [])
        if len(ratios) < BASELINE_WINDOWS:
            ratios.append(misfit.rms / max(misfit.floor, 1e-30))
        raised = float(np.clip(np.median(ratios), 1.0, MOST_OF_BASELINE))
        excess = misfit.excess - float(np.log(raised))
        return replace(misfit, floor=raised * misfit.floor, excess=excess)


def _cut_usable(signals: Signals, start_s: float) -> list[Record]:
    """Cut signals into stretches without homing, stop ramp, failed writes and gaps."""
    if signals.valve_v is None or signals.pressure_pa is None or signals.position_m is None:
        return []
    usable = (signals.phase != Phase.HOMING) & (signals.phase != Phase.STOPPING)
    for column in (signals.valve_v, signals.pressure_pa, signals.position_m):
        usable &= np.isfinite(column)
    cuts = np.flatnonzero(
        (np.diff(usable.astype(int)) != 0) | (np.diff(signals.t_s) > LONGEST_GAP_S)
    )
    pieces = []
    for first, end in zip([0, *(cuts + 1)], [*(cuts + 1), len(usable)], strict=True):
        if end - first > 1 and usable[first]:
            part = signals[int(first) : int(end)]
            pieces.append(
                Record(
                    "piece",
                    part.t_s - signals.t_s[0] + start_s,
                    part.valve_v,
                    part.pressure_pa,
                    part.position_m,
                    acts_after_s=part.acts_after_s,
                    held_v=part.held_v,
                )
            )
    return pieces


def _join(records: Sequence[Record]) -> Record:
    def join(name: str) -> Array:
        columns = ((getattr(r, name), len(r)) for r in records)
        return np.concatenate([np.zeros(n) if c is None else c for c, n in columns])

    acts = any(record.acts_after_s is not None for record in records)
    return Record(
        "run",
        join("t_s"),
        join("valve_v"),
        join("pressure_pa"),
        join("position_m"),
        acts_after_s=join("acts_after_s") if acts else None,
        held_v=records[0].held_v,
    )
