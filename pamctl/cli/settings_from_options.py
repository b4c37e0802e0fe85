"""What the options of a verb mean together: resolved settings, or a clear error."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import typer

from hal.entry_points import find_rig_points
from pamctl.base.errors import ConfigError, Problem
from pamctl.cli.options import CONTROLLER, CONTROLLER_FROM, NO_CHANGES, PLANT, Options, flag, option
from pamctl.cli.output import tell
from pamctl.log.run_meta import CHANGES, describe_changes
from pamctl.settings.config_files import (
    DEFAULT_NAMES,
    find_config_file,
    list_shipped,
    read_section,
    read_tables,
)

if TYPE_CHECKING:  # the help waits for no model
    from pamctl.settings.resolve import RunSettings


class ResolvedOptions(NamedTuple):
    """What the options of a verb come to."""

    settings: RunSettings
    names: dict[str, str]
    """Names of the files, by section; and what was changed in the controller's gains."""


_OF_RUN = (
    "controller", "controller_from", "experiment", "plant", "seed", "duration_s", "fast",
    "readonly", "rt",
)  # fmt: skip
"""Options beside the rig, as `resolve` calls them; a verb leaves out those that it lacks."""


class RigOptions(Options):
    """The rig that a verb works on."""

    backend: str | None = option(
        f"--backend {'|'.join(find_rig_points())}", "Backend to drive",
        shown="that of --rig, sim",
    )  # fmt: skip
    rig: str | None = option(
        "--rig NAME|FILE", "Rig file with calibration and limits", shown="that of --backend, sim"
    )
    overrides: list[str] = option(
        "--set KEY=VALUE",
        "Setting to change, such as controller.lambda_per_s=12; can be repeated",
        shown=NO_CHANGES,
    )

    def resolve(self) -> ResolvedOptions:
        """Return the settings of a run on this rig; raise `ConfigError`."""
        return resolve_options(self.backend, self.rig, self.overrides, fast=False)


class LoopOptions(RigOptions):
    """The rig, and what works on it."""

    controller: str | None = CONTROLLER
    plant: str | None = PLANT
    seed: int | None = option("--seed N", "Seed of the simulated noise, 0 or more", shown="0")
    rt: str | None = option(
        "--rt auto|require|off",
        "Use of real-time scheduling; 'require' fails where it is not permitted",
        shown="auto",
    )

    def resolve(self) -> ResolvedOptions:
        """Return the settings; raise `ConfigError`."""
        given = vars(self)
        # A flag that was not given leaves what the files say.
        options = {
            name: given[name] for name in _OF_RUN if name in given and given[name] is not False
        }
        return resolve_options(self.backend, self.rig, self.overrides, **options)


class SettingsOptions(LoopOptions):
    """All that settles a run."""

    controller_from: str | None = CONTROLLER_FROM
    experiment: str | None = option(
        "--experiment NAME|FILE", "Experiment to run", shown=DEFAULT_NAMES["experiment"]
    )
    duration_s: float | None = option(
        "--duration SECONDS",
        "End the run this long after homing, more than 0 s",
        shown="length of the experiment",
    )
    fast: bool = flag("--fast", "Simulate without a clock, as fast as possible")


def resolve_options(
    backend: str | None, rig: str | None, overrides: Sequence[str] | None, **options: Any
) -> ResolvedOptions:
    """Resolve the options together, those of `resolve`; raise `ConfigError` if they contradict.

    So it does where the experiment leaves the envelope of rig and model.
    """
    from pamctl.settings.envelope import find_excesses
    from pamctl.settings.resolve import SECTIONS, resolve, settings_to_data

    named_rig = _choose_rig(backend, rig)
    prepare = partial(read_tables, tell=tell)
    settings = resolve(rig=named_rig, overrides=overrides or (), prepare=prepare, **options)
    _check_backend(settings, backend, rig)
    named = {"rig": named_rig, **options}
    if options.get("controller_from") and not options.get("controller"):
        named["controller"] = settings.controller.law
    names = {section: str(named.get(section) or DEFAULT_NAMES[section]) for section in SECTIONS}
    excesses = find_excesses(settings)
    if excesses:
        raise ConfigError(Problem(f"experiment {names['experiment']}", "", e) for e in excesses)
    gains = settings_to_data(settings.controller)
    changes = describe_changes(gains, read_file_gains(settings, names["controller"]))
    return ResolvedOptions(settings, names | ({CHANGES: changes} if changes else {}))


def read_file_gains(settings: RunSettings, controller: str) -> dict[str, Any]:
    """Return the gains of the file a controller is named after, or those in use if none was."""
    from pamctl.settings.resolve import settings_to_data

    if controller == settings.controller.law not in list_shipped("controller"):
        return settings_to_data(settings.controller)  # gains of a law file, without a file
    return read_section("controller", find_config_file("controller", controller))


def _choose_rig(backend: str | None, rig: str | None) -> str | None:
    """Return the rig file that `--backend` and `--rig` mean together."""
    from hal.backend import find_backends, hint_at_missing

    backends = find_backends().found
    if backend is not None and backend not in backends:
        message = f"unknown; there are {', '.join(backends)}; {hint_at_missing(backend)}"
        raise ConfigError([Problem(f"--backend {backend}", "", message)])
    return rig if rig is not None or backend is None else backends[backend].rig_file


def _check_backend(settings: RunSettings, backend: str | None, rig: str | None) -> None:
    """Refuse options that contradict the rig file."""
    found = settings.rig.backend
    if backend is not None and backend != found:
        message = f"the rig file {rig} is for the backend {found}"
        raise ConfigError([Problem(f"--backend {backend}", "", message)])
    if settings.fast and not settings.rig.record.is_simulated:
        message = "only a simulation can do without a clock"
        raise ConfigError([Problem("--fast", "", message)])


def find_argument_file(section: str, name: str) -> Path:
    """Return the file that an argument names; leave with 2 where there is none.

    `resolve` would name an option that the user did not give.
    """
    try:
        return find_config_file(section, name)
    except ConfigError as error:
        messages = "; ".join(problem.message for problem in error.problems)
        raise typer.BadParameter(f"{name!r}: {messages}") from None
