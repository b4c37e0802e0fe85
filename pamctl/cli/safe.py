"""`pamctl safe`: the safe voltage, whatever has happened before."""

from __future__ import annotations

import json

import typer

from hal.rig import RigError
from pamctl.cli.backend import BackendOption
from pamctl.cli.config import JsonOption, RigOption, SetOption, resolve_options
from pamctl.cli.linux import require_linux
from pamctl.exit_codes import ExitCode
from pamctl.settings.resolve import RunSettings

_PATIENCE_S = 0.5
"""For an owner that is dying; one that lives must be stopped by whoever started it."""


def safe(
    backend: BackendOption = None,
    rig: RigOption = None,
    overrides: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Drive the rig to its safe voltage, whatever has happened before."""
    settings, _ = resolve_options(backend, rig, overrides, as_json=as_json, fast=False)
    require_linux()
    from pamctl.processes.backends import device_of

    failure = _make_safe(settings)
    place = f"{device_of(settings)}: {settings.rig.safe_volts:g} V"
    if as_json:
        document = {
            "exit_code": int(ExitCode.UNAVAILABLE if failure else ExitCode.OK),
            "device": device_of(settings),
            "safe_volts": settings.rig.safe_volts,
            "reason": str(failure or ""),
        }
        typer.echo(json.dumps(document, indent=2))
    elif failure is None:
        typer.echo(f"{place} on the output: safe")
    if failure is not None:
        typer.echo(f"error: NOT safe, {place} could not be driven: {failure}", err=True)
        raise typer.Exit(ExitCode.UNAVAILABLE)


def _make_safe(settings: RunSettings) -> RigError | None:
    from pamctl.processes.backends import build_clock, build_rig, require_backend
    from pamctl.processes.guardian import drive_safe

    try:
        require_backend(settings)
    except RigError as error:
        return error
    return drive_safe(build_rig(settings, build_clock(settings, may_spin=False)).rig, _PATIENCE_S)
