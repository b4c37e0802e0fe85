"""Parse or run a command as the command line does, in this process."""

from __future__ import annotations

import io
import os
import shlex
import subprocess
import sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any
from unittest.mock import patch

from typer.main import get_command

from pamctl.__main__ import main
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


def run_pamctl(
    *words: object, cwd: Path | None = None, environment: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run `pamctl WORDS` to its end, half a second sooner than a process of its own.

    For verbs whose process is not what is tested. They find no terminal, and no input.
    """
    arguments = ["pamctl", *map(str, words)]
    out, err = (io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True) for _ in range(2))
    with (
        patch.dict(os.environ, environment or {}),
        patch.object(sys, "argv", arguments),
        patch.object(sys, "stdin", io.StringIO()),
        chdir(cwd or Path.cwd()),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        try:
            main()
            code = 0
        except SystemExit as leaving:
            code = leaving.code if isinstance(leaving.code, int) else int(leaving.code is not None)
    said, complained = (stream.buffer.getvalue().decode() for stream in (out, err))  # type: ignore[attr-defined]
    return subprocess.CompletedProcess(arguments, code, said, complained)
