"""`pamctl goto`: go to a position and hold it."""

from __future__ import annotations

import math
import re
from typing import Annotated

import typer

from pamctl.cli.daemon.ask import ask, print_answer
from pamctl.cli.options import JsonOption, SocketOption, seconds_option
from pamctl.daemon.protocol import LONGEST_MOTION_S

_METRES = {"": 1e-3, "mm": 1e-3, "m": 1.0, "um": 1e-6, "in": 25.4e-3}


def goto(
    position: Annotated[
        str, typer.Argument(metavar="POSITION", help="Position such as 12mm, 0.012m or 12 (mm)")
    ],
    within_s: Annotated[
        float | None,
        seconds_option(
            "--in",
            "Duration of the motion",
            more_than=0.0,
            at_most=LONGEST_MOTION_S,
            show_default="as long as 4 mm/s takes",
        ),
    ] = None,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Go to a position and hold it."""
    params = {"position_m": parse_position_m(position), "within_s": within_s}
    print_answer(ask(socket, "goto", params), "log: {log}", as_json=as_json)


def parse_position_m(text: str) -> float:
    """Read a length in m; a bare number is in mm."""
    found = re.fullmatch(r"\s*([+-]?[\d.]+(?:[eE][+-]?\d+)?)\s*([a-z]*)\s*", text)
    try:
        assert found is not None
        length_m = float(found[1]) * _METRES[found[2]]
        assert math.isfinite(length_m)
        return length_m
    except (AssertionError, KeyError, ValueError):
        raise typer.BadParameter(f"'{text}' is no position; write 12mm or 0.012m") from None
