"""The pages that people read: Markdown, one folder a kind, shipped with the package.

`list_pages` and `read_page` serve `pamctl manual`; nothing here imports another room.
Read `tutorials/first-run.md` first.
"""

from __future__ import annotations

import re
from difflib import get_close_matches
from pathlib import Path
from typing import NamedTuple

KINDS = {
    "tutorials": "tutorial",
    "how_to": "how to",
    "reference": "reference",
    "explanation": "explanation",
    "decisions": "decision",
}
"""The folders of the manual in reading order, and what a page in each is called."""

_READ_FIRST = ("first-run", "first-diagnosis")
_FOLDER = Path(__file__).parent
_COMMENT = re.compile(r"^[ ]*<!--.*?-->\n\n?", re.DOTALL | re.MULTILINE)


class ManualPage(NamedTuple):
    """One page of the manual: `name` is its file name without `.md`, `title` its first heading."""

    name: str
    title: str
    kind: str
    path: Path


class UnknownPageError(KeyError):
    """No page has this name; the message says which name is nearest."""

    def __str__(self) -> str:
        return str(self.args[0])


def list_pages() -> list[ManualPage]:
    """Return every page, by kind in reading order, then by title; who starts finds two first."""
    return [
        page
        for folder, kind in KINDS.items()
        for page in sorted(_read_pages_of(folder, kind), key=_order_page)
    ]


def read_page(name: str) -> str:
    """Return the Markdown text of a page, without its HTML comments.

    Raises UnknownPageError where no page has this name.
    """
    pages = {page.name: page for page in list_pages()}
    if name not in pages:
        nearest = get_close_matches(name.lower().removesuffix(".md"), pages, n=1, cutoff=0.5)
        hint = f"; did you mean '{nearest[0]}'?" if nearest else "; `pamctl manual` lists the pages"
        raise UnknownPageError(f"the manual has no page '{name}'{hint}")
    text = pages[name].path.read_text(encoding="utf-8")
    return _COMMENT.sub("", text)


def _order_page(page: ManualPage) -> tuple[bool, int, str]:
    is_first = page.name in _READ_FIRST
    return not is_first, _READ_FIRST.index(page.name) if is_first else 0, page.title.lower()


def _read_pages_of(folder: str, kind: str) -> list[ManualPage]:
    return [
        ManualPage(path.stem, _read_title(path), kind, path)
        for path in (_FOLDER / folder).glob("*.md")
    ]


def _read_title(path: Path) -> str:
    with path.open(encoding="utf-8") as text:
        return next(line[2:].strip() for line in text if line.startswith("# "))
