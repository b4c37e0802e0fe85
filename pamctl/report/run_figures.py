"""The figures of a run: tracking beside Table IV, and timing."""

from __future__ import annotations

import math
from typing import Any

from pamctl.log.reader import Log
from pamctl.simulate.merit import TABLE_IV, Merit, compute_log_merits, summarise_timing

FIGURE_FIELDS = (
    *("t_s", "phase", "missed", "reference_m"),
    *("position_m", "corrected_position_m", "true_position_m"),
    *("late_s", "read_s", "compute_s", "write_s"),
)
"""The columns of a log that `summarise_run` needs."""


def summarise_run(log: Log, experiment: str | None) -> dict[str, Any]:
    """Return the figures of a run as one JSON document: SI, None for what is not known.

    `experiment` is the shipped experiment to compare with Table IV; None if it was another one,
    or changed.
    """
    return {
        "ticks": len(log),
        "missed_ticks": int(log["missed"].sum()),
        "readonly": is_readonly(log),
        "tracking": {name: _plain_merit(m) for name, m in compute_log_merits(log).items()},
        "paper": [
            {"law": row.law, **_plain_merit(row.merit)}
            for row in TABLE_IV
            if row.experiment == experiment
        ],
        "timing": None
        if is_fast(log)
        else {name: spread._asdict() for name, spread in summarise_timing(log).items()},
        "not_real_time": refused_steps(log),
    }


def refused_steps(log: Log) -> dict[str, str]:
    """Return the real-time measures that were refused, each with what would permit it."""
    setup = log.metadata.get("timing_setup", {})
    refused = "not done: "
    return {k: v.removeprefix(refused) for k, v in setup.items() if v.startswith(refused)}


def is_fast(log: Log) -> bool:
    """Return whether the run had no clock."""
    return bool(log.config.get("fast"))


def is_readonly(log: Log) -> bool:
    """Return whether the run was read-only, with its output at the safe voltage."""
    return bool(log.config.get("readonly"))


def _plain_merit(merit: Merit | None) -> dict[str, Any]:
    if merit is None:
        return dict.fromkeys(Merit._fields)
    return {name: None if math.isnan(v) else v for name, v in merit._asdict().items()}


def format_run_summary(figures: dict[str, Any], law: str) -> str:
    """Lay the figures out for a terminal."""
    return "\n".join([*_format_tracking(figures, law), *_format_timing(figures)])


def _format_tracking(figures: dict[str, Any], law: str) -> list[str]:
    if figures["readonly"]:
        return ["Read only: the output stayed at the safe voltage; nothing was tracked."]
    rows = [
        (f"{law}, {name} displacement", merit)
        for name, merit in figures["tracking"].items()
        if merit["max_m"] is not None
    ]
    if not rows:
        return ["Nothing was tracked in this run."]
    rows += [(f"paper, {row['law']} on its rig", row) for row in figures["paper"]]
    width = max(30, *(len(name) + 2 for name, _ in rows))
    head = f"{'tracking error':<{width}}{'max um':>10}{'RMS um':>10}{'steady um':>11}"
    return [head, *(f"{name:<{width}}{_format_micrometres(m)}" for name, m in rows)]


def _format_micrometres(merit: dict[str, Any]) -> str:
    cells = zip(merit_fields(merit), (10, 10, 11), strict=True)
    return "".join(f"{'-':>{w}}" if v is None else f"{v * 1e6:>{w}.1f}" for v, w in cells)


def merit_fields(merit: dict[str, Any]) -> list[float | None]:
    """Return max, RMS and steady-state error of a row."""
    return [merit[name] for name in Merit._fields]


_TIMING_NAMES = {
    "wake_up": "wake-up behind deadline",
    "tick": "tick, sample to command",
    "period_work": "read, tick and write",
}


def _format_timing(figures: dict[str, Any]) -> list[str]:
    missed = f"{figures['ticks']} ticks, {figures['missed_ticks']} missed"
    if figures["timing"] is None:
        return ["", f"{missed}; simulated without a clock"]
    head = f"{'timing':<30}{'p50 us':>10}{'p99 us':>10}{'max us':>11}"
    lines = [
        f"{label:<30}{t['p50_s'] * 1e6:>10.1f}{t['p99_s'] * 1e6:>10.1f}{t['max_s'] * 1e6:>11.1f}"
        for name, label in _TIMING_NAMES.items()
        for t in [figures["timing"][name]]
    ]
    refused = [
        f"not real time: {step} refused: {reason}"
        for step, reason in figures["not_real_time"].items()
    ]
    return ["", head, *lines, missed, *refused]
