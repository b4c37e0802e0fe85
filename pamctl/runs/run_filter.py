"""Which runs are meant: the options of `pamctl runs` as a condition on the index."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

from pamctl.exit_codes import ExitCode
from pamctl.runs.run_index import RunIndex
from pamctl.runs.run_row import ENDING_WORDS, RunRow
from pamctl.runs.spoken_dates import DateSpan

_OPERATORS = {">": ">", "<": "<", ">=": ">=", "<=": "<=", "=": "=", "==": "=", "!=": "!="}
_LIMIT = re.compile(r"\s*(>=|<=|==|=|>|<)\s*([^\s<>=]+)\s*")
_RANGE = re.compile(r"\s*([^\s.<>=]\S*?)\.\.(\S+)\s*")
_WHERE = re.compile(r"\s*([A-Za-z_][\w.-]*)\s*(>=|<=|!=|==|=|>|<)\s*(.*?)\s*")
_NUMBERS = [one.name for one in fields(RunRow) if str(one.type).startswith(("int", "float"))]

Condition = tuple[str, list[object]]
"""SQL, and the values of its question marks."""


class FilterError(Exception):
    """An option that selects runs makes no sense. The message says what does."""

    exit_code = ExitCode.USAGE


@dataclass(frozen=True)
class RunFilter:
    """All that is given must hold. Names may hold `*`; texts are found inside, in any case."""

    law: str | None = None
    controller: str | None = None
    experiment: str | None = None
    plant: str | None = None
    backend: str | None = None
    operator: str | None = None
    sample: str | None = None
    ending: str | None = None
    """A word of `ENDING_WORDS`, or an exit code."""
    verdict: str | None = None
    """A part of the meaning of a safety rule that clipped or tripped."""
    note_text: str | None = None
    """A part of the note, or of a mark."""
    tags: Sequence[str] = ()
    """All of them."""
    without_tags: Sequence[str] = ()
    """None of them."""
    since: DateSpan | None = None
    until: DateSpan | None = None
    """A day is meant as a whole."""
    limits: Sequence[tuple[str, str]] = ()
    """Column, and limit such as `>50`, `<=20` or `10..20`."""
    where: Sequence[str] = ()
    """Conditions on columns and settings, such as `controller.lambda_per_s>=40`."""
    last: int | None = None
    """Only the newest of them."""


def select_runs(index: RunIndex, wanted: RunFilter, *, with_gains: bool = True) -> list[RunRow]:
    """Return the runs that are wanted, the oldest first; raise FilterError."""
    parts = list(_list_conditions(index, wanted))
    where = " AND ".join(f"({sql})" for sql, _ in parts) or "1"
    values = [value for _, more in parts for value in more]
    rows = index.select(where, values, with_gains=with_gains)
    return rows[-wanted.last :] if wanted.last else rows


def _list_conditions(index: RunIndex, wanted: RunFilter) -> Iterator[Condition]:
    for name in ("law", "controller", "experiment", "plant", "backend", "operator", "sample"):
        if (asked := getattr(wanted, name)) is not None:
            yield f"lower({name}) GLOB lower(?)", [_glob(asked)]
    for name in ("verdict", "note_text"):
        if (asked := getattr(wanted, name)) is not None:
            column = "verdicts" if name == "verdict" else "note || ' ' || marks"
            yield f"instr(lower({column}), lower(?)) > 0", [asked]
    if wanted.ending is not None:
        yield _match_ending(wanted.ending)
    for tag in wanted.tags:
        yield "EXISTS (SELECT 1 FROM json_each(tags) WHERE value = ?)", [tag]
    for tag in wanted.without_tags:
        yield "NOT EXISTS (SELECT 1 FROM json_each(tags) WHERE value = ?)", [tag]
    if wanted.since is not None:
        yield "when_s >= ?", [wanted.since.first_s]
    if wanted.until is not None:
        is_day = wanted.until.end_s > wanted.until.first_s
        yield f"when_s {'<' if is_day else '<='} ?", [wanted.until.end_s]
    for column, limit in wanted.limits:
        yield _limit(column, limit)
    for text in wanted.where:
        yield _compare_key(index, text)


def _glob(asked: str) -> str:
    """Return a pattern in which only `*` and `?` are special."""
    return asked.replace("[", "[[]")


def _match_ending(asked: str) -> Condition:
    if asked in ENDING_WORDS:
        return "ending = ?", [asked]
    if asked.isdecimal():
        return "exit_code = ?", [int(asked)]
    raise FilterError(f"--ending {asked}: write {', '.join(ENDING_WORDS)}, or an exit code")


def _limit(column: str, text: str) -> Condition:
    if found := _LIMIT.fullmatch(text):
        return f"{column} {_OPERATORS[found[1]]} ?", [_read_number(found[2], text)]
    if found := _RANGE.fullmatch(text):
        return f"{column} BETWEEN ? AND ?", [_read_number(part, text) for part in found.groups()]
    raise FilterError(f"{text!r} is no limit; write '>50', '<=20' or 10..20")


def _read_number(part: str, text: str) -> float:
    try:
        return float(part)
    except ValueError:
        raise FilterError(f"{text!r}: {part!r} is no number") from None


def _compare_key(index: RunIndex, text: str) -> Condition:
    found = _WHERE.fullmatch(text)
    if not found or not found[3]:
        example = "controller.lambda_per_s>=40"
        raise FilterError(f"--where {text!r}: write a key, a comparison and a value: {example}")
    key, operator, asked = found.groups()
    if key in _NUMBERS:
        return f"{key} {_OPERATORS[operator]} ?", [_read_number(asked, text)]
    place = f'$."{key}"'
    value = "coalesce(json_extract(sweep, '$.point' || substr(?, 2)), json_extract(gains, ?))"
    if not index.holds_any(f"{value} IS NOT NULL", [place, place]):
        raise FilterError(f"--where {text!r}: no run has {key}{_suggest_key(index, key)}")
    try:
        return f"{value} {_OPERATORS[operator]} ?", [place, place, float(asked)]
    except ValueError:
        if operator not in ("=", "==", "!="):
            raise FilterError(f"--where {text!r}: {asked!r} is no number") from None
        return f"{value} {_OPERATORS[operator]} ?", [place, place, asked]


def _suggest_key(index: RunIndex, key: str) -> str:
    known = {name for row in index.select() for name in row.gains}
    near = difflib.get_close_matches(key, [*sorted(known), *_NUMBERS], 1)
    return f"; did you mean {near[0]}?" if near else ""
