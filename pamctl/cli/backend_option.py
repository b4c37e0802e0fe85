"""The option `--backend`: to name its values, the records of all backends are loaded."""

from __future__ import annotations

from typing import Annotated

import typer

from hal.backend import find_backends

BackendOption = Annotated[
    str | None,
    typer.Option(
        "--backend",
        metavar="|".join(find_backends().found),
        help="Backend to drive",
        show_default="that of --rig, sim",
    ),
]
