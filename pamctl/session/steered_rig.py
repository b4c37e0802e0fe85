"""A rig that a program steers, whether a daemon drives it or it is simulated here.

    with pamctl.connect() as rig:            # or pamctl.simulate("paper")
        rig.goto(12e-3)
        run = rig.run(pamctl.Sine(offset_mm=12, amplitude_mm=2, frequency_hz=1))
    print(run.metrics.rms_error_m)

The verbs are those of the shell, and so are the rules: what a rig refuses changes nothing and
raises `PamctlError` with the shell's line and exit code. Positions are in m, times in s.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeVar

from pamctl.base.errors import ExitCode
from pamctl.daemon.client import DaemonDeclinedError
from pamctl.daemon.protocol import RequestRefusedError, list_orders
from pamctl.daemon.rig_session import DEFAULT_RAMP_S, RigSession
from pamctl.log.run_meta import file_safe_name
from pamctl.session.experiment_form import ExperimentForm, read_experiment
from pamctl.session.pamctl_error import PamctlError, translate_errors
from pamctl.session.run import Run
from pamctl.signals import Phase

AskedExperiment: TypeAlias = ExperimentForm | Mapping[str, Any] | str | Path
"""A form such as `Sine`, the keys of an experiment file, a shipped experiment's name, or a file."""
Gain: TypeAlias = float | int | bool | str

_Self = TypeVar("_Self", bound="SteeredRig")
_STOP_PATIENCE_S = 30.0
_SAME_M = 1e-9


class Sight(Protocol):
    """What a wait looks at."""

    @property
    def log(self) -> str | None:
        """The log of the current run."""

    @property
    def tick(self) -> Mapping[str, float] | None:
        """The newest tick's columns by name."""

    @property
    def has_loop(self) -> bool:
        """The loop lives."""


Goal: TypeAlias = Callable[[Sight], bool]


class Link(Protocol):
    """How a program reaches a rig's session: through the daemon's socket, or in this process."""

    is_own: bool
    """The session ends with its program."""

    @property
    def has_end(self) -> bool:
        """The current run ends by itself, or others may end it."""

    def ask(self, name: str, params: Mapping[str, object]) -> Any:
        """Give an order, as the protocol has it; return the answer."""

    def ask_at_once(self, name: str) -> Any:
        """Give an order that waits for no other one, from any thread."""

    def wait_until(self, goal: Goal, patience_s: float = math.inf) -> None:
        """Let time pass on the rig until a goal is reached."""

    def sleep(self, duration_s: float) -> None:
        """Let time pass on the rig (s)."""

    def follow(self, every: int) -> Iterator[Mapping[str, float]]:
        """Yield every so manieth tick until the run ends."""

    def close(self) -> None:
        """Leave the session."""


