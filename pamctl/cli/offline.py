"""What the verbs that read logs have in common."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import typer

from pamctl.exit_codes import ExitCode


@contextmanager
def exit_on_bad_data(*, as_json: bool) -> Iterator[None]:
    """Say in one line why a log cannot be used, and exit with 65; with 2 for a time it lacks."""
    from pamctl.log import LogError
    from pamctl.replay import BehindTheEnd, NotReplayable

    try:
        yield
    except (LogError, NotReplayable) as error:
        code = ExitCode.USAGE if isinstance(error, BehindTheEnd) else ExitCode.BAD_DATA
        if as_json:
            print_json({"exit_code": int(code), "reason": str(error)})
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(code) from None


def require_writable(path: Path | None, option: str) -> None:
    """Refuse a file that cannot be written before anything is computed; exit with 2."""
    if path is None:
        return
    if path.is_dir():
        raise typer.BadParameter(f"{path} is a directory", param_hint=option)
    if not path.parent.is_dir():
        raise typer.BadParameter(f"there is no directory {path.parent}", param_hint=option)
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise typer.BadParameter(f"cannot write {path}: Permission denied", param_hint=option)


def require_new_file(path: Path | None, option: str) -> None:
    """Refuse a file that exists, or cannot be written; exit with 2."""
    require_writable(path, option)
    if path is not None and path.exists():
        message = f"{path} exists, and is never overwritten; give another name"
        raise typer.BadParameter(message, param_hint=option)


def write_page(target: Path, text: str, option: str = "--out") -> None:
    """Write a file that may replace an older one of its kind, and nothing else; or exit with 2."""
    try:
        if target.exists() and target.stat().st_size and not _begins_alike(target, text):
            message = f"{target} exists and is something else; give another name"
            raise typer.BadParameter(message, param_hint=option)
        target.write_text(text, encoding="utf-8")
    except OSError as error:
        reason = f"cannot write {target}: {error.strerror}"
        raise typer.BadParameter(reason, param_hint=option) from None


def _begins_alike(target: Path, text: str) -> bool:
    with target.open("rb") as file:
        return file.read(1) == text[:1].encode()


def print_json(document: object) -> None:
    """Print one JSON document; numbers that are none are the strings "nan", "inf", "-inf"."""
    from pamctl.json_text import to_json

    typer.echo(json.dumps(json.loads(to_json(document)), indent=2))
