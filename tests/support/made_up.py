"""Made-up runs: ticks with a known value in every column, and a recorder to log them."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from subprocess import Popen
from typing import Any, get_type_hints

from pamctl.log.run_meta import RunMeta
from pamctl.recording.recorder import await_recorder, spawn_recorder
from pamctl.recording.ring import Ring, RingFull
from pamctl.signals import TICK_FIELDS, TICK_STAGES, TickRecord
from support.patience import PATIENCE_S
from support.runs import pack_row

PERIOD_NS = 1_000_000
START_WALL_NS = 1_700_000_000_000_000_000
START_MONO_NS = 5_000_000_000


_STAGES = tuple(
    (signals, tuple(get_type_hints(signals).values())) for signals in TICK_STAGES.values()
)


@cache
def tick(index: int) -> TickRecord:
    """Return a tick whose columns differ from each other and from tick to tick, but for time."""
    made: Any = (
        signals._make(
            _value(kind, index, 10 * stage + position) for position, kind in enumerate(kinds)
        )
        for stage, (signals, kinds) in enumerate(_STAGES)
    )
    record = TickRecord(*made)
    return record._replace(
        timing=record.timing._replace(tick=index, t_s=index * 1e-3, dt_s=1e-3, missed=0),
        raw=record.raw._replace(encoder_t_ns=START_MONO_NS + index * PERIOD_NS),
        reference=record.reference._replace(phase=2),
    )


def _value(kind: type, index: int, column: int) -> Any:
    if kind is bool:
        return (index + column) % 3 == 0
    if kind is int:
        return index * 100 + column - 5_000
    return math.sin(0.01 * index + column) * (column % 7 + 1)


def columns(record: TickRecord) -> dict[str, Any]:
    """Return the columns of a tick by name."""
    values = (value for stage in record if stage is not None for value in stage)
    return {field.name: value for field, value in zip(TICK_FIELDS, values, strict=True)}


def meta(log: Path, **changes: Any) -> RunMeta:
    """Return what is known of a made-up run that is logged at `log`."""
    known = {
        "log_path": str(log),
        "start_wall_ns": START_WALL_NS,
        "start_mono_ns": START_MONO_NS,
        "config": {"controller": {"law": "qsmc", "lambda_per_s": 10.0}, "limit": math.inf},
        "attachments": {"config.yaml": "law: qsmc\n", "filters.json": "{}"},
        "metadata": {"run": {"law": "qsmc", "backend": "sim", "experiment": "experiment2"}},
        "keyframe_fields": ("lpf1_a", "lpf1_b", "integral"),
    }
    return RunMeta(**{**known, **changes})


def put(ring: Ring, ticks: Iterable[int], *, patience_s: float = PATIENCE_S) -> None:
    """Put ticks, waiting for room as a run without a clock does."""
    deadline = time.monotonic() + patience_s
    for index in ticks:
        record = tick(index)
        while True:
            try:
                ring.put_row(pack_row(record))
                break
            except RingFull:
                if time.monotonic() > deadline:
                    raise
                time.sleep(1e-3)
        ring.loop_beat_ns = time.monotonic_ns()


@contextmanager
def recording(ring: Ring) -> Iterator[Popen[bytes]]:
    """Run a real recorder on the ring; end it, one way or another, with the block."""
    process = spawn_recorder(ring.path)
    try:
        await_recorder(ring, process)
        yield process
    finally:
        process.kill()
        end(process)


def end(process: Popen[bytes], timeout_s: float = PATIENCE_S) -> tuple[int, str]:
    """Wait for the recorder; return its exit code and what it said on stderr."""
    code = process.wait(timeout_s)
    assert process.stdin is not None
    assert process.stderr is not None
    said = "" if process.stderr.closed else process.stderr.read().decode()
    process.stdin.close()
    process.stderr.close()
    return code, said


def log_run(ring_path: Path, log: Path, ticks: int, rows: int = 4096, **changes: Any) -> Path:
    """Log a short run with a real recorder, an event, gains and a keyframe; return the log."""
    with Ring.create(ring_path, meta(log, **changes), rows) as ring, recording(ring) as process:
        ring.put_event(0, START_MONO_NS, {"event": "timing_setup", "fifo": True, "phase_us": 300})
        ring.put_gains(0, START_MONO_NS, {"lambda_per_s": 10.0})
        put(ring, range(ticks))
        ring.put_keyframe(ticks - 1, START_MONO_NS, (1.0, math.nan, -math.inf))
        ring.put_event(ticks - 1, START_MONO_NS, {"event": "outcome", "reason": "done"})
        ring.loop_done = 1
        code, said = end(process)
        ring.unlink()
    assert (code, said) == (0, "")
    return log
