"""What verbs write: JSON documents and files. Checked before anything is computed."""

from __future__ import annotations

import json
import os
from pathlib import Path

import typer

from pamctl.json_text import to_json


def print_json(document: object) -> None:
    """Print one JSON document; floats that are not finite are "nan", "inf" and "-inf"."""
    typer.echo(json.dumps(json.loads(to_json(document)), indent=2))


def require_writable(path: Path | None, option: str) -> None:
    """Refuse a file that cannot be written; exit with 2."""
    if path is None:
        return
    if path.is_dir():
        raise typer.BadParameter(f"{path} is a directory", param_hint=option)
    if not path.parent.is_dir():
        raise typer.BadParameter(f"there is no directory {path.parent}", param_hint=option)
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise typer.BadParameter(f"cannot write {path}: Permission denied", param_hint=option)


def require_new_file(path: Path | None, option: str) -> None:
    """Refuse a file that exists or cannot be written; exit with 2."""
    require_writable(path, option)
    if path is not None and path.exists():
        message = f"{path} exists, and is never overwritten; give another name"
        raise typer.BadParameter(message, param_hint=option)


def require_empty_folder(path: Path, option: str) -> None:
    """Refuse a folder that holds anything: nothing in it is overwritten; exit with 2."""
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        message = f"{path} exists and is not an empty folder; choose another"
        raise typer.BadParameter(message, param_hint=option)


def make_folder(path: Path, option: str) -> None:
    """Make a folder if there is none; exit with 2 where that fails."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        message = f"cannot make the directory {path}: {error.strerror}"
        raise typer.BadParameter(message, param_hint=option) from None


def write_page(target: Path, text: str, option: str = "--out") -> None:
    """Write a file; replace an older one of its kind and nothing else. Exit with 2 on failure."""
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
