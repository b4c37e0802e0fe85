"""Limits of seconds on the command line, in words: a range of typer's takes nan for too small."""

from __future__ import annotations

import math
from collections.abc import Callable

import typer

Check = Callable[[float | None], float | None]


def at_least(low_s: float, high_s: float = math.inf) -> Check:
    """Return what passes seconds within both limits on, and leaves with 2 for others."""
    return _make_check(lambda seconds: low_s <= seconds <= high_s, f"at least {low_s:g}", high_s)


def more_than(low_s: float, high_s: float = math.inf) -> Check:
    """Return what passes seconds above the lower limit on, and leaves with 2 for others."""
    return _make_check(lambda seconds: low_s < seconds <= high_s, f"more than {low_s:g}", high_s)


def _make_check(holds: Callable[[float], bool], low: str, high_s: float) -> Check:
    high = f" and at most {high_s:g}" if math.isfinite(high_s) else ""

    def check(seconds: float | None) -> float | None:
        if seconds is None or (math.isfinite(seconds) and holds(seconds)):
            return seconds
        what = f"{low}{high} s" if math.isfinite(seconds) else "finite"
        raise typer.BadParameter(f"must be {what} (got {seconds:g})")

    return check
