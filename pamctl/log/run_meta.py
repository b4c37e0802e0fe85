"""What is known of a run beside its ticks: description, name of its log, moments, and words.

Moments are marks, changes of gains, and the trip. Words are the tags, the note, the operator and
the sample: a metadata record `annotation` of the log. The newest record counts. Each says when it
was made, and the older ones stay: so a log also holds what was said of it before.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pamctl.base.errors import ExitCode
from pamctl.base.texts import (
    LONGEST_NAME,
    LONGEST_NOTE,
    MOST_TAGS,
    clean_text,
    from_json,
    to_json,
)
from pamctl.signals import TICK_FIELDS, Field

if TYPE_CHECKING:
    from pamctl.log.reader import Log

_KINDS: dict[str, type] = {"int": int, "float": float, "bool": bool}


@dataclass(frozen=True)
class RunMeta:
    """Everything that is needed beside the ring's rows to write a complete log.

    It is stored in the ring and in the log.
    """

    log_path: str
    """Path of the log; it must not exist yet."""
    start_wall_ns: int = 0
    """Time since the epoch at `start_mono_ns`; zero if there is no clock."""
    start_mono_ns: int = 0
    """The rig's monotonic clock at the start; the times in a log are relative to it."""
    config: Mapping[str, Any] = field(default_factory=dict)
    """The resolved configuration; attached to the log as `config.json`."""
    attachments: Mapping[str, str] = field(default_factory=dict)
    """Text of further attachments by file name."""
    metadata: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    """Metadata records by name: `run` holds `law`, `backend` and `experiment`."""
    keyframe_fields: Sequence[str] = ()
    """Names of the doubles of a keyframe, in order."""
    tick_fields: Sequence[Field] = TICK_FIELDS
    """Columns of a tick row, in order."""
    origin: str = ""
    """`pamctl.log.schema.IMPORTED` if another system measured the data, else empty."""

    def to_text(self) -> bytes:
        """Return as JSON."""
        columns = [(name, kind.__name__, stage) for name, kind, stage in self.tick_fields]
        known = {part.name: getattr(self, part.name) for part in fields(self)}
        return to_json({**known, "tick_fields": columns})

    @classmethod
    def from_text(cls, text: str | bytes) -> RunMeta:
        """Read what `to_text` wrote."""
        known = from_json(text)
        columns = (Field(name, _KINDS[kind], stage) for name, kind, stage in known["tick_fields"])
        return cls(**{**known, "tick_fields": tuple(columns)})


def make_dated_path(directory: Path, what: str) -> Path:
    """Return a path in `directory` that does not exist yet."""
    stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
    names = (f"{stamp}{again}-{what}.mcap" for again in ("", *range(-2, -100, -1)))
    return next(path for name in names if not (path := directory / name).exists())


def flight_record_path(log: Path) -> Path:
    """Return the path of the flight record beside a log."""
    return log.with_name(f"{log.stem}-trip.csv")


def bare_name(name: str) -> str:
    """Return the bare name of a shipped name or a path; `.25` in `square-0.25` is no suffix."""
    last = Path(name).name
    return last.removesuffix(".yaml").removesuffix(".yml")


def file_safe_name(name: str) -> str:
    """Return the bare name of a file, with characters that are safe in any file name."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", bare_name(name)).strip("._-")[:60] or "unnamed"


CHANGES = "controller_changes"
"""Key beside `controller`, the name of the file: what differs from it; missing if nothing does."""
BESIDE_GAINS = ("event", "tick", "t_ns", "row", "from_t_s", "ramp_s")
"""What a message of gains holds besides: when they changed, and how fast."""

_NAMES = {"mark": "mark", "tripped": "trip"}


class Moment(NamedTuple):
    """Something that happened in a run."""

    t_s: float
    """On the time axis of the run's ticks."""
    text: str


def list_moments(log: Log) -> list[Moment]:
    """Return marks, changes of gains and the trip in order; those without a tick are left out."""
    ticks, t_s = log.columns.get("tick"), log.columns.get("t_s")
    if ticks is None or t_s is None or not len(ticks):
        return []
    named: list[tuple[Mapping[str, Any], str]] = [
        (event, str(event.get("text", _NAMES[event["event"]])))
        for event in log.events
        if event.get("event") in _NAMES
    ]
    changed = {id(after): after for _, after, _ in list_gain_changes(log.gains)}
    named += [(after, "gains") for after in changed.values()]
    rows = [
        (min(int(ticks.searchsorted(event["tick"])), len(ticks) - 1), text)
        for event, text in named
        if isinstance(event.get("tick"), int)
    ]
    return sorted(Moment(float(t_s[row]), text) for row, text in rows)


