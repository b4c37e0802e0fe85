"""The simulated rig, without a daemon and as fast as it goes."""

from __future__ import annotations

import atexit
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

from pamctl.control.experiment import HoldSettings
from pamctl.daemon.protocol import RequestRefusedError
from pamctl.daemon.requested_settings import (
    change_gains,
    load_controller,
    load_experiment,
    plan_hold,
    require_feasible,
    require_tunable,
)
from pamctl.daemon.service import DaemonState
from pamctl.exit_codes import EMERGENCY_STOP, ExitCode
from pamctl.log.run_meta import file_safe_name
from pamctl.new_file import require_folder
from pamctl.session.pamctl_error import PamctlError, translate_errors
from pamctl.session.simulated_loop import SimulatedLoop, is_at_rest_at, is_resting
from pamctl.session.steered_rig import InterruptedWaitError, SteeredRig
from pamctl.settings.resolve import (
    SECTIONS,
    RawSettings,
    RunSettings,
    resolve,
    settings_to_data,
    validate_settings,
)
from pamctl.settings.table_file import read_tables
from pamctl.signals import Phase

if TYPE_CHECKING:
    from pamctl.plant.model import PlantSettings

AskedSection = str | Path | Mapping[str, Any]
"""A shipped name, a file, or the keys of one."""
_RESOLVING = Lock()
"""One thread at a time loads the laws, builds the models, and tries the folder of the logs."""


def simulate(
    plant: AskedSection | PlantSettings = "paper",
    *,
    controller: AskedSection = "qsmc",
    rig: str | Path = "sim",
    seed: int = 0,
    overrides: Sequence[str] = (),
    logs: str | Path = "logs",
) -> SimulatedRig:
    """Simulate a rig with this plant; without a clock, and from the vented muscle on.

    `plant` and `controller` are shipped names, files, or their keys; `plant` is also what a
    diagnosis returns. `overrides` read `rig.homing.fills=1`, as `--set` of `pamctl run` does;
    `seed` is of the sensors' noise; the folder `logs` gets a log of each run.
    Raises `PamctlError` for settings that cannot be used.
    """
    with translate_errors(), _RESOLVING:
        resolved = resolve_session(plant, controller, str(rig), seed, overrides)
        return SimulatedRig(*resolved, Path(logs))


