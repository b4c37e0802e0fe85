"""What a replay found, as a report: the first difference, then all of them; and a what-if's."""

from __future__ import annotations

import math
import platform
from collections.abc import Iterator
from typing import Any

from pamctl import __version__
from pamctl.base.texts import count_of
from pamctl.log import Log
from pamctl.log.schema import unit_of_column
from pamctl.offline.tick_replay import (
    OTHER_CPU,
    OTHER_CPU_NAME,
    Difference,
    Replay,
    are_within_tolerance,
)
from pamctl.offline.what_if import WhatIf
from pamctl.report.report import Facts, Report, ReportTable, Text
from pamctl.safety import explain_verdicts
from pamctl.settings.resolve import RunSettings
from pamctl.signals import TICK_FIELDS, Phase


def report_replay(found: Replay, tolerance: str | None) -> Report:
    """Return one sentence if all is equal; else the first difference, then all fields'."""
    log = found.recording.log
    if not found.differences:
        of = f"{count_of(len(found.fields), 'field')}, {found.speed:.0f} x real time"
        verdict = f"{log.path}: equal, {count_of(found.ticks, 'tick')}, {of}"
        if not found.is_equal:
            whole = found.ticks + found.skipped
            verdict = (
                f"{log.path}: not whole, {found.ticks} of {whole} ticks were replayed and do not "
                f"differ, {of}"
            )
        report = Report(f"Replay of {log.path}", verdict)
    else:
        first = found.differences[0]
        at, logged, replayed = first.first
        report = Report(
            f"Replay of {log.path}",
            f"{log.path}: differs from tick {_tick(found, at)} on (t = {log.t[at]:.3f} s, "
            f"{_phase(found, at)}), first in {first.place.stage}: {first.place.name}",
        )
        values = {"logged": logged, "replayed": replayed}
        report.add(Facts({which: _format_value(first, value) for which, value in values.items()}))
        rows = [_list_cells(found, difference) for difference in found.differences]
        report.add(ReportTable(("stage", "field", "from tick", "ticks", "by up to"), rows))
        differing = {difference.place.stage for difference in found.differences}
        same = [s for s in dict.fromkeys(f.stage for f in found.fields) if s not in differing]
        report.add(*[Text(f"equal: {', '.join(same)}")] * bool(same))
        made = _maker(found)
        this = f"pamctl {__version__} on {platform.machine()}"
        report.add(Text(f"made by pamctl {made['version']} on {made['machine']}; this is {this}"))
        if are_within_tolerance(OTHER_CPU, found.differences):
            report.add(
                Text(
                    "no more than the rounding of another CPU or C library: "
                    f"compare with --tolerance {OTHER_CPU_NAME}"
                )
            )
    report.document = _make_document(found, tolerance)
    return report.add(*map(Text, _list_limits(found)))


def _list_cells(found: Replay, difference: Difference) -> list[str]:
    stage, name = difference.place
    size = f"{difference.largest:.2g} {_unit(name)}".rstrip()
    if name in _CODES or math.isinf(difference.largest):  # or no number in one of the two
        size = "-"
    return [stage, name, str(_tick(found, difference.first.tick)), str(difference.ticks), size]


_FLAGS = [field.name for field in TICK_FIELDS if field.kind is bool]
_CODES = [*_FLAGS, "verdicts", "phase"]


def _format_value(difference: Difference, value: float) -> str:
    """Write a value to its last bit, a code by its meaning."""
    name = difference.place.name
    if name == "verdicts":
        return "; ".join(explain_verdicts(int(value))) or "no verdict"
    if name == "phase" and value >= 0:
        return _name_phase(int(value))
    if name in _FLAGS:
        return "yes" if value else "no"
    return f"{value!r} {_unit(name)}".rstrip()


def _unit(name: str) -> str:
    unit = unit_of_column(name)
    return "" if unit == "1" else unit


