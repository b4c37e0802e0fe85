"""From names, files and overrides to one validated, immutable `RunSettings`.

The models are beside the code that they configure. This module finds the files, applies the
overrides, and reports all problems at once, one line each, with file and line.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import Field, TypeAdapter, ValidationError, model_validator

from hal.calibration import Configured, calibration, valve_v
from pamctl.base.errors import ConfigError, Problem
from pamctl.control.experiment import ExperimentSettings
from pamctl.control.filters import HIGHEST_PER_RATE
from pamctl.control.law_registry import (
    ControllerSettings,
    LawError,
    add_law_file,
)
from pamctl.plant.model import PlantSettings
from pamctl.settings.config_files import DEFAULT_NAMES, find_config_file, list_shipped
from pamctl.settings.known_effects import build_compensation
from pamctl.settings.problems import (
    JsonSchema,
    explain_errors,
    join_choices,
    join_key_path,
    names_in,
)
from pamctl.settings.rig_file import RigSettings
from pamctl.settings.yaml12 import (
    KeyPath,
    YamlDocument,
    YamlError,
    dump_yaml,
    load_yaml,
    parse_yaml,
    parse_yaml_value,
)

Settings = TypeVar("Settings")


def require_drivable(plant: PlantSettings) -> None:
    """Raise ValueError for a plant that no law can move."""
    if plant.actuator == "chamber":
        raise ValueError(
            "plant.actuator chamber does not move, and the laws of pamctl follow a displacement: "
            "no run and no `tune` for it. `pamctl diagnose`, `audit` and `compare` take it, and "
            "`pamctl plant export PLANT.yaml PLANT.fmu` makes an FMU of it, to tune a pressure "
            "controller elsewhere"
        )
    if plant.actuator == "direct" and plant.drive_n_per_v is None:
        raise ValueError(
            "plant.drive_n_per_v is missing: the force of the axis's drive per volt of command, "
            "such as `drive_n_per_v: 20`; an axis that only pressure moves is `actuator: cylinder`"
        )


def require_free_axis(rig: RigSettings) -> None:
    """Raise ValueError for a rig file whose safe voltage or homing would push an axis."""
    safe_v = valve_v(calibration(rig.calibration), rig.safe_volts)
    if abs(safe_v) > _NO_FORCE_V:
        raise ValueError(
            f"rig.safe_volts {rig.safe_volts:g} is a command of {safe_v:g} V, which pushes the "
            f"axis when a run ends; {rig.calibration.driver_offset_v:g} is no force"
        )
    if rig.homing.enabled:
        raise ValueError(
            "rig.homing fills and vents a muscle, and an axis has none: give a rig file with "
            "`homing: {enabled: false}`, or --set rig.homing.enabled=false"
        )


_NO_FORCE_V = 0.01


class RunSettings(Configured):
    """All settings of a run. The log embeds them, and a replay rebuilds them from there."""

    controller: ControllerSettings
    experiment: ExperimentSettings
    rig: RigSettings
    plant: PlantSettings
    seed: int = Field(default=0, ge=0, description="of the simulated rig's noise")
    duration_s: float | None = Field(
        default=None, gt=0, description="ends the run early; the experiment's own end if absent"
    )
    fast: bool = Field(default=False, description="simulate without a clock")
    readonly: bool = Field(
        default=False, description="run the whole loop, but write only the safe voltage"
    )
    rt: Literal["auto", "require", "off"] = Field(
        default="auto", description="real-time scheduling: where permitted, or else fail, or never"
    )

    @model_validator(mode="after")
    def _check_filter_rates(self) -> RunSettings:
        highest_hz = HIGHEST_PER_RATE * self.rig.loop.rate_hz
        for name in ("lpf1_hz", "lpf2_hz"):
            if getattr(self.controller, name) > highest_hz:
                raise ValueError(
                    f"controller.{name} {getattr(self.controller, name):g} is above "
                    f"{HIGHEST_PER_RATE:g} of rig.loop.rate_hz {self.rig.loop.rate_hz:g}"
                )
        return self

    @model_validator(mode="after")
    def _check_drive(self) -> RunSettings:
        require_drivable(self.plant)
        if self.plant.actuator == "direct":
            require_free_axis(self.rig)
        return self

    @model_validator(mode="after")
    def _check_compensation(self) -> RunSettings:
        build_compensation(self.plant, self.rig, self.controller)
        return self


RUN: TypeAdapter[RunSettings] = TypeAdapter(RunSettings)
SECTIONS: Mapping[str, TypeAdapter[Any]] = {
    "controller": TypeAdapter(ControllerSettings),
    "experiment": TypeAdapter(ExperimentSettings),
    "rig": TypeAdapter(RigSettings),
    "plant": TypeAdapter(PlantSettings),
}
"""One folder of `config/` each."""


_CHOSEN_BY_FILE = {"controller": "law", "rig": "backend", "experiment": "kind"}
"""The key of a section that determines its other keys."""


# --- resolving a run ---------------------------------------------------------------------


def resolve(
    *,
    controller: str | None = None,
    controller_from: str | None = None,
    experiment: str | None = None,
    rig: str | None = None,
    plant: str | None = None,
    overrides: Sequence[str] = (),
    seed: int | None = None,
    duration_s: float | None = None,
    fast: bool | None = None,
    readonly: bool | None = None,
    rt: str | None = None,
    prepare: Callable[[RawSettings], None] = lambda raw: None,
) -> RunSettings:
    """Resolve a run from command-line values; None means the default.

    Sections are names of shipped files or paths; overrides read `controller.lambda_per_s=12`.
    `controller_from` is a Python file with a law, as `use_law_file` takes it; without `controller`
    the law's defaults are its gains. `prepare` completes the values before they are checked:
    `pamctl.settings.config_files.read_tables` reads the files of tables. Raises `ConfigError`.
    """
    law = None if controller_from is None else use_law_file(controller_from)
    chosen = {"controller": controller, "experiment": experiment, "rig": rig, "plant": plant}
    options = {
        "seed": ("--seed", seed),
        "duration_s": ("--duration", duration_s),
        "fast": ("--fast", fast),
        "readonly": ("--readonly", readonly),
        "rt": ("--rt", rt),
    }
    raw = RawSettings()
    _run_and_collect_problems(
        partial(raw.add_section, section, DEFAULT_NAMES[section] if name is None else name)
        for section, name in chosen.items()
        if not (section == "controller" and name is None and law is not None)
    )
    if law is not None:
        raw.choose_law(law, f"--controller-from {controller_from}")
    for key, (option, value) in options.items():
        if value is not None:
            raw.put((key,), value, f"{option} {value}")
    _run_and_collect_problems(partial(raw.override, override) for override in overrides)
    prepare(raw)
    try:
        return validate_settings(RUN, raw)
    except ConfigError as error:
        if law is None or controller is not None:
            raise
        raise ConfigError(map(_advise_gains, error.problems)) from None


def _advise_gains(problem: Problem) -> Problem:
    """Say what to give where a law from a Python file has no gains."""
    if not (problem.where.startswith("--controller-from") and problem.is_missing):
        return problem
    advice = "give the gains with --controller GAINS.yaml"
    return problem._replace(message=f"{problem.message}; {advice}")


def use_law_file(spec: str) -> str:
    """Register the law of `FILE.py` or `FILE.py:NAME` for settings; return its name.

    It is known in this process and in its child processes. Raises `ConfigError`.
    """
    try:
        law = add_law_file(spec)
    except LawError as error:
        raise ConfigError([Problem("--controller-from", "", str(error))]) from None
    _schema_of.cache_clear()
    return law.name


def check_config_file(path: Path, prepare: Callable[[RawSettings], None] = lambda raw: None) -> str:
    """Validate a single file and return its kind: a section, or `run` for a resolved run.

    `prepare` is as for `resolve`. Raises `ConfigError`.
    """
    raw = RawSettings.read(path)
    prepare(raw)
    kind = kind_of(path, raw.data)
    if kind == "run":
        validate_settings(RUN, raw)
    else:
        validate_settings(list_kinds()[kind], raw, title=kind)
    return kind


@cache
def list_kinds() -> Mapping[str, TypeAdapter[Any]]:
    """Return every kind of user file: the sections of a run, and the map of an import."""
    from pamctl.log.importing.column_map import ImportMap  # no run needs it

    return {**SECTIONS, "import-map": TypeAdapter(ImportMap)}


def kind_of(path: Path, data: Mapping[str, object]) -> str:
    """Determine a file's kind from its folder, or else from its keys."""
    if path.resolve().parent.name in SECTIONS:
        return path.resolve().parent.name
    kinds = list_kinds().items()
    known = {kind: names_in(_schema_of(adapter)) & data.keys() for kind, adapter in kinds}
    known["run"] = SECTIONS.keys() & data.keys()
    best, second = sorted(known, key=lambda kind: len(known[kind]), reverse=True)[:2]
    if len(known[best]) == len(known[second]):
        message = f"cannot tell what this configures; put it into a folder {join_choices(SECTIONS)}"
        raise ConfigError([Problem(shorten_path(path), "", message)])
    return best


