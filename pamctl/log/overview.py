"""Summarise a log of any length in bounded memory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from pamctl.log.annotate.annotation import ANNOTATION, Annotation
from pamctl.log.changed_gains import CHANGES, describe_running_changes
from pamctl.log.contents import Contents
from pamctl.log.framing import LogError
from pamctl.log.reader import scan_log
from pamctl.log.schema import CUT, EVENT_TOPIC, GAINS_TOPIC, IMPORTED
from pamctl.log.ticks import TickBatch
from pamctl.signals import Phase


def info(path: str | Path) -> dict[str, Any]:
    """Summarise the undamaged part of a log; raise LogError if there is none."""
    path = Path(path)
    ticks = _Tally()
    contents = Contents((), ticks.take, ("tick", "t_s", "phase"))
    damage = scan_log(path, contents)
    if damage is not None and not contents.metadata:
        raise LogError(f"{path} is not a log, or nothing in it can be read: {damage}")
    run, origin = contents.metadata.get("run", {}), contents.metadata.get("pamctl", {})
    size = path.stat().st_size
    config: dict[str, Any] = {}
    with suppress(LogError):
        config = contents.config()
    events = contents.values[EVENT_TOPIC]
    said = Annotation.from_metadata(contents.metadata.get(ANNOTATION, {}))
    return {
        "path": str(path),
        "complete": damage is None,
        "damage": damage and str(damage),
        "bytes": size,
        "bytes_per_tick": size / ticks.count if ticks.count else None,
        "ticks": ticks.count,
        "duration_s": ticks.last_t_s - ticks.first_t_s,
        "gaps": ticks.gaps,
        "missed_ticks": ticks.missed,
        "phases": ticks.phases(),
        "channels": dict(contents.counts),
        "origin": IMPORTED if contents.is_imported else "recorded",
        "source": contents.metadata.get("import", {}).get("source"),
        "cut_from": _describe_cut(contents.metadata.get(CUT)),
        **{key: run.get(key) for key in ("law", "controller", "experiment", "plant", "backend")},
        **asdict(said),
        "tags": list(said.tags),
        CHANGES: run.get(CHANGES),
        "gains_while_running": describe_running_changes(contents.values[GAINS_TOPIC]),
        "seed": config.get("seed"),
        "timing_setup": dict(contents.metadata.get("timing_setup", {})),
        **{key: origin.get(key) for key in ("version", "host")},
        "start": None if contents.is_imported else origin.get("start"),
        "outcome": next((e for e in reversed(events) if e.get("event") == "outcome"), None),
    }


def _describe_cut(cut: Mapping[str, str] | None) -> str | None:
    if cut is None:
        return None
    rows = f"rows {cut['first_row']} to {cut['last_row']} of {cut['source_rows']}"
    return f"{cut['source']}, {rows}, {float(cut['from_s']):.6g} to {float(cut['to_s']):.6g} s"


class _Tally:
    """The summary of the ticks, updated batch by batch."""

    def __init__(self) -> None:
        self.count = self.gaps = self.missed = 0
        self.first_t_s = self.last_t_s = 0.0
        self._last_tick: int | None = None
        self._phases: Counter[int] = Counter()

    def take(self, batch: TickBatch) -> None:
        if not len(batch.log_time_ns):
            return
        tick, t_s = batch.columns["tick"], batch.columns["t_s"]
        before = tick[0] - 1 if self._last_tick is None else self._last_tick
        skipped = np.diff(tick, prepend=before) - 1
        if self.count == 0:
            self.first_t_s = float(t_s[0])
        self.count += len(tick)
        self.gaps += int(np.count_nonzero(skipped))
        self.missed += int(skipped.sum())
        self._last_tick, self.last_t_s = int(tick[-1]), float(t_s[-1])
        if "phase" in batch.columns:
            phases, counts = np.unique(batch.columns["phase"], return_counts=True)
            self._phases.update(dict(zip(phases.tolist(), counts.tolist(), strict=True)))

    def phases(self) -> dict[str, int]:
        """Return the number of ticks in each phase."""
        names = {phase.value: phase.name.lower() for phase in Phase}
        return {names.get(p, str(p)): count for p, count in sorted(self._phases.items())}
