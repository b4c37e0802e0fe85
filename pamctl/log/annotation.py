"""Tags, note, operator and sample of a run: a metadata record `annotation` of its log.

The newest record counts. Each says when it was made, and the older ones stay: so a log also
holds what was said of it before.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

from pamctl.base.errors import ExitCode
from pamctl.base.texts import LONGEST_NAME, LONGEST_NOTE, MOST_TAGS, clean_text
from pamctl.log.run_meta import RunMeta

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
