"""What a replay found, as a report: the first difference, then the others; and a what-if's."""

from __future__ import annotations

import math
import platform
from collections.abc import Iterator, Mapping
from typing import Any

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
from pamctl.report.report import Facts, Part, Report, ReportTable, Text
from pamctl.safety import explain_verdicts
from pamctl.settings.resolve import RunSettings
from pamctl.signals import TICK_FIELDS, Phase


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


def report_replay(found: Replay, tolerance: str | None) -> Report:
    """Return one sentence if all is equal; else the first difference, then the others."""
    report = Report(
        f"Replay of {found.recording.log.path}",
        _describe_first_difference(found) if found.differences else _format_extent(found),
        document=_make_document(found, tolerance),
    )
    if found.differences:
        report.add(*_show_differences(found))
    return report.add(*map(Text, _list_limits(found)))


def _list_limits(found: Replay) -> Iterator[str]:
    """Say what was not compared, and why."""
    if found.begin:
        yield f"from tick {_tick(found, found.begin)}, with the frozen state before it"
    if cut := found.recording.cut:
        yield _describe_piece(found, cut)
    if found.recording.law_change:
        yield f"warning: {found.recording.law_change}"
    if found.absent:
        yield f"not in this log, and not compared: {', '.join(found.absent)}"
    if found.skipped:
        yield f"not replayed: {found.skipped} ticks after lost ticks, up to the next frozen state"
    if found.unasked:
        yield (
            f"reference not compared in {found.unasked} ticks, because ticks before them are lost"
        )


def _format_extent(found: Replay) -> str:
    """Say how much was replayed, and is equal."""
    of = f"{len(found.fields)} fields, {found.speed:.0f} x real time"
    if found.is_equal:
        return f"{found.recording.log.path}: equal, {found.ticks} ticks, {of}"
    left_out = f"not whole, {found.ticks} of {found.ticks + found.skipped} ticks were replayed"
    return f"{found.recording.log.path}: {left_out} and do not differ, {of}"


def _describe_piece(found: Replay, cut: Mapping[str, str]) -> str:
    """Say where a piece of a log came from, and why its law cannot run from its first tick on."""
    origin = f"cut from {cut['source']}, rows {cut['first_row']} to {cut['last_row']}"
    if not found.begin:
        return f"{origin}, with the frozen state before them"
    return (
        f"{origin}: its first {found.begin} ticks have no frozen state before them, "
        "so filters and law are unknown there, and they are not replayed"
    )


def _describe_first_difference(found: Replay) -> str:
    first, log = found.differences[0], found.recording.log
    at = first.first.tick
    return (
        f"{log.path}: differs from tick {_tick(found, at)} on (t = {log.t[at]:.3f} s, "
        f"{_phase(found, at)}), first in {first.place.stage}: {first.place.name}"
    )


def _show_differences(found: Replay) -> Iterator[Part]:
    first = found.differences[0]
    at, logged, replayed = first.first
    name = first.place.name
    values = {"logged": logged, "replayed": replayed}
    yield Facts({which: _format_value(name, value) for which, value in values.items()})
    rows = [
        [
            f"{'> ' if pair.tick == at else ''}{_tick(found, pair.tick)}",
            repr(pair.logged),
            repr(pair.replayed),
        ]
        for pair in first.around
    ]
    yield ReportTable(("tick", "logged", "replayed"), rows)
    yield from map(Text, (*_format_stages(found), *_advise(found)))


def _format_value(name: str, value: float) -> str:
    """Write a value to its last bit, a code by its meaning."""
    if name == "verdicts":
        return "; ".join(explain_verdicts(int(value))) or "no verdict"
    if name == "phase" and value >= 0:
        return _name_phase(int(value))
    if name in _FLAGS:
        return "yes" if value else "no"
    return f"{value!r} {_unit(name)}".rstrip()


_FLAGS = [field.name for field in TICK_FIELDS if field.kind is bool]
_CODES = [*_FLAGS, "verdicts", "phase"]


def _unit(name: str) -> str:
    unit = unit_of_column(name)
    return "" if unit == "1" else unit


def _format_stages(found: Replay) -> list[str]:
    """Return a line for each stage that differs, in the order of the first difference."""
    lines = []
    for stage in dict.fromkeys(difference.place.stage for difference in found.differences):
        fields = [d for d in found.differences if d.place.stage == stage]
        since = _tick(found, fields[0].first.tick)
        ticks = max(difference.ticks for difference in fields)
        shown = ", ".join(map(_format_magnitude, fields[:_FIELDS_SHOWN]))
        more = f" and {len(fields) - _FIELDS_SHOWN} more" if len(fields) > _FIELDS_SHOWN else ""
        often = "1 tick" if ticks == 1 else f"{ticks} ticks"
        lines.append(f"{stage} differs from tick {since} on, in {often}: {shown}{more}")
    untouched = dict.fromkeys(place.stage for place in found.fields)
    equal = [s for s in untouched if all(d.place.stage != s for d in found.differences)]
    return [*lines, f"equal: {', '.join(equal)}"] if equal else lines


_FIELDS_SHOWN = 5


def _format_magnitude(difference: Difference) -> str:
    name = difference.place.name
    if name in _CODES:
        return name
    if math.isinf(difference.largest):
        return f"{name} (not a number in one of the two)"
    return f"{name} (by up to {f'{difference.largest:.2g} {_unit(name)}'.rstrip()})"


def _advise(found: Replay) -> list[str]:
    made = _maker(found)
    lines = [
        f"made by pamctl {made['version']} on {made['machine']}; this is {_describe_this_pamctl()}"
    ]
    if are_within_tolerance(OTHER_CPU, found.differences):
        lines.append(
            "no more than the rounding of another CPU or C library: "
            f"compare with --tolerance {OTHER_CPU_NAME}"
        )
    return lines


def _describe_this_pamctl() -> str:
    from pamctl import __version__

    return f"pamctl {__version__} on {platform.machine()}"


def _maker(found: Replay) -> dict[str, str]:
    origin = found.recording.log.metadata.get("pamctl", {})
    return {name: origin.get(name, "?") for name in ("version", "machine", "python")}


def _tick(found: Replay, index: int) -> int:
    return int(found.recording.log["tick"][index])


def _phase(found: Replay, index: int) -> str:
    return _name_phase(int(found.recording.log["phase"][index]))


def _name_phase(number: int) -> str:
    return Phase(number).name.lower() if number in [*Phase] else f"phase {number}, which is none"