def _list_limits(found: Replay) -> Iterator[str]:
    """Say what was not compared, and why."""
    if found.begin:
        yield f"from tick {_tick(found, found.begin)}, with the frozen state before it"
    if cut := found.recording.cut:
        origin = f"cut from {cut['source']}, rows {cut['first_row']} to {cut['last_row']}"
        yield (
            f"{origin}: its first {found.begin} ticks have no frozen state before them, "
            "so filters and law are unknown there, and they are not replayed"
            if found.begin
            else f"{origin}, with the frozen state before them"
        )
    if found.recording.law_change:
        yield f"warning: {found.recording.law_change}"
    if found.absent:
        yield f"not in this log, and not compared: {', '.join(found.absent)}"
    if found.skipped:
        left_out = count_of(found.skipped, "tick")
        yield f"not replayed: {left_out} after lost ticks, up to the next frozen state"
    if found.unasked:
        unasked = count_of(found.unasked, "tick")
        yield f"reference not compared in {unasked}, because ticks before them are lost"


def _make_document(found: Replay, tolerance: str | None) -> dict[str, Any]:
    """Return the result as one JSON document; ticks are those of the loop's grid."""
    first = found.differences[0] if found.differences else None
    return {
        "schema": 1,
        "path": str(found.recording.log.path),
        "equal": found.is_equal,
        "whole": found.is_whole,
        "tolerance": tolerance,
        "from_tick": _tick(found, found.begin),
        "ticks": found.ticks,
        "skipped_ticks": found.skipped,
        "ticks_without_reference": found.unasked,
        "fields": [".".join(place) for place in found.fields],
        "fields_not_in_log": list(found.absent),
        "first": None if first is None else _describe_first(found, first),
        "differences": [
            {
                **difference.place._asdict(),
                "first_tick": _tick(found, difference.first.tick),
                "ticks": difference.ticks,
                "largest": difference.largest,
                "unit": unit_of_column(difference.place.name),
            }
            for difference in found.differences
        ],
        "cut": dict(found.recording.cut) or None,
        "law_change": found.recording.law_change or None,
        "made_by": _maker(found),
        "speed_x_real_time": found.speed,
    }


def _describe_first(found: Replay, difference: Difference) -> dict[str, Any]:
    at, logged, replayed = difference.first
    return {
        "tick": _tick(found, at),
        "t_s": float(found.recording.log.t[at]),
        "phase": _phase(found, at),
        **difference.place._asdict(),
        "unit": unit_of_column(difference.place.name),
        "logged": logged,
        "replayed": replayed,
        "around": [
            {"tick": _tick(found, pair.tick), "logged": pair.logged, "replayed": pair.replayed}
            for pair in difference.around
        ],
    }


def _maker(found: Replay) -> dict[str, str]:
    origin = found.recording.log.metadata.get("pamctl", {})
    return {name: origin.get(name, "?") for name in ("version", "machine", "python")}


def _tick(found: Replay, index: int) -> int:
    return int(found.recording.log["tick"][index])


def _phase(found: Replay, index: int) -> str:
    return _name_phase(int(found.recording.log["phase"][index]))


def _name_phase(number: int) -> str:
    return Phase(number).name.lower() if number in [*Phase] else f"phase {number}, which is none"


def report_what_if(log: Log, settings: RunSettings, law: str, answer: WhatIf) -> Report:
    """Return what another law, called `law`, would have commanded, a row each phase."""
    header = ("V", "ticks", "logged RMS", "other RMS", "diff. RMS", "diff. max")
    rows = [
        [
            row.phase,
            str(row.ticks),
            *(f"{volts:.4f}" for volts in row[2:6]),
            f"{row.logged_saturated:.1%}",
            f"{row.other_saturated:.1%}",
        ]
        for row in answer.phases
    ]
    return Report(
        f"What-if of {log.path}",
        f"what {law} would have commanded on the same samples, open loop: "
        "the muscle did not follow it",
        document={
            "schema": 1,
            "path": str(log.path),
            "what_if": True,
            "open_loop": True,
            "law": settings.controller.model_dump(mode="json"),
            "logged_law": log.config["controller"],
            "phases": [figures._asdict() for figures in answer.phases],
        },
    ).add(ReportTable((*header, "logged saturated", "other saturated"), rows))