def settings_to_data(settings: Configured) -> dict[str, Any]:
    """Return settings as mappings, lists and scalars, with all defaults.

    None is left out: where a model allows None, it is the default.
    """
    return settings.model_dump(mode="json", round_trip=True, exclude_none=True)


def settings_to_yaml(settings: Configured) -> str:
    """Write settings as YAML; `from_resolved` reads a `RunSettings` back unchanged."""
    return dump_yaml(settings_to_data(settings))


def settings_to_json(settings: Configured) -> str:
    """Write settings as one JSON document, which `from_resolved` can read too."""
    return json.dumps(settings_to_data(settings), indent=2, allow_nan=False)


def from_resolved(text: str, name: str = "resolved configuration") -> RunSettings:
    """Rebuild a run from the text of `settings_to_yaml` or `settings_to_json`.

    Errors refer to the text by `name`.
    """
    return validate_settings(RUN, RawSettings.parse(text, Path(name)))


def build_config_schema() -> JsonSchema:
    """Return one JSON schema for the files of all sections.

    Its alternatives are the models, not the sections. An editor can then check a file against
    `qsmc` or `tracking`, and complete the keys of that model.
    """
    mode: Literal["validation"] = "validation"
    kinds = list_kinds()
    sections, shared = TypeAdapter.json_schemas(
        [(kind, mode, adapter) for kind, adapter in kinds.items()],
        title="A configuration file of pamctl",
    )
    models = (sections[kind, mode] for kind in kinds)
    alternatives = [choice for model in models for choice in model.get("oneOf", [model])]
    dialect = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": dialect, **shared, "anyOf": alternatives}


