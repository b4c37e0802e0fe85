"""`pamctl mark`: put a remark into the log."""

from __future__ import annotations

from typing import Annotated

import typer

from pamctl.cli.daemon.ask import ask, print_answer
from pamctl.cli.options import JsonOption, SocketOption
from pamctl.daemon.protocol import LONGEST_REMARK
from pamctl.plain_text import clean_text


def check_remark(text: str) -> str:
    """Return the remark without control characters; leave with 2 where it is empty or too long."""
    text = clean_text(text)
    if not 1 <= len(text) <= LONGEST_REMARK:
        message = f"must have 1 to {LONGEST_REMARK} characters (got {len(text)})"
        raise typer.BadParameter(message)
    return text


def mark(
    text: Annotated[
        str,
        typer.Argument(callback=check_remark, help="Remark of 1 to 2000 characters"),
    ],
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Put a remark into the log of the current run."""
    print_answer(ask(socket, "mark", {"text": text}), "marked", as_json=as_json)
