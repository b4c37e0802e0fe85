"""What the monitor says, in words."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

_UNITS = {"pressure": (1.0, "Pa"), "mechanics": (1e6, "um")}
_STILL = {"pressure": "the valve is at rest", "mechanics": "the muscle stands still"}


def format_alarm(alarm: Mapping[str, Any]) -> str:
    """Return an alarm as a sentence: since when, which block, how far off."""
    scale, unit = _UNITS[alarm["block"]]
    at = time.strftime("%H:%M:%S", time.localtime(alarm["since_s"]))
    return (
        f"since {at} the {alarm['block']} block is {alarm['over_floor']:.1f} x its floor "
        f"({scale * alarm['rms']:.3g} {unit} RMS, {alarm['activity']})"
    )


def format_block(block: Mapping[str, Any]) -> str:
    """Return the state of one block in some words."""
    name, state = block["block"], block["state"]
    if block["alarm"] is not None:
        return format_alarm(block["alarm"])
    if state == "cannot tell":
        return f"{name}: cannot tell, {_STILL[name]}"
    return f"{name}: {state}, {block['over_floor']:.1f} x its floor"


def format_monitor(monitor: Mapping[str, Any]) -> str:
    """Return the monitor's state as one line."""
    if not monitor["alive"]:
        return f"monitor: ended ({monitor['problem']})"
    if monitor["problem"]:
        return f"monitor: {monitor['problem']}"
    if not monitor["blocks"]:
        return "monitor: waiting for some seconds of a run"
    words = "; ".join(format_block(block) for block in monitor["blocks"])
    explanation = monitor["explanation"]
    return f"monitor: {words}" + (f"; {explanation['sentence']}" if explanation else "")
