"""One row of the index: what a log says of its run, and how well the run tracked."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from pamctl.base.errors import EMERGENCY_STOP, ExitCode
from pamctl.base.texts import clean_text, escape_name, flatten_keys
from pamctl.log.framing import LogError
from pamctl.log.reader import Scan
from pamctl.log.run_meta import ANNOTATION, Annotation, bare_name
from pamctl.log.schema import EVENT_TOPIC, TICK_TOPIC
from pamctl.offline.merit import NO_MERIT, compute_log_merits
from pamctl.safety import explain_verdicts

ENDINGS = {
    ExitCode.OK: "ok",
    ExitCode.SAFETY_TRIP: "trip",
    ExitCode.OVERRUNS: "overruns",
    ExitCode.SIGINT: "stopped",
    ExitCode.SIGTERM: "stopped",
    ExitCode.SIGHUP: "stopped",
}
"""The ending of a run in one word; every other code is `failed`."""
UNFINISHED, UNREADABLE, IMPORTED, FAILED = "unfinished", "unreadable", "imported", "failed"
ESTOP = "estop"
"""A safety trip that someone asked for."""
ENDING_WORDS = tuple(
    dict.fromkeys([*ENDINGS.values(), ESTOP, FAILED, UNFINISHED, IMPORTED, UNREADABLE])
)

_FIELDS = (
    "t_s", "phase", "position_m", "corrected_position_m", "reference_m", "missed", "verdicts",
)  # fmt: skip
_STAMP = re.compile(r"^(\d{8}-\d{6})")
_OWN_CLOCK_S = 86400.0 * 365
"""A start before 1971 is that of a run without a clock."""
_MOST_MARKS = 200


@dataclass(frozen=True)
class RunRow:
    """What the index knows of a log. Errors in um, of measured displacement against reference.

    A number that is not known is None.
    """

    path: str
    """Name of the file in the folder."""
    size: int
    mtime_ns: int
    when_s: float = 0.0
    """Start of the run in seconds since the epoch. A run without a clock does not know it: then
    the date in the file's name, else the file's own date."""
    law: str = ""
    controller: str = ""
    experiment: str = ""
    plant: str = ""
    rig: str = ""
    backend: str = ""
    ending: str = UNREADABLE
    """One of `ENDING_WORDS`."""
    exit_code: int | None = None
    reason: str = ""
    """Why it ended; of a damaged log what the damage is."""
    ticks: int = 0
    duration_s: float = 0.0
    missed: int | None = None
    max_um: float | None = None
    rms_um: float | None = None
    steady_um: float | None = None
    verdicts: str = ""
    """Clips and trips of the safety rules, one clause each."""
    tags: tuple[str, ...] = ()
    note: str = ""
    operator: str = ""
    sample: str = ""
    marks: str = ""
    """The remarks of the run, one behind the other."""
    gains: Mapping[str, Any] = field(default_factory=dict)
    """Settings of controller and experiment, and the seed, by dotted key."""


def read_row(path: Path) -> RunRow:
    """Read a log, whatever state it is in: what cannot be read is said in `reason`.

    Raise OSError if the file has gone.
    """
    stat = path.stat()
    bare = RunRow(path.name, stat.st_size, stat.st_mtime_ns, when_s=_date_file(path, stat.st_mtime))
    try:
        scan = Scan(path, (TICK_TOPIC, EVENT_TOPIC), _FIELDS).run()
        if scan.ticks is None:
            damage = scan.damage
            why = f"it has no ticks: {damage}" if damage else f"it has no channel {TICK_TOPIC}"
            return replace(bare, reason=why)
        return _describe_run(bare, scan)
    except LogError as error:
        return replace(bare, reason=escape_name(str(error)))
    # A foreign file may be wrong in any way; it must not hide the others.
    except Exception as error:
        return replace(bare, reason=escape_name(f"{type(error).__name__}: {error}"))


def _describe_run(bare: RunRow, scan: Scan) -> RunRow:
    run, said = scan.metadata.get("run", {}), scan.metadata.get(ANNOTATION, {})
    events = scan.values[EVENT_TOPIC]
    marks = [clean_text(str(e.get("text", ""))) for e in events if e.get("event") == "mark"]
    config: dict[str, Any] = {}
    with suppress(LogError):
        config = scan.config()
    words: dict[str, Any] = {key: bare_name(clean_text(run.get(key, ""))) for key in _NAMES}
    row = replace(bare, **words, **_measure(scan.columns()), **_judge_ending(scan))
    annotation = Annotation.from_metadata(said)
    return replace(
        row,
        when_s=_find_start_s(scan, bare.when_s),
        tags=annotation.tags,
        note=annotation.note,
        operator=annotation.operator,
        sample=annotation.sample,
        marks="; ".join(marks[:_MOST_MARKS]),
        gains=_collect_gains(config),
    )


_NAMES = ("law", "controller", "experiment", "plant", "rig", "backend")


def _measure(columns: Mapping[str, Any]) -> dict[str, Any]:
    t_s = columns.get("t_s", np.zeros(0))
    found: dict[str, Any] = {"ticks": len(t_s)}
    if len(t_s):
        found["duration_s"] = float(t_s[-1] - t_s[0])
    if "missed" in columns:
        found["missed"] = int(columns["missed"].sum())
    if "verdicts" in columns and len(t_s):
        bits = int(np.bitwise_or.reduce(columns["verdicts"].astype(np.int64)))
        found["verdicts"] = "; ".join(explain_verdicts(bits))
    merit = compute_log_merits(columns).get("measured") or NO_MERIT
    for name, value_m in merit.as_dict().items():
        if value_m is not None:
            found[name.replace("_m", "_um")] = 1e6 * value_m
    return found


def _judge_ending(scan: Scan) -> dict[str, Any]:
    if scan.damage:
        return {"ending": UNFINISHED, "reason": str(scan.damage)}
    if scan.is_imported:
        return {"ending": IMPORTED}
    outcome = scan.outcome
    if outcome is None:
        return {"ending": UNFINISHED, "reason": "the log does not say how the run ended"}
    code = int(outcome["code"])
    reason = clean_text(str(outcome.get("reason", "")))
    is_estop = code == ExitCode.SAFETY_TRIP and reason.startswith(EMERGENCY_STOP)
    ending = ESTOP if is_estop else ENDINGS.get(ExitCode(code), FAILED)
    return {"exit_code": code, "reason": reason, "ending": ending}


def _find_start_s(scan: Scan, otherwise_s: float) -> float:
    start = scan.metadata.get("pamctl", {}).get("start", "")
    with suppress(ValueError):
        began = datetime.fromisoformat(start)
        began_s = (began if began.tzinfo else began.replace(tzinfo=UTC)).timestamp()
        if began_s > _OWN_CLOCK_S and not scan.is_imported:
            return began_s
    return otherwise_s


def _date_file(path: Path, mtime_s: float) -> float:
    if stamp := _STAMP.match(path.name):
        with suppress(ValueError):
            return datetime.strptime(f"{stamp[1]}+0000", "%Y%m%d-%H%M%S%z").timestamp()
    return mtime_s


def _collect_gains(config: Mapping[str, Any]) -> dict[str, Any]:
    kept = {name: config[name] for name in ("controller", "experiment", "seed") if name in config}
    return {
        key: clean_text(value) if isinstance(value, str) else value
        for key, value in flatten_keys(kept)
        if isinstance(value, str | int) or (isinstance(value, float) and math.isfinite(value))
    }


def find_varying_keys(rows: Sequence[RunRow]) -> list[str]:
    """Return the settings whose values differ, in the order of the file.

    The seed is left out: it differs between repeats.
    """
    keys = dict.fromkeys(key for row in rows for key in row.gains if key != "seed")
    return [key for key in keys if len({row.gains.get(key) for row in rows} - {None}) > 1]
