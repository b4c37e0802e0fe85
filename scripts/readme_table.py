"""Put what a script measured into the README, between two comments that carry its name.

<!-- begin tracking_table -->
...
<!-- end tracking_table -->

from readme_table import table, write_between
write_between("tracking_table", table(header, rows))
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

README = Path(__file__).resolve().parents[1] / "README.md"


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; every row is as long as the header."""
    lines = [header, ["---"] * len(header), *rows]
    if any(len(line) != len(header) for line in lines):
        raise ValueError(f"a row differs in length from the header {list(header)}")
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines
    )


def write_between(name: str, text: str, readme: Path = README) -> bool:
    """Replace what stands between the comments of this name; tell whether anything changed.

    Raises ValueError where the comments are not there, once each and in order.
    """
    old = readme.read_text(encoding="utf-8")
    begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
    if old.count(begin) != 1 or old.count(end) != 1 or old.index(begin) > old.index(end):
        raise ValueError(f"{readme} needs the lines '{begin}' and '{end}', once each, in order")
    before, rest = old.split(begin)
    _, after = rest.split(end)
    new = f"{before}{begin}\n{text.strip()}\n{end}{after}"
    if new != old:
        readme.write_text(new, encoding="utf-8")
    return new != old
