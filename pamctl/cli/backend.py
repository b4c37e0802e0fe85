"""Which rig `--backend` and `--rig` mean together."""

from __future__ import annotations

from typing import Annotated

import typer

from pamctl.settings.problems import ConfigError, Problem
from pamctl.settings.resolve import RunSettings

RIG_OF_BACKEND = {"sim": "sim", "nidaq": "pci6221"}
"""The shipped rig file that `--backend` alone means."""

BackendOption = Annotated[
    str | None, typer.Option("--backend", metavar="sim|nidaq", help="What is driven; sim.")
]


def rig_name(backend: str | None, rig: str | None) -> str | None:
    """Return the rig that `--backend` and `--rig` mean together; raise `ConfigError`."""
    if backend is not None and backend not in RIG_OF_BACKEND:
        known = ", ".join(RIG_OF_BACKEND)
        raise ConfigError([Problem(f"--backend {backend}", "", f"unknown; there are {known}")])
    return rig if rig is not None or backend is None else RIG_OF_BACKEND[backend]


def check_backend(settings: RunSettings, backend: str | None, rig: str | None) -> None:
    """Raise `ConfigError` where the options contradict the rig file."""
    found = settings.rig.backend
    if backend is not None and backend != found:
        message = f"the rig file {rig} is for the backend {found}"
        raise ConfigError([Problem(f"--backend {backend}", "", message)])
    if settings.fast and found != "sim":
        message = "only a simulation can do without a clock"
        raise ConfigError([Problem("--fast", "", message)])
