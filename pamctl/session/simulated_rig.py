"""The simulated rig, without a daemon and as fast as it goes."""

from __future__ import annotations

import atexit
import math
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from pamctl.base.errors import ExitCode
from pamctl.base.new_file import require_folder
from pamctl.daemon.in_process import InProcessLoop, InProcessMaker
from pamctl.daemon.protocol import (
    RequestError,
    RequestRefusedError,
    check_params,
    list_orders,
)
from pamctl.daemon.rig_session import RigSession
from pamctl.daemon.shelf import Latch, Shelf
from pamctl.log.run_meta import file_safe_name
from pamctl.session.pamctl_error import PamctlError, translate_errors
from pamctl.session.steered_rig import Goal, SteeredRig, require_well
from pamctl.settings.config_files import read_tables
from pamctl.settings.resolve import (
    SECTIONS,
    RawSettings,
    RunSettings,
    resolve,
    validate_settings,
)

if TYPE_CHECKING:
    from pamctl.plant.model import PlantSettings

AskedSection = str | Path | Mapping[str, Any]
"""A shipped name, a file, or the keys of one."""
_RESOLVING = threading.Lock()
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
    """A session on the simulated rig, within this process.

    Time passes only while a method waits for it. When it is closed, the current run stops
    smoothly and its log is whole.
    """

    def __init__(self, settings: RunSettings, names: Mapping[str, str], logs: Path) -> None:
        """Begin idle; raise `NewFileError` where the logs cannot be written."""
        require_folder(logs)
        session = RigSession(
            settings, names, InProcessMaker(), Shelf(logs, prefix=""), Latch(None),
            idle_after_s=math.inf,
        )  # fmt: skip
        super().__init__(_OwnLink(session))
        atexit.register(self.close)

    def close(self) -> None:
        """Stop smoothly; the log of the current run is whole then."""
        atexit.unregister(self.close)
        super().close()


class _OwnLink:
    """A session that nobody else steers: time passes while a method waits."""

    is_own = True

    def __init__(self, session: RigSession) -> None:
        self._session = session
        self._orders = list_orders(type(session))
        self._is_open = True

    @property
    def has_end(self) -> bool:
        return self._session.run_has_end

    def ask(self, name: str, params: Mapping[str, object]) -> Any:
        order = self._orders[name]
        if order.changes and not self._is_open:
            raise PamctlError("this simulation is closed; begin another", ExitCode.USAGE)
        try:
            checked = check_params(order.params, dict(params))
        except RequestError as error:
            raise RequestRefusedError(str(error)) from error
        with self._raise_new_fault():
            return order.carry_out(self._session, checked)

    def ask_at_once(self, name: str) -> Any:
        answer = getattr(self._session, name)()
        self._session.look()
        return answer

    def wait_until(self, goal: Goal, patience_s: float = math.inf) -> None:
        loop = self._loop
        if loop is not None:
            self._let_pass(loop, lambda: goal(loop))

    def sleep(self, duration_s: float) -> None:
        loop = self._loop
        if loop is not None:
            ticks = max(1, round(duration_s * self._session.rate_hz))
            self._let_pass_until(loop, _number(loop) + ticks)

    def follow(self, every: int) -> Iterator[Mapping[str, float]]:
        loop = self._loop
        at = -1 if loop is None else _number(loop)
        while loop is not None and loop.log is not None:
            # Marks and gains take a tick each: they do not shift the ticks that follow.
            at += every * max(1, -(-(_number(loop) + 1 - at) // every))
            self._let_pass_until(loop, at)
            if loop.log is None:
                return
            yield loop.tick

    def close(self) -> None:
        self._is_open = False
        self._session.close()

    @property
    def _loop(self) -> InProcessLoop | None:
        return cast("InProcessLoop | None", self._session.carrier)

    def _let_pass_until(self, loop: InProcessLoop, tick: int) -> None:
        log = loop.log
        self._let_pass(loop, lambda: loop.log != log or _number(loop) >= tick)

    def _let_pass(self, loop: InProcessLoop, goal: Callable[[], bool]) -> None:
        with self._raise_new_fault():
            loop.advance(goal)

    @contextmanager
    def _raise_new_fault(self) -> Iterator[None]:
        """Conclude what has ended within the block; raise the fault that has ended it."""
        before, loop = self._session.fault, self._loop
        log = None if loop is None or loop.run is None else loop.run.log
        try:
            yield
        finally:
            self._session.look()
            if self._session.fault and not before:
                require_well(self._session.status(), log)


def _number(loop: InProcessLoop) -> int:
    return int(loop.tick["tick"])


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
