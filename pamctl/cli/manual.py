"""`pamctl manual`: the pages of the manual in the terminal."""

from __future__ import annotations

import sys
from difflib import get_close_matches
from itertools import groupby
from typing import Annotated

import typer


def manual(
    page: Annotated[
        str | None,
        typer.Argument(metavar="[PAGE]", help="Page to read", show_default="the list of all pages"),
    ] = None,
) -> None:
    """List the pages of the manual, or print one of them."""
    from pamctl.manual import list_pages, read_page

    pages = list_pages()
    if page is None:
        width = max(len(one.name) for one in pages)
        for kind, of_kind in groupby(sorted(pages, key=lambda p: p.kind), key=lambda p: p.kind):
            typer.echo(f"{kind.replace('_', ' ')}:")
            for one in of_kind:
                typer.echo(f"  {one.name:<{width}}  {one.title}")
        return
    names = [one.name for one in pages]
    if page not in names:
        near = get_close_matches(page, names, 1)
        hint = f"did you mean '{near[0]}'?" if near else "see pamctl manual for the list"
        raise typer.BadParameter(f"there is no page '{page}'; {hint}", param_hint="PAGE")
    text = read_page(page)
    if not sys.stdout.isatty():
        typer.echo(text.rstrip())
        return
    from rich.console import Console
    from rich.markdown import Markdown

    Console().print(Markdown(text))
