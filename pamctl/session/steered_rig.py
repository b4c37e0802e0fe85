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
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, TypeAlias, TypeVar

from pamctl.exit_codes import ExitCode
from pamctl.session.experiment_form import ExperimentForm, read_experiment
from pamctl.session.pamctl_error import PamctlError, translate_errors
from pamctl.session.run import Run

AskedExperiment: TypeAlias = ExperimentForm | Mapping[str, Any] | str | Path
"""A form such as `Sine`, the keys of an experiment file, a shipped experiment's name, or a file."""
Gain: TypeAlias = float | int | bool | str

DEFAULT_RAMP_S = 0.5

_Self = TypeVar("_Self", bound="SteeredRig")


class SteeredRig(ABC):
    """A rig under a program's control; leave its `with` block to leave the rig safe."""

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
            self._stop_own_run()
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
        with translate_errors():
            return self._start(data, name, duration_s)

    def wait(self) -> Run:
        """Wait for the end of the run that was begun here; return its record."""
        with translate_errors():
            return Run.open(self._wait_for_end())

    def goto(self, position_m: float, *, within_s: float | None = None) -> None:
        """Go to a position (m) and hold it; return on arrival. Home first where needed.

        The motion takes `within_s` [default: as long as 4 mm/s takes].
        """
        try:
            with translate_errors():
                self._goto(float(position_m), within_s)
        except PamctlError:
            raise
        except BaseException:
            self._stop_own_run()
            raise

    @abstractmethod
    def sleep(self, duration_s: float) -> None:
        """Let time pass on the rig (s): of the clock, or simulated time."""

    @abstractmethod
    def live(
        self, rate_hz: float = 50.0, *, duration_s: float | None = None
    ) -> Iterator[Mapping[str, float]]:
        """Yield the rig's newest ticks in order, each as its columns by name, in SI.

        It ends with the run, or after `duration_s`; a held position has no end. A daemon's ticks
        come as they are measured, and a reader slower than some 2 s misses some. A simulated rig
        goes on only as far as its reader asks.
        """

    # --- gains and remarks ----------------------------------------------------------------------

    def set(self, /, *, ramp_s: float = DEFAULT_RAMP_S, **gains: Gain) -> dict[str, Any]:
        """Change gains by their keys, `rig.set(lambda_per_s=90)`, on a ramp; return all gains."""
        changes = [f"controller.{key}={_write_value(value)}" for key, value in gains.items()]
        with translate_errors():
            return self._change_gains(changes, ramp_s)

    def load(
        self,
        controller: str | Path | Mapping[str, Any],
        *,
        ramp_s: float = DEFAULT_RAMP_S,
    ) -> dict[str, Any]:
        """Take the gains of a controller: a shipped name, a file, or its keys; return all gains.

        Another law can be loaded only between runs.
        """
        from pamctl.log.run_meta import file_safe_name

        with translate_errors():
            if isinstance(controller, Mapping):
                return self._load_gains(dict(controller), "session", ramp_s)
            data = _read_section("controller", str(controller))
            return self._load_gains(data, file_safe_name(str(controller)), ramp_s)

    @property
    def gains(self) -> dict[str, Any]:
        """The controller in use, with the keys of its file."""
        controller: dict[str, Any] = self.status()["controller"]
        return controller

    @abstractmethod
    def mark(self, text: str) -> None:
        """Put a remark into the log of the current run."""

    # --- states ---------------------------------------------------------------------------------

    @abstractmethod
    def status(self) -> dict[str, Any]:
        """Return state, run, log, newest tick and gains, as `pamctl status --json` prints them."""

    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """Return what the rig is set to, as its logs hold it: rig, limits, plant, gains."""

    @property
    def state(self) -> str:
        """One of idle, homing, ready, running, stopping, fault."""
        return str(self.status()["state"])

    @abstractmethod
    def stop(self) -> None:
        """End the current run smoothly; return when its log is whole. The muscle stays homed."""

    @abstractmethod
    def disarm(self) -> None:
        """End the session smoothly; the next run homes again."""

    @abstractmethod
    def estop(self) -> None:
        """Drive the safe voltage at once, and latch the fault; callable from any thread."""

    @abstractmethod
    def ack(self) -> str:
        """Acknowledge a fault, so that the rig runs again; return what it was."""

    # --- the end --------------------------------------------------------------------------------

    @abstractmethod
    def close(self) -> None:
        """Stop what was begun here and leave the rig safe; does nothing the second time."""

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

    # --- what the two kinds of rigs do ----------------------------------------------------------

    @abstractmethod
    def interrupt(self) -> None:
        """End `run`, `wait`, `goto` and `sleep` in the thread that waits; from any thread."""

    @abstractmethod
    def _start(self, data: dict[str, Any], name: str, duration_s: float | None) -> Path: ...

    @abstractmethod
    def _wait_for_end(self) -> Path: ...

    @abstractmethod
    def _goto(self, position_m: float, within_s: float | None) -> None: ...

    @abstractmethod
    def _change_gains(self, changes: list[str], ramp_s: float) -> dict[str, Any]: ...

    @abstractmethod
    def _load_gains(self, data: dict[str, Any], name: str, ramp_s: float) -> dict[str, Any]: ...

    @abstractmethod
    def _stop_own_run(self) -> None:
        """Stop what this object began, if it still runs."""

    def _read(self, experiment: AskedExperiment, name: str | None) -> tuple[dict[str, Any], str]:
        """Return the checked keys of an experiment, and its name."""
        from pamctl.log.run_meta import file_safe_name

        if isinstance(experiment, str | Path):
            with translate_errors():
                data = _read_section("experiment", str(experiment))
            return data, file_safe_name(name or str(experiment))
        if isinstance(experiment, ExperimentForm):
            return experiment.to_data(), file_safe_name(name or experiment.KIND)
        data = read_experiment(experiment, "experiment")
        return data, file_safe_name(name or str(data["kind"]))


class InterruptedWaitError(BaseException):
    """`interrupt` was called while this thread waited."""


def _read_section(section: str, name: str) -> dict[str, Any]:
    from pamctl.settings.config_files import find_config_file
    from pamctl.settings.resolve import read_section_file, settings_to_data
    from pamctl.settings.table_file import read_tables

    path = find_config_file(section, name, section)
    return settings_to_data(read_section_file(section, path, (), read_tables))


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
