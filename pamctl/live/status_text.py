"""The daemon's status as a few lines for people, or as one line for a file or a pipe."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pamctl.log.run_meta import spell_controller
from pamctl.report.progress_line import format_progress

if TYPE_CHECKING:  # `pamctl status` does not wait for it
    from pamctl.live.feed import Glimpse


def format_status(status: Mapping[str, Any]) -> str:
    """Write a status, as the daemon sends it, as a few lines."""
    what = f" ({status['run']})" if status["run"] else ""
    if status["fault"]:
        what = f": {status['fault']}"
    lines = [f"{status['state']}{what}, {status['backend']} {status['device']}"]
    if status["tick"] is not None:
        tick = {k: float("nan") if v is None else v for k, v in status["tick"].items()}
        lines.append(format_progress(tick, status["worst_late_s"]).strip())
    lines.append(f"controller: {spell_controller(status['names'])}")
    if status.get("monitor"):
        lines.append(status["monitor"]["sentence"])
    if status["log"]:
        lines.append(f"log: {status['log']}")
    lines.append(f"disk: {status['disk_free_bytes'] / 1e9:.1f} GB free")
    return "\n".join(lines)


def format_glimpse(glimpse: Glimpse) -> str:
    """Write what was seen in one look as one line."""
    if glimpse.status is None:
        return f"away: {glimpse.problem}"
    return "  ".join(format_status(glimpse.status).splitlines()[:2])
