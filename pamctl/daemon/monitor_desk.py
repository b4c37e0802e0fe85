"""What the daemon does with the monitor's reports: events for clients, remarks in the log."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from pamctl.daemon.protocol import RequestRefusedError
from pamctl.monitor.monitor_handle import MonitorHandle, format_alarm, format_monitor
from pamctl.plain_text import LONGEST_REMARK
from pamctl.plant.model import PlantSettings


class MonitorDesk:
    """The monitor of one daemon, or none: then every call does nothing."""

    def __init__(
        self,
        plant: PlantSettings | None,
        announce: Callable[..., None],
        mark: Callable[[str], None],
        trip: Callable[[str], None] | None,
    ) -> None:
        """Start a monitor that follows `plant`; None starts none. An alarm calls `trip`, if any."""
        self._announce, self._mark, self._trip = announce, mark, trip
        self._handle = None if plant is None else MonitorHandle(plant, self._take)

    @property
    def pids(self) -> dict[str, int]:
        """Process id, by role."""
        return {} if self._handle is None else {"monitor": self._handle.pid}

    def status(self) -> dict[str, Any] | None:
        """Return the state of both blocks with a sentence; None without a monitor."""
        if self._handle is None:
            return None
        found = self._handle.status()
        return {**found, "sentence": format_monitor(found)}

    def begin_run(self, name: str, ring: Path) -> None:
        """Let the monitor follow a run."""
        if self._handle is not None:
            self._handle.begin_run(name, ring)

    def _take(self, report: Mapping[str, Any]) -> None:
        details = {k: v for k, v in report.items() if k != "kind"}
        match report["kind"]:
            case "alarm":
                text = format_alarm(report)
                self._announce("monitor alarm", text=text, **details)
                self._note(text)
                if self._trip is not None:
                    self._trip(f"monitor: {text}")
            case "alarm over":
                text = f"the {report['block']} block is back at its floor"
                self._announce("monitor alarm over", text=text, **details)
                self._note(text)
            case "explained":
                self._announce("monitor explanation", text=report["sentence"], **details)
                self._note(report["sentence"])
            case "ended":
                self._announce("monitor ended", text=report["problem"])

    def _note(self, text: str) -> None:
        with suppress(RequestRefusedError):  # nothing is being logged
            self._mark(f"monitor: {text}"[:LONGEST_REMARK])

    def close(self) -> None:
        """End the monitor."""
        if self._handle is not None:
            self._handle.close()
