"""Parse or run a command as the command line does, in this process."""

from __future__ import annotations

import io
import os
import shlex
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import chdir, redirect_stderr, redirect_stdout
from functools import cache
from pathlib import Path
from typing import IO, Any
from unittest.mock import patch

from typer.main import get_command

from pamctl.__main__ import main
from pamctl.cli.app import app
from support.patience import PATIENCE_S


@cache
def build_command() -> Any:
    """Return all of the command line, as a shell would find it."""
    return get_command(app)


def parse_command(text: str) -> None:
    """Raise a usage error where `pamctl VERB ...` would leave with one."""
    name, *words = shlex.split(text, comments=True)
    assert name == "pamctl", text
    command = build_command()
    while inner := getattr(command, "commands", None):
        name, *words = words
        command = inner[name]
    command.make_context(name, words)


def run_pamctl(
    *words: object, cwd: Path | None = None, typed: str = ""
) -> subprocess.CompletedProcess[str]:
    """Run `pamctl WORDS` to its end, half a second sooner than a process of its own.

    For verbs whose process is not what is tested. Standard input is `typed`, and no terminal.
    """
    arguments = ["pamctl", *map(str, words)]
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    out, err = (io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True) for _ in range(2))
    with (
        _type_ahead(typed) as keyboard,
        patch.dict(os.environ),
        patch.object(sys, "argv", arguments),
        patch.object(sys, "stdin", keyboard),
        chdir(cwd or Path.cwd()),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        try:
            main()
            code = 0
        except SystemExit as leaving:
            code = leaving.code if isinstance(leaving.code, int) else int(leaving.code is not None)
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
    said, complained = (stream.buffer.getvalue().decode() for stream in (out, err))  # type: ignore[attr-defined]
    return subprocess.CompletedProcess(arguments, code, said, complained)


def run_process(command: Sequence[str | Path], **how: Any) -> subprocess.CompletedProcess[str]:
    """Run a command as a process of its own to its end; return what it said."""
    return subprocess.run(
        command, **{"capture_output": True, "text": True, "timeout": 10 * PATIENCE_S, **how}
    )


def start_process(command: Sequence[str | Path], **how: Any) -> subprocess.Popen[str]:
    """Start a command as a process of its own, whose words can be read."""
    out = subprocess.PIPE
    return subprocess.Popen(command, stdout=out, stderr=out, text=True, **how)


def _type_ahead(text: str) -> IO[str]:
    """Return a file with the text; a verb may ask for its number."""
    file = tempfile.TemporaryFile("w+", encoding="utf-8")  # noqa: SIM115
    file.write(text)
    file.seek(0)
    return file
