"""Where the daemon is reached: shared by it and all its clients."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

SocketOption = Annotated[
    Path | None, typer.Option("--socket", metavar="PATH", help="Of the daemon; of this user's.")
]
