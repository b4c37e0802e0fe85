"""Put a measured table into the page that has its place: README.md or a page of the manual.

The place is between two comments with the table's name:

    <!-- begin tracking_table -->
    ...
    <!-- end tracking_table -->

    from measured_table import format_table, write_measured
    write_measured("tracking_table", format_table(header, rows))

Date, machine and command are written below the table.
"""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Sequence
from datetime import date
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table; every row must be as long as the header."""
    lines = [header, ["---"] * len(header), *rows]
    if any(len(line) != len(header) for line in lines):
        raise ValueError(f"a row differs in length from the header {list(header)}")
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines
    )


def describe_measurement() -> str:
    """Say when, where and with which command the figures were made."""
    command = " ".join(["python", f"scripts/{Path(sys.argv[0]).name}", *sys.argv[1:]])
    machine = f"{os.cpu_count()} CPUs, {platform.system()} {platform.machine()}"
    return f"Measured on {date.today():%Y-%m-%d} ({machine}) with `{command}`."


def write_measured(name: str, text: str) -> Path:
    """Replace the table of this name, with its date, machine and command; return the page."""
    page = find_page(name)
    write_between(name, f"{text.strip()}\n\n{describe_measurement()}", page)
    return page


def find_page(name: str, root: Path = ROOT) -> Path:
    """Return the one page that has the comments of this name; raise ValueError if none has."""
    begin = f"<!-- begin {name} -->"
    pages = [root / "README.md", *sorted((root / "pamctl" / "manual").rglob("*.md"))]
    places = [page for page in pages if begin in page.read_text(encoding="utf-8")]
    if len(places) != 1:
        raise ValueError(f"{len(places)} pages have the line '{begin}'; one page must have it")
    return places[0]


def write_between(name: str, text: str, page: Path) -> None:
    """Replace the text between the comments of this name, as `replace_between`."""
    old = page.read_text(encoding="utf-8")
    new = replace_between(name, text, old, page)
    if new != old:
        page.write_text(new, encoding="utf-8")


def replace_between(name: str, text: str, old: str, page: Path) -> str:
    """Return a page's text with another one between the comments of this name.

    Raises ValueError if the comments are not there, once each and in order.
    """
    begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
    if old.count(begin) != 1 or old.count(end) != 1 or old.index(begin) > old.index(end):
        raise ValueError(f"{page} needs the lines '{begin}' and '{end}', once each, in order")
    before, rest = old.split(begin)
    _, after = rest.split(end)
    return f"{before}{begin}\n{text.strip()}\n{end}{after}"