# --- one file ----------------------------------------------------------------------------


def read_section_file(
    section: str,
    path: Path,
    overrides: Sequence[str] = (),
    prepare: Callable[[RawSettings], None] = lambda raw: None,
) -> Any:
    """Read and check one file by itself, as settings of its section; raise `ConfigError`.

    Overrides read `amplitude_mm=2`, or `experiment.amplitude_mm=2`; `prepare` is as for `resolve`.
    """
    raw = RawSettings()
    raw.add_section(section, str(path))
    head = f"{section}."
    _run_and_collect_problems(
        partial(raw.override, change if change.strip().startswith(head) else head + change.strip())
        for change in overrides
    )
    prepare(raw)
    origins = {at[1:]: origin for at, origin in raw.origins.items()}
    return validate_settings(
        SECTIONS[section], RawSettings(raw.data[section], origins), title=section
    )


def shorten_path(path: Path) -> str:
    """Return the shortest form of a path from the working directory."""
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except (ValueError, OSError, RuntimeError):  # RuntimeError: a link to itself
        return str(path)


# --- values before validation ----------------------------------------------------------


@dataclass
class RawSettings:
    """Unvalidated values, and the place where each was written."""

    data: dict[str, Any] = field(default_factory=dict)
    origins: dict[KeyPath, str] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> RawSettings:
        """Read one file; raise `ConfigError`."""
        return cls._read_document(lambda: load_yaml(Path(shorten_path(path))))

    @classmethod
    def parse(cls, text: str, path: Path) -> RawSettings:
        """Read YAML or JSON text; errors call it `path`."""
        try:  # JSON first: its escaped surrogate pairs have another meaning in YAML.
            data = json.loads(text)
        except (ValueError, RecursionError):
            data = None
        if isinstance(data, dict):
            return cls(data, {(): str(path)})
        return cls._read_document(lambda: parse_yaml(text, path))

    @classmethod
    def _read_document(cls, reading: Callable[[], YamlDocument]) -> RawSettings:
        try:
            document = reading()
        except YamlError as error:
            raise ConfigError([Problem(error.where, "", error.message)]) from None
        places = document.marks.items()
        return cls(document.data, {at: f"{document.path}:{m.line}:{m.column}" for at, m in places})

    def add_section(self, section: str, name: str) -> None:
        """Read the file of a section, given by name or path; raise `ConfigError`."""
        file = RawSettings.read(find_config_file(section, name))
        self.data[section] = file.data
        self.origins |= {(section, *at): origin for at, origin in file.origins.items()}

    def choose_law(self, law: str, origin: str) -> None:
        """Require the gains of a law, or take its defaults without a gains file.

        Raises `ConfigError`.
        """
        at = ("controller", "law")
        if "controller" not in self.data:
            self.put(at, law, origin)
        elif (written := self.data["controller"].get("law")) != law:
            message = f"defines the law {law!r}, but the gains file is for {written!r}"
            raise ConfigError([Problem(origin, "", message)])

    def put(self, keys: Sequence[str], value: object, origin: str) -> None:
        """Set one value; create missing mappings.

        Raises `LookupError` if the path leads through a value without keys.
        """
        container: Any = self.data
        at: KeyPath = ()
        for key in keys[:-1]:
            slot = _find_slot(container, key, at)
            at = (*at, slot)
            if isinstance(container, dict) and container.get(key) is None:
                container[key] = {}
                self.origins[at] = origin
            container = container[slot]
        slot = _find_slot(container, keys[-1], at)
        at = (*at, slot)
        container[slot] = value
        self.origins = {o: w for o, w in self.origins.items() if o[: len(at)] != at}
        self.origins[at] = origin

    def override(self, text: str) -> None:
        """Apply one `section.key=value` override; raise `ConfigError` with the option's text."""
        origin = f"--set {text}"
        key, equals, value = (part.strip() for part in text.partition("="))
        keys = key.split(".")
        if not equals or not all(keys):
            message = "must read KEY=VALUE, as in controller.lambda_per_s=12"
            raise ConfigError([Problem(origin, "", message)])
        self._require_section(keys, origin)
        try:
            parsed = parse_yaml_value(value)
            self._require_same_model(keys, parsed, origin)
            self.put(keys, parsed, origin)
        except YamlError as error:
            raise ConfigError([Problem(origin, key, error.message)]) from None
        except LookupError as error:
            raise ConfigError([Problem(origin, key, str(error.args[0]))]) from None

    def _require_section(self, keys: Sequence[str], origin: str) -> None:
        """Refuse a key without its section, and name the section that has it."""
        if len(keys) > 1 or keys[0] in RunSettings.model_fields:
            return
        for section in SECTIONS:
            if keys[0] in self.data.get(section, {}):
                message = f"unknown key; did you mean '{section}.{keys[0]}'?"
                raise ConfigError([Problem(origin, keys[0], message)])

    def _require_same_model(self, keys: Sequence[str], value: object, origin: str) -> None:
        """Refuse an override that changes the law, backend or experiment of a file."""
        section, _, key = ".".join(keys).partition(".")
        if _CHOSEN_BY_FILE.get(section) != key:
            return
        written = self.data.get(section, {}).get(key)
        if written in (None, value):
            return
        message = (
            f"the {key} belongs to the {section} file, which is for {written!r} and has its keys; "
            f"choose another file with --{section} ({', '.join(list_shipped(section))})"
        )
        raise ConfigError([Problem(origin, ".".join(keys), message)])

    def origin(self, at: KeyPath) -> str:
        """Return the place where a value, or the nearest mapping around it, was written."""
        return next((self.origins[near] for near in _walk_outwards(at) if near in self.origins), "")

    def rank(self, at: KeyPath) -> int:
        """Return the position of a value in the order of writing."""
        order = list(self.origins)
        return next((order.index(near) for near in _walk_outwards(at) if near in self.origins), 0)


