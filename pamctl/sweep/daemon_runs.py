"""Make the runs of a sweep through the daemon: homed once, its gains changed between runs."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any

from pamctl.daemon.client import Client, DaemonDeclinedError
from pamctl.daemon.protocol import RequestRefusedError
from pamctl.daemon.requested_settings import change_gains, load_controller
from pamctl.exit_codes import Ending, ExitCode
from pamctl.log.annotation import Annotation
from pamctl.runs.run_row import read_row
from pamctl.settings.resolve import RunSettings, settings_to_data
from pamctl.sweep.run_sweep import SweepPlan
from pamctl.sweep.sweep_plan import SweepError, SweepRequest, SweepRun, list_runs

_LOOK_EVERY_S = 0.1


class DaemonRunner:
    """Asks a daemon for each run; a context manager that puts the gains back at its end."""

    def __init__(self, client: Client, settings: RunSettings, name: str) -> None:
        """Of `settings` only experiment and duration count; `name` is that of the experiment.

        Raise SweepError where the daemon is not free.
        """
        self._client, self._settings, self._name = client, settings, name
        self._experiment = settings_to_data(settings.experiment)
        status = client.call("status")
        if status["state"] not in ("idle", "ready") or status["run"] is not None:
            raise SweepError(f"the daemon is not free: its state is {status['state']}")
        self._gains: dict[str, Any] = status["controller"]
        self._folder = Path(status["logs"])
        self._device = status["device"]
        self._names = status["names"]

    def plan_sweep(
        self, request: SweepRequest, repeats: int, name: str, said: Annotation
    ) -> SweepPlan:
        """Return what is to be run; raise SweepError where the daemon could not run it."""
        others = [one.key for one in request.swept if not one.key.startswith("controller.")]
        if wrong := [*others, *request.fixed]:
            why = "on the daemon only keys of the controller are swept, and nothing else is set"
            raise SweepError(f"--set {wrong[0]}: {why}")
        known = {
            "controller": self._gains,
            "experiment": self._experiment,
            "duration_s": self._settings.duration_s,
            "device": self._device,
        }
        try:
            now = load_controller(self._settings, self._gains, "the gains of the daemon")
            changed = [change_gains(now, point) for point in request.list_points()]
        except RequestRefusedError as error:
            raise SweepError(str(error)) from error
        points = [request.read_point(settings_to_data(settings)) for settings in changed]
        mark = request.mark_base(known)
        return SweepPlan(name, mark, list_runs(points, repeats), self._folder, said)

    @property
    def goes_on(self) -> bool:
        """A fault of the daemon waits for a person, who acknowledges it."""
        return False

    def __enter__(self) -> DaemonRunner:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Put the gains back."""
        with suppress(DaemonDeclinedError):
            params = {"controller": self._gains, "name": self._names["controller"], "ramp_s": 0.0}
            self._client.call("load", params)

    def __call__(self, run: SweepRun, said: Annotation, record: Mapping[str, str]) -> Ending:
        """Set the gains, start, and wait for the log; an interrupt stops the run smoothly."""
        changes = [f"{key}={value}" for key, value in run.point.items()]
        self._client.call("set", {"changes": changes, "ramp_s": 0.0})
        log = Path(
            self._client.call(
                "start",
                {
                    "experiment": self._experiment,
                    "name": self._name,
                    "duration_s": self._settings.duration_s,
                    **asdict(said),
                    "sweep": record,
                },
            )["log"]
        )
        try:
            status = self._await_end(log)
        except KeyboardInterrupt:
            with suppress(DaemonDeclinedError):
                self._client.call("stop")
            self._await_end(log)
            raise
        row = read_row(log)
        code = ExitCode.UNEXPECTED if row.exit_code is None else ExitCode(row.exit_code)
        return Ending(code, status["fault"] or row.reason)

    def _await_end(self, log: Path) -> dict[str, Any]:
        while True:
            status: dict[str, Any] = self._client.call("status")
            if status["log"] != str(log):
                return status
            time.sleep(_LOOK_EVERY_S)
