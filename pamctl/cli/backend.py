"""Which rig `--backend` and `--rig` mean together."""

from __future__ import annotations

from typing import Annotated

import typer

from hal.backend import find_backends, hint_at_missing
from pamctl.settings.problems import ConfigError, Problem
from pamctl.settings.resolve import RunSettings

_BACKENDS = find_backends().found

BackendOption = Annotated[
    str | None,
    typer.Option("--backend", metavar="|".join(_BACKENDS), help="Backend to drive [default: sim]."),
]


def rig_name(backend: str | None, rig: str | None) -> str | None:
    """Return the rig that `--backend` and `--rig` mean together; raise `ConfigError`."""
    if backend is not None and backend not in _BACKENDS:
        message = f"unknown; there are {', '.join(_BACKENDS)}; {hint_at_missing(backend)}"
        raise ConfigError([Problem(f"--backend {backend}", "", message)])
    return rig if rig is not None or backend is None else _BACKENDS[backend].rig_file


def check_backend(settings: RunSettings, backend: str | None, rig: str | None) -> None:
    """Raise `ConfigError` where the options contradict the rig file."""
    found = settings.rig.backend
    if backend is not None and backend != found:
        message = f"the rig file {rig} is for the backend {found}"
        raise ConfigError([Problem(f"--backend {backend}", "", message)])
    if settings.fast and not settings.rig.record.is_simulated:
        message = "only a simulation can do without a clock"
        raise ConfigError([Problem("--fast", "", message)])
