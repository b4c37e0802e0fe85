"""`pamctl manual`: the pages of the manual in the terminal."""

from __future__ import annotations

import sys
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
    from pamctl.manual import UnknownPageError, list_pages, read_page

    if page is None:
        pages = list_pages()
        width = max(len(one.name) for one in pages)
        for kind, of_kind in groupby(pages, key=lambda one: one.kind):
            typer.echo(f"{kind}:")
            for one in of_kind:
                typer.echo(f"  {one.name:<{width}}  {one.title}")
        return
    try:
        text = read_page(page)
    except UnknownPageError as error:
        raise typer.BadParameter(str(error), param_hint="PAGE") from None
    if not sys.stdout.isatty():
        typer.echo(text.rstrip())
        return
    from rich.console import Console
    from rich.markdown import Markdown

    Console().print(Markdown(text))
