"""Parse a command as the command line does, without running it."""

from __future__ import annotations

import shlex
from typing import Any

from typer.main import get_command

from pamctl.cli.app import app


def parse_command(text: str) -> None:
    """Raise a usage error where `pamctl VERB ...` would leave with one."""
    name, *words = shlex.split(text, comments=True)
    assert name == "pamctl", text
    command: Any = get_command(app)
    while inner := getattr(command, "commands", None):
        name, *words = words
        command = inner[name]
    command.make_context(name, words)
