"""How the verbs of the clients ask the daemon, and print its answer."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import typer

from pamctl.cli.options import require_linux, seconds_option
from pamctl.cli.output import print_json


def ramp_option() -> Any:
    """Return the option that says over which time gains change."""
    return seconds_option("--ramp", "Time over which the gains change", at_least=0.0, at_most=60.0)


def ask(socket: Path | None, method: str, params: Mapping[str, object] | None = None) -> Any:
    """Ask the daemon. Raises `DaemonUnreachableError` and `DaemonDeclinedError`."""
    require_linux()
    from pamctl.daemon.client import Client, default_socket

    try:
        with Client(socket or default_socket()) as client:
            return client.call(method, params)
    except KeyboardInterrupt:
        print("the request was sent; see `pamctl status` for what it did", file=sys.stderr)
        raise


def read_section(section: str, name: str, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Read and check a file here, where its lines can be named; raise `ConfigError`."""
    from pamctl.cli.settings_from_options import find_argument_file
    from pamctl.settings.resolve import read_section_file, settings_to_data
    from pamctl.settings.table_file import read_tables

    path = find_argument_file(section, name)
    return settings_to_data(read_section_file(section, path, overrides, read_tables))


def print_answer(answer: Any, text: str, *, as_json: bool) -> None:
    """Print the answer, or `text` filled with its fields for people."""
    if as_json:
        print_json(answer)
    else:
        typer.echo(text.format(**(answer or {})))


def print_gains(gains: Mapping[str, Any], *, as_json: bool) -> None:
    """Print gains, for people as a controller file."""
    if as_json:
        print_json(gains)
    else:
        from pamctl.settings.yaml12 import dump_yaml

        typer.echo(dump_yaml(gains).rstrip())