class SteeredRig:
    """A rig under a program's control; leave its `with` block to leave the rig safe."""

    def __init__(self, link: Link) -> None:
        """Steer the rig behind `link`."""
        self._link = link
        self._own_log: Path | None = None
        self._is_beginning = False
        self._is_open = True

    # --- motions ------------------------------------------------------------------------------

    def run(
        self,
        experiment: AskedExperiment,
        *,
        name: str | None = None,
        duration_s: float | None = None,
    ) -> Run:
        """Run an experiment to its end; home first where needed. Return its record.

        `name` is for the log's file name; `duration_s` ends the run that long after homing. If it
        does not end well, `PamctlError` says why, and its `log` names the record. An exception
        meanwhile, such as Ctrl-C, stops the run smoothly.
        """
        data, name = self._read(experiment, name)
        _require_end(data, duration_s)
        try:
            self.start(data, name=name, duration_s=duration_s)
            return self.wait()
        except PamctlError:
            raise
        except BaseException:
            self._stop_own_run("interrupted")
            raise

    def start(
        self,
        experiment: AskedExperiment,
        *,
        name: str | None = None,
        duration_s: float | None = None,
    ) -> Path:
        """Begin a run and return the path of its log; `live` and `wait` go on from there."""
        data, name = self._read(experiment, name)
        return self._begin("start", experiment=data, name=name, duration_s=duration_s)

    def wait(self) -> Run:
        """Wait for the end of the run that was begun here; return its record."""
        log = self._own_log
        if log is None:
            raise PamctlError("no run was begun here; begin one with start()", ExitCode.USAGE)
        if not self._link.has_end and self.status()["log"] == str(log):
            raise PamctlError("a held position has no end; stop() ends it", ExitCode.USAGE)
        self._await_over(str(log))
        require_well(self.status(), log)
        with translate_errors():
            return Run.open(log)

    def goto(self, position_m: float, *, within_s: float | None = None) -> None:
        """Go to a position (m) and hold it; return on arrival. Home first where needed.

        The motion takes `within_s` [default: as long as 4 mm/s takes].
        """
        try:
            log = str(self._begin("goto", position_m=float(position_m), within_s=within_s))
            self._wait_until(lambda seen: seen.log != log or _is_held_at(position_m, seen.tick))
            if require_well(self.status())["log"] != log:
                raise PamctlError("the motion was stopped", ExitCode.CHECK_FAILED, Path(log))
        except PamctlError:
            raise
        except BaseException:
            self._stop_own_run("interrupted")
            raise

    def sleep(self, duration_s: float) -> None:
        """Let time pass on the rig (s): of the clock, or simulated time."""
        with translate_errors():
            self._link.sleep(duration_s)

    def live(
        self, rate_hz: float = 50.0, *, duration_s: float | None = None
    ) -> Iterator[Mapping[str, float]]:
        """Yield the rig's newest ticks in order, each as its columns by name, in SI.

        It ends with the run, or after `duration_s`; a held position has no end. A daemon's ticks
        come as they are measured, and a reader slower than some 2 s misses some. A simulated rig
        goes on only as far as its reader asks.
        """
        ticks_per_s = require_well(self.status())["rate_hz"]
        every = max(1, round(ticks_per_s / rate_hz))
        most = None if duration_s is None else round(duration_s * ticks_per_s / every)
        with translate_errors():
            yield from islice(self._link.follow(every), most)

    # --- gains and remarks ----------------------------------------------------------------------

    def set(self, /, *, ramp_s: float = DEFAULT_RAMP_S, **gains: Gain) -> dict[str, Any]:
        """Change gains by their keys, `rig.set(lambda_per_s=90)`, on a ramp; return all gains."""
        changes = [f"controller.{key}={_write_value(value)}" for key, value in gains.items()]
        changed: dict[str, Any] = self._ask("set", changes=changes, ramp_s=float(ramp_s))
        return changed

    def load(
        self,
        controller: str | Path | Mapping[str, Any],
        *,
        ramp_s: float = DEFAULT_RAMP_S,
    ) -> dict[str, Any]:
        """Take the gains of a controller: a shipped name, a file, or its keys; return all gains.

        Another law can be loaded only between runs.
        """
        if isinstance(controller, Mapping):
            data, name = dict(controller), "session"
        else:
            with translate_errors():
                data = _read_section("controller", str(controller))
            name = file_safe_name(str(controller))
        gains: dict[str, Any] = self._ask("load", controller=data, name=name, ramp_s=float(ramp_s))
        return gains

    @property
    def gains(self) -> dict[str, Any]:
        """The controller in use, with the keys of its file."""
        controller: dict[str, Any] = self.status()["controller"]
        return controller

    def mark(self, text: str) -> None:
        """Put a remark into the log of the current run."""
        self._ask("mark", text=str(text))

    # --- states ---------------------------------------------------------------------------------

    def status(self) -> dict[str, Any]:
        """Return state, run, log, newest tick and gains, as `pamctl status --json` prints them."""
        answer: dict[str, Any] = self._ask("status")
        return answer

    def settings(self) -> dict[str, Any]:
        """Return what the rig is set to, as its logs hold it: rig, limits, plant, gains."""
        answer: dict[str, Any] = self._ask("settings")
        return answer

    @property
    def state(self) -> str:
        """One of idle, homing, ready, running, stopping, fault."""
        return str(self.status()["state"])

    def stop(self) -> None:
        """End the current run smoothly; return when its log is whole. The muscle stays homed."""
        self._ask("stop")
        self._await_over(self.status()["log"])

    def disarm(self) -> None:
        """End the session smoothly; the next run homes again."""
        self._ask("disarm")

    def estop(self) -> None:
        """Drive the safe voltage at once, and latch the fault; callable from any thread."""
        with translate_errors():
            self._link.ask_at_once("estop")

    def ack(self) -> str:
        """Acknowledge a fault, so that the rig runs again; return what it was."""
        if self.status()["fault"]:  # the loop may still be ending
            self._wait_until(lambda seen: not seen.has_loop, _STOP_PATIENCE_S)
        return str(self._ask("ack")["fault"])

    # --- the end --------------------------------------------------------------------------------

    def close(self) -> None:
        """Stop what was begun here and leave the rig safe; does nothing the second time.

        Runs of other clients of a daemon go on.
        """
        if not self._is_open:
            return
        try:
            if not self._link.is_own:
                self._stop_own_run()
        finally:
            self._is_open = False
            with translate_errors():
                self._link.close()

    def __enter__(self: _Self) -> _Self:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop what was begun here and leave the rig safe, whatever has happened."""
        try:
            self.close()
        except PamctlError as failure:
            if error is None:
                raise
            error.add_note(f"leaving the rig: {failure}")

    # --- orders ---------------------------------------------------------------------------------

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Callable[..., Any]:
            """Give any order of the session by its name, with the parameters of its signature."""
            told = None if name.startswith("_") else list_orders(RigSession).get(name)
            if told is None:
                raise AttributeError(f"a rig has no {name!r}")
            return lambda *args, **options: self._ask(
                name, **told.signature.bind(*args, **options).arguments
            )

    def _ask(self, order: str, /, **params: object) -> Any:
        with translate_errors():
            return self._link.ask(order, params)

    def _begin(self, order: str, /, **params: object) -> Path:
        """Ask for a motion, and return its log. Ctrl-C may come before the answer does."""
        self._is_beginning = True
        try:
            log = Path(self._ask(order, **params)["log"])
        except PamctlError:
            self._is_beginning = False
            raise
        self._own_log, self._is_beginning = log, False
        return log

    def _wait_until(self, goal: Goal, patience_s: float = math.inf) -> None:
        with translate_errors():
            self._link.wait_until(goal, patience_s)

    def _await_over(self, log: str | None, patience_s: float = math.inf) -> None:
        """Return once this log is whole."""
        if log is not None:
            self._wait_until(lambda seen: seen.log != log, patience_s)

    def _stop_own_run(self, reason: str = "stopped by request") -> None:
        """Stop what this object began, if it still runs."""
        log = None if self._own_log is None else str(self._own_log)
        if not self._is_beginning and (log is None or self.status()["log"] != log):
            return
        # Orders are carried out one after the other: a motion that was just asked for has begun
        # when the session comes to this one.
        self._is_beginning = False
        try:
            self._ask("stop", reason=reason)
        except PamctlError as error:
            if not isinstance(error.__cause__, DaemonDeclinedError | RequestRefusedError):
                raise
            return  # it has just ended by itself
        self._await_over(self.status()["log"], _STOP_PATIENCE_S)

    def _read(self, experiment: AskedExperiment, name: str | None) -> tuple[dict[str, Any], str]:
        """Return the checked keys of an experiment, and its name."""
        if isinstance(experiment, str | Path):
            with translate_errors():
                data = _read_section("experiment", str(experiment))
            return data, file_safe_name(name or str(experiment))
        if isinstance(experiment, ExperimentForm):
            return experiment.to_data(), file_safe_name(name or experiment.KIND)
        data = read_experiment(experiment, "experiment")
        return data, file_safe_name(name or str(data["kind"]))


def require_well(status: Mapping[str, Any], log: Path | None = None) -> Mapping[str, Any]:
    """Return a status; raise the fault that it has, of the run with this log."""
    if not status["fault"]:
        return status
    code = ExitCode.SAFETY_TRIP
    for event in status["events"]:
        if event["event"] == "fault":
            code = ExitCode(event["code"])
        elif event["event"] == "acknowledged":
            code = ExitCode.SAFETY_TRIP
    raise PamctlError(f"{status['fault']}; acknowledge it with ack()", code, log)


def _is_held_at(position_m: float, tick: Mapping[str, float] | None) -> bool:
    """Tell whether the motion has ended: until its first tick, the newest one is before it."""
    if tick is None or tick["phase"] != Phase.REST:
        return False
    return abs(tick["reference_m"] - position_m) < _SAME_M


def _read_section(section: str, name: str) -> dict[str, Any]:
    from pamctl.settings.config_files import find_config_file, read_section

    return read_section(section, find_config_file(section, name, section))


def _require_end(data: Mapping[str, Any], duration_s: float | None) -> None:
    """Refuse to wait for the end of a motion that has none."""
    from pydantic import TypeAdapter

    from pamctl.control.experiment import ExperimentSettings, plan_experiment

    adapter: TypeAdapter[Any] = TypeAdapter(ExperimentSettings)
    try:
        lasts_s = plan_experiment(adapter.validate_python(data)).duration_s
    except ValueError as error:
        raise PamctlError(f"the experiment {error}", ExitCode.CHECK_FAILED) from error
    if duration_s is None and math.isinf(lasts_s):
        fix = "give hold_s or duration_s, or use goto() or start()"
        raise PamctlError(f"this experiment has no end to wait for; {fix}", ExitCode.USAGE)


def _write_value(value: Gain) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    to_scalar = getattr(value, "item", None)  # a number of numpy
    return str(value if to_scalar is None else to_scalar())