class SimulatedRig(SteeredRig):
    """The loop of the daemon on the simulated rig, within this process.

    Time passes only while a method waits for it. When it is closed, the current run stops
    smoothly and its log is whole.
    """

    def __init__(self, settings: RunSettings, names: Mapping[str, str], logs: Path) -> None:
        """Begin idle; raise `NewFileError` where the logs cannot be written."""
        require_folder(logs)
        logs.mkdir(parents=True, exist_ok=True)
        self._settings, self._names, self._logs = settings, dict(names), logs
        self._loop: SimulatedLoop | None = None
        self._fault = ""
        self._name = ""
        self._holds = self._is_interrupted = False
        self._own_log: Path | None = None
        self._is_open = True
        atexit.register(self.close)

    # --- states ---------------------------------------------------------------------------------

    def status(self) -> dict[str, Any]:
        """Return state, run, log, newest tick and gains."""
        loop = self._loop
        log = None if loop is None else loop.run_path
        return {
            "state": str(self._find_state()),
            "fault": self._fault,
            "run": None if log is None else self._name,
            "log": None if log is None else str(log),
            "tick": None if loop is None else loop.last,
            "controller": settings_to_data(self._settings.controller),
            "names": dict(self._names),
            "backend": self._settings.rig.backend,
            "rate_hz": self._settings.rig.loop.rate_hz,
        }

    def settings(self) -> dict[str, Any]:
        """Return the settings of the session."""
        return settings_to_data(self._settings)

    def _find_state(self) -> DaemonState:
        loop = self._loop
        if self._fault:
            return DaemonState.FAULT
        if loop is None:
            return DaemonState.IDLE
        if loop.run_path is None or loop.last is None:
            return DaemonState.READY
        if self._holds and is_resting(loop.last):
            return DaemonState.READY
        homing = loop.last["phase"] == Phase.HOMING
        return DaemonState.HOMING if homing else DaemonState.RUNNING

    def mark(self, text: str) -> None:
        """Put a remark into the log of the current run."""
        with translate_errors():
            self._require_run("nothing is being logged; start a run, or go to a position").advance(
                lambda loop: True, {"do": "mark", "text": str(text)}
            )

    def stop(self) -> None:
        """End the current run smoothly; its log is whole then."""
        with translate_errors():
            loop = self._require_run(f"nothing is running: the state is {self.state}")
            loop.advance(_is_over, {"do": "stop", "reason": "stopped by request"})
            self._conclude()

    def disarm(self) -> None:
        """End the session smoothly; the next run homes again, from the vented muscle."""
        with translate_errors():
            self._end_loop(at_once=False)

    def estop(self) -> None:
        """End at the safe voltage at once, and latch the fault."""
        with translate_errors():
            self._fault = self._fault or EMERGENCY_STOP
            self._end_loop(at_once=True)

    def ack(self) -> str:
        """Acknowledge a fault; return what it was."""
        with translate_errors():
            if not self._fault:
                raise RequestRefusedError("there is no fault to acknowledge")
            fault, self._fault = self._fault, ""
            return fault

    def sleep(self, duration_s: float) -> None:
        """Let simulated time pass (s); none passes while the rig is idle."""
        with translate_errors():
            if self._loop is not None:
                ticks = max(1, round(duration_s * self._settings.rig.loop.rate_hz))
                self._let_pass_until(self._tick_now() + ticks)
                self._conclude()

    def live(
        self, rate_hz: float = 50.0, *, duration_s: float | None = None
    ) -> Iterator[Mapping[str, float]]:
        """Yield a tick, let time pass to the next one, and so on until the run ends."""
        ticks_per_s = self._settings.rig.loop.rate_hz
        every = max(1, round(ticks_per_s / rate_hz))
        left = math.inf if duration_s is None else round(duration_s * ticks_per_s / every)
        at = self._tick_now()
        while left > 0 and self._loop is not None and self._loop.is_running:
            with translate_errors():
                # Marks and gains take a tick each: they do not shift the ticks that follow.
                at += every * max(1, -(-(self._tick_now() + 1 - at) // every))
                self._let_pass_until(at)
                tick = self._loop.last
                goes_on = self._loop.is_running
                self._conclude()
            if not goes_on or tick is None:
                return
            yield tick
            left -= 1

    def interrupt(self) -> None:
        """End what waits in another thread."""
        self._is_interrupted = True

    def close(self) -> None:
        """Stop smoothly; the log of the current run is whole then."""
        if not self._is_open:
            return
        self._is_open = False
        atexit.unregister(self.close)
        self._is_interrupted = False
        with translate_errors():
            self._end_loop(at_once=False)

    # --- what the rig does ----------------------------------------------------------------------

    def _start(self, data: dict[str, Any], name: str, duration_s: float | None) -> Path:
        self._require_state(DaemonState.IDLE, DaemonState.READY)
        settings = load_experiment(self._settings, data, name, duration_s)
        require_feasible(settings)
        experiment = settings_to_data(settings.experiment)
        order = {"do": "run", "experiment": experiment, "duration_s": duration_s}
        loop = self._loop = self._loop or self._make_loop()
        self._name, self._holds = name, isinstance(settings.experiment, HoldSettings)
        self._own_log = loop.begin_run(order, settings, name)
        return self._own_log

    def _goto(self, position_m: float, within_s: float | None) -> None:
        self._require_state(DaemonState.IDLE, DaemonState.READY, DaemonState.RUNNING)
        last = None if self._loop is None else self._loop.last
        here_m = 0.0 if last is None else last["position_m"]
        hold = plan_hold(self._settings, position_m, within_s, here_m)
        loop = self._loop
        if loop is None or loop.run_path is None:
            self._start(hold, "goto", None)
            order = None
        elif self._holds:
            order = {"do": "run", "ring": None, "experiment": hold, "duration_s": None}
        else:
            raise RequestRefusedError(f"{self._name} is running; stop it first")
        loop = self._loop
        assert loop is not None
        self._advance(loop, is_at_rest_at(hold["position_mm"] * 1e-3), order)
        self._conclude()

    def _wait_for_end(self) -> Path:
        if self._own_log is None:
            raise PamctlError("no run was begun here; begin one with start()", ExitCode.USAGE)
        if self._loop is not None and self._loop.run_path == self._own_log:
            if self._holds:
                self._require_hold_to_end()
            self._advance(self._loop, _is_over, None)
            self._conclude()
        return self._own_log

    def _require_hold_to_end(self) -> None:
        assert self._loop is not None
        last = self._loop.last
        if last is not None and is_resting(last):
            raise PamctlError("a held position has no end; stop() ends it", ExitCode.USAGE)

    def _change_gains(self, changes: list[str], ramp_s: float) -> dict[str, Any]:
        return self._tune(change_gains(self._settings, changes), ramp_s)

    def _load_gains(self, data: dict[str, Any], name: str, ramp_s: float) -> dict[str, Any]:
        gains = self._tune(load_controller(self._settings, data, name), ramp_s)
        self._names["controller"] = name
        return gains

    def _tune(self, changed: RunSettings, ramp_s: float) -> dict[str, Any]:
        if not 0.0 <= ramp_s <= 60.0:
            raise RequestRefusedError(f"ramp_s {ramp_s:g} must lie between 0 and 60 s")
        controller = settings_to_data(changed.controller)
        loop = self._loop
        if loop is not None:
            if loop.is_running:
                require_tunable(self._settings, changed)
            order = {"do": "gains", "controller": controller, "ramp_s": ramp_s}
            self._advance(loop, lambda _: True, order)
        self._settings = changed
        if loop is not None:
            self._conclude()
        return controller

    # --- the life of the loop -------------------------------------------------------------------

    def _make_loop(self) -> SimulatedLoop:
        return SimulatedLoop(self._settings, self._names, self._logs)

    def _tick_now(self) -> int:
        last = None if self._loop is None else self._loop.last
        return -1 if last is None else int(last["tick"])

    def _let_pass_until(self, tick: int) -> None:
        assert self._loop is not None
        was_running = self._loop.is_running

        def is_reached(loop: SimulatedLoop) -> bool:
            return (was_running and not loop.is_running) or self._tick_now() >= tick

        self._advance(self._loop, is_reached, None)

    def _advance(self, loop: SimulatedLoop, goal: Any, order: Mapping[str, Any] | None) -> None:
        loop.advance(lambda at: self._is_interrupted or goal(at), order)
        if self._is_interrupted:
            self._is_interrupted = False
            raise InterruptedWaitError

    def _conclude(self) -> None:
        """Finish the log of a run that is over; raise the fault that has ended the loop."""
        loop = self._loop
        if loop is None or loop.is_running:
            return
        loop.finish_run()
        self._holds = False
        if loop.ending is not None:
            ending = loop.close()
            self._loop, self._fault = None, ending.reason
            reason = f"{ending.reason}; acknowledge it with ack()"
            raise PamctlError(reason, ending.code, self._own_log)

    def _end_loop(self, *, at_once: bool) -> None:
        loop, self._loop = self._loop, None
        self._holds = False
        if loop is not None:
            loop.close(at_once=at_once)

    def _stop_own_run(self) -> None:
        loop = self._loop
        if loop is not None and loop.is_running:
            loop.advance(_is_over, {"do": "stop", "reason": "interrupted"})
            self._conclude()

    def _require_run(self, otherwise: str) -> SimulatedLoop:
        if self._loop is None or not self._loop.is_running:
            raise RequestRefusedError(otherwise)
        return self._loop

    def _require_state(self, *allowed: DaemonState) -> None:
        if not self._is_open:
            raise PamctlError("this simulation is closed; begin another", ExitCode.USAGE)
        state = self._find_state()
        if state == DaemonState.FAULT:
            raise RequestRefusedError(f"fault: {self._fault}; acknowledge it first with ack()")
        if state not in allowed:
            raise RequestRefusedError(f"not now: the state is {state}")


def _is_over(loop: SimulatedLoop) -> bool:
    return not loop.is_running


def resolve_session(
    plant: AskedSection | PlantSettings,
    controller: AskedSection,
    rig: str,
    seed: int,
    overrides: Sequence[str],
) -> tuple[RunSettings, dict[str, str]]:
    """Return the settings of the session, and the names of its files; raise `ConfigError`."""
    controller_name = None if isinstance(controller, Mapping) else str(controller)
    plant_name = str(plant) if isinstance(plant, str | Path) else None
    settings = resolve(
        controller=controller_name,
        plant=plant_name,
        rig=rig,
        overrides=overrides,
        seed=seed,
        fast=True,
        prepare=read_tables,
    )
    changed: dict[str, Any] = {}
    if isinstance(controller, Mapping):
        changed["controller"] = _validate("controller", controller)
    if isinstance(plant, Mapping):
        changed["plant"] = _validate("plant", plant)
    elif not isinstance(plant, str | Path):
        changed["plant"] = plant
    if changed:
        settings = settings.model_copy(update=changed)
        settings = RunSettings.model_validate(settings.model_dump())
    if not settings.rig.record.is_simulated:
        reason = f"the rig {rig} is not simulated; start `pamctl daemon`, then use connect()"
        raise PamctlError(reason, ExitCode.USAGE)
    names = {
        "controller": file_safe_name(controller_name or "session"),
        "plant": plant_name or "session",
        "rig": rig,
    }
    return settings, names


def _validate(section: str, data: Mapping[str, Any]) -> Any:
    return validate_settings(SECTIONS[section], RawSettings({**data}, {(): section}), title=section)