def describe_changes(gains: Mapping[str, Any], of_file: Mapping[str, Any]) -> str:
    """Say which gains differ from the file's: `lambda_per_s 60 (file 37.82)`; empty if none do."""
    return ", ".join(
        f"{name} {_spell(gains[name])} (file {_spell(of_file.get(name, 'none'))})"
        for name in gains
        if gains[name] != of_file.get(name)
    )


def spell_controller(named: Mapping[str, Any]) -> str:
    """Return the controller's name, with a star and the changes where gains were changed."""
    name, changes = str(named.get("controller") or ""), named.get(CHANGES)
    return f"{name}*, {changes}" if changes else name


def list_gain_changes(
    gains: Sequence[Mapping[str, Any]],
) -> list[tuple[Mapping[str, Any], Mapping[str, Any], str]]:
    """Return the messages before and after each change, with the name of the gain that changed."""
    return [
        (before, after, name)
        for before, after in pairwise(gains)
        for name in after
        if name not in BESIDE_GAINS and after[name] != before.get(name)
    ]


def describe_running_changes(gains: Sequence[Mapping[str, Any]]) -> str | None:
    """Say how gains changed while the law ran: `lambda_per_s 37.82 to 60`; None if none did."""
    names = dict.fromkeys(name for *_, name in list_gain_changes(gains))
    said = (
        f"{name} {_spell(gains[0].get(name))} to {_spell(gains[-1].get(name))}" for name in names
    )
    return ", ".join(said) or None


def _spell(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


# --- what is said of a run ----------------------------------------------------------------------

ANNOTATION = "annotation"
"""Name of the metadata record."""

_TAG = re.compile(r"[\w][\w.:+@-]{0,63}")


class AnnotationError(Exception):
    """A tag, note or name cannot be used. The message says what is allowed."""

    exit_code = ExitCode.USAGE


@dataclass(frozen=True)
class Annotation:
    """What is said of a run; every text is one line without control characters."""

    tags: tuple[str, ...] = ()
    note: str = ""
    operator: str = ""
    sample: str = ""

    def add_tag(self, tag: str) -> Annotation:
        """Return it with one tag more; raise AnnotationError if that is no tag."""
        return make_annotation((*self.tags, tag), self.note, self.operator, self.sample)

    def drop_tag(self, tag: str) -> Annotation:
        """Return it without a tag, which need not be there."""
        return replace(self, tags=tuple(known for known in self.tags if known != tag))

    def to_metadata(self) -> dict[str, str]:
        """Return the values of the record."""
        return {
            "tags": json.dumps(list(self.tags), ensure_ascii=False),
            "note": self.note,
            "operator": self.operator,
            "sample": self.sample,
        }

    @classmethod
    def from_metadata(cls, values: Mapping[str, str]) -> Annotation:
        """Read a record. What another program wrote is cleaned; what makes no sense is left out."""
        try:
            tags = json.loads(values.get("tags", "[]"))
        except ValueError:
            tags = []
        found = [clean_text(tag) for tag in tags if isinstance(tag, str)]
        texts = {key: clean_text(values.get(key, "")) for key in ("note", "operator", "sample")}
        return cls(tuple(dict.fromkeys(tag for tag in found if _TAG.fullmatch(tag))), **texts)


NOTHING_SAID = Annotation()


def make_annotation(
    tags: Sequence[str] = (),
    note: str | None = None,
    operator: str | None = None,
    sample: str | None = None,
) -> Annotation:
    """Return the annotation of texts from outside; raise AnnotationError where one cannot be used.

    Control characters, escape sequences and bidirectional marks are taken out.
    """
    said = {"note": note, "operator": operator, "sample": sample}
    clean = {name: clean_text(text or "") for name, text in said.items()}
    for name, text in clean.items():
        longest = LONGEST_NOTE if name == "note" else LONGEST_NAME
        if len(text) > longest:
            raise AnnotationError(f"the {name} has {len(text)} characters, {longest} are allowed")
    known = tuple(dict.fromkeys(check_tag(tag) for tag in tags))
    if len(known) > MOST_TAGS:
        raise AnnotationError(f"{len(known)} tags, {MOST_TAGS} are allowed for a log")
    return Annotation(known, **clean)


def check_tag(tag: str) -> str:
    """Return a tag from outside; raise AnnotationError if it is not one word."""
    clean = clean_text(tag)
    if not _TAG.fullmatch(clean):
        allowed = "a tag is one word of at most 64 letters, digits and . _ - : + @"
        raise AnnotationError(f"{clean!r} is no tag; {allowed}")
    return clean


def annotate_meta(meta: RunMeta, said: Annotation) -> RunMeta:
    """Return the description of a run with what is said of it."""
    if said == NOTHING_SAID:
        return meta
    return replace(meta, metadata={**meta.metadata, ANNOTATION: said.to_metadata()})


def date_record(values: Mapping[str, str]) -> dict[str, str]:
    """Return the values of a record with the time of now: no two records are the same."""
    return {**values, "changed": datetime.now(UTC).isoformat(timespec="microseconds")}
