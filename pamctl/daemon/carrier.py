"""What carries a session's loop: processes of its own, or this process."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from pamctl.exit_codes import Ending
from pamctl.log.run_meta import RunMeta
from pamctl.recording.recorded_run import LogReport, RecordedRun
from pamctl.settings.resolve import RunSettings
from pamctl.signals import Phase


class Carrier(Protocol):
    """A living loop, and the current run in it."""

    runs_begun: int

    @property
    def run(self) -> RecordedRun | None:
        """The current run; its log is whole once there is none."""

    @property
    def is_alive(self) -> bool:
        """The loop has not ended."""

    @property
    def phase(self) -> Phase | None:
        """Phase of the current run; None before its first tick, and between runs."""

    @property
    def worst_late_s(self) -> float:
        """The worst wake-up of the current run, or between runs (s)."""

    @property
    def missed_ticks(self) -> int:
        """Ticks missed in the current run, or between runs."""

    @property
    def pids(self) -> dict[str, int]:
        """Process ids, by role."""

    def latest_tick(self) -> dict[str, float] | None:
        """Return the newest tick's columns by name."""

    def recent_ticks(self, after: int, every: int, most: int) -> list[dict[str, float]]:
        """Return the newest `most` ticks after `after` whose number `every` divides, in order."""

    def look(self) -> None:
        """See whether all that belongs to the loop lives; any thread may call it."""

    def order(self, order: Mapping[str, Any]) -> None:
        """Return when the loop has taken an order; raise `RequestRefusedError` if it does not."""

    def begin(self, name: str, meta: RunMeta, rows: int, course: bytes) -> None:
        """Begin a run with its own log, on a course that is packed for the loop.

        Raises `RequestRefusedError` if the log cannot be written.
        """

    def stop_now(self) -> None:
        """Demand the emergency stop; the loop ends."""

    def finish_run(self) -> LogReport | None:
        """Finish the log of a run that is over."""

    def begin_end(self) -> None:
        """Begin to end the loop smoothly; return at once."""

    def close(self) -> Ending:
        """End the loop; return how it ended. The valve is safe afterwards."""


class CarrierMaker(Protocol):
    """How the loop of a rig is started."""

    @property
    def device(self) -> str:
        """The name of the device."""

    def begin(self, settings: RunSettings, names: Mapping[str, str]) -> Carrier:
        """Start a loop; raise `RequestRefusedError` if it does not start."""

    def make_safe(self) -> None:
        """Drive the safe voltage where no loop is left to do it."""