def _find_slot(container: object, key: str, at: KeyPath) -> str | int:
    if isinstance(container, dict):
        return key
    if not isinstance(container, list):
        raise LookupError(f"'{join_key_path(at)}' holds no keys")
    if not key.isdecimal() or int(key) >= len(container):
        raise LookupError(f"'{join_key_path(at)}' has no item {key}; it holds {len(container)}")
    return int(key)


def _walk_outwards(at: KeyPath) -> Iterable[KeyPath]:
    return (at[:depth] for depth in range(len(at), -1, -1))


def _run_and_collect_problems(steps: Iterable[Callable[[], None]]) -> None:
    """Run all steps, then raise the problems of all of them."""
    problems: list[Problem] = []
    for step in steps:
        try:
            step()
        except ConfigError as error:
            problems += error.problems
    if problems:
        raise ConfigError(problems)


@cache
def _schema_of(adapter: TypeAdapter[Any]) -> dict[str, Any]:
    """Return the JSON schema, which takes longer to make than all else of an error."""
    return adapter.json_schema()


def validate_settings(
    adapter: TypeAdapter[Settings], raw: RawSettings, title: str = ""
) -> Settings:
    """Validate raw values; `title` names the section if the values are a single section.

    Raises `ConfigError`. Values are passed to pydantic as JSON: it is then strict about types (no
    text for a number, no 1 for true), but accepts a list for a tuple.
    """
    try:
        return adapter.validate_json(json.dumps(raw.data), strict=True)
    except ValidationError as error:
        errors = error.errors(include_url=False)
        found = explain_errors(errors, _schema_of(adapter), title)
    raise ConfigError(
        Problem(raw.origin(at), join_key_path((title, *at) if title else at), message)
        for at, message in sorted(found.items(), key=lambda finding: raw.rank(finding[0]))
    )
