"""From names, files and overrides to one validated, immutable `RunSettings`.

The models stand beside what they configure; this module finds the files, lays the
overrides over them, and says what is wrong in the user's words: one line a problem,
with the file and line, all problems at once.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

from pydantic import Field, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from hal.configured import Configured
from pamctl.control.experiment import ExperimentSettings
from pamctl.control.law import ControllerSettings
from pamctl.plant.model import PlantSettings
from pamctl.rig_settings import RigSettings
from pamctl.yamlfile import Document, KeyPath, YamlError, dump, load, parse, parse_value

Settings = TypeVar("Settings")
JsonSchema = dict[str, Any]


class RunSettings(Configured):
    """All that a run depends on; embedded in its log, and rebuilt from there by replay."""

    controller: ControllerSettings
    experiment: ExperimentSettings
    rig: RigSettings
    plant: PlantSettings
    seed: int = Field(default=0, ge=0, description="of the simulated rig's noise")
    duration_s: float | None = Field(
        default=None, gt=0, description="ends the run early; the experiment's own end if absent"
    )
    fast: bool = Field(default=False, description="simulate without a clock")
    rt: Literal["auto", "require", "off"] = Field(
        default="auto", description="real-time scheduling: where permitted, or else fail, or never"
    )


RUN: TypeAdapter[RunSettings] = TypeAdapter(RunSettings)
SECTIONS: Mapping[str, TypeAdapter[Any]] = {
    "controller": TypeAdapter(ControllerSettings),
    "experiment": TypeAdapter(ExperimentSettings),
    "rig": TypeAdapter(RigSettings),
    "plant": TypeAdapter(PlantSettings),
}
"""One folder of `config/` each."""

DEFAULT_NAMES: Mapping[str, str] = {
    "controller": "qsmc",
    "experiment": "tracking-2",
    "rig": "sim",
    "plant": "paper",
}
"""What `pamctl run` runs when it is told nothing."""


class Problem(NamedTuple):
    """One thing to mend."""

    where: str
    """`file:line:column`, or the option of the command line that is at fault."""
    key: str
    """Dotted, from the section on; empty where the trouble is a whole file."""
    message: str

    def __str__(self) -> str:
        """Return the one line a user reads."""
        return ": ".join(part for part in self if part)


class ConfigError(Exception):
    """Settings that cannot be used, with everything that is wrong with them."""

    def __init__(self, problems: Iterable[Problem]) -> None:
        """Keep the problems; they are the message, a line each."""
        self.problems = tuple(problems)
        super().__init__("\n".join(map(str, self.problems)))


# --- the whole way ---------------------------------------------------------------------


def resolve(
    *,
    controller: str | None = None,
    experiment: str | None = None,
    rig: str | None = None,
    plant: str | None = None,
    overrides: Sequence[str] = (),
    seed: int | None = None,
    duration_s: float | None = None,
    fast: bool | None = None,
    rt: str | None = None,
) -> RunSettings:
    """Settle a run from the command line's words; what is None takes its default.

    Sections are names of shipped files or paths; overrides read `controller.lambda_per_s=12`.
    Raises `ConfigError`.
    """
    chosen = {"controller": controller, "experiment": experiment, "rig": rig, "plant": plant}
    options = {
        "seed": ("--seed", seed),
        "duration_s": ("--duration", duration_s),
        "fast": ("--fast", fast),
        "rt": ("--rt", rt),
    }
    raw = Raw()
    _together(
        partial(raw.add_section, section, name or DEFAULT_NAMES[section])
        for section, name in chosen.items()
    )
    for key, (option, value) in options.items():
        if value is not None:
            raw.put((key,), value, f"{option} {value}")
    _together(partial(raw.override, override) for override in overrides)
    return validated(RUN, raw)


def check(path: Path) -> str:
    """Validate one file by itself and return its kind: a section, or `run` for a resolved one.

    Raises `ConfigError`.
    """
    raw = Raw.read(path)
    kind = kind_of(path, raw.data)
    if kind == "run":
        validated(RUN, raw)
    else:
        validated(SECTIONS[kind], raw, title=kind)
    return kind


def kind_of(path: Path, data: Mapping[str, object]) -> str:
    """Tell a file's kind from its folder, or else from the keys it holds."""
    if path.resolve().parent.name in SECTIONS:
        return path.resolve().parent.name
    known = {kind: _names_in(adapter) & data.keys() for kind, adapter in SECTIONS.items()}
    known["run"] = SECTIONS.keys() & data.keys()
    best, second = sorted(known, key=lambda kind: len(known[kind]), reverse=True)[:2]
    if len(known[best]) == len(known[second]):
        message = f"cannot tell what this configures; put it into a folder {_any_of(SECTIONS)}"
        raise ConfigError([Problem(shown(path), "", message)])
    return best


def to_data(settings: Configured) -> dict[str, Any]:
    """Return settings as mappings, lists and scalars, every default spelled out.

    What is None is left out: in every model here None is the default wherever it is allowed.
    """
    return settings.model_dump(mode="json", round_trip=True, exclude_none=True)


def to_yaml(settings: Configured) -> str:
    """Write settings as YAML; of a `RunSettings`, `from_resolved` returns the equal."""
    return dump(to_data(settings))


def to_json(settings: Configured) -> str:
    """Write settings as one JSON document, which `from_resolved` reads as well."""
    return json.dumps(to_data(settings), indent=2, allow_nan=False)


def from_resolved(text: str, name: str = "resolved configuration") -> RunSettings:
    """Rebuild a run from `to_yaml` or `to_json`; `name` is what errors call the text."""
    return validated(RUN, Raw.parse(text, Path(name)))


def schema() -> JsonSchema:
    """Return the one JSON schema for the files of all sections, whichever an editor opens.

    The alternatives are the models themselves, not the sections: an editor then measures
    a file against `qsmc` or `tracking`, and completes the keys of that one.
    """
    mode: Literal["validation"] = "validation"
    sections, shared = TypeAdapter.json_schemas(
        [(kind, mode, adapter) for kind, adapter in SECTIONS.items()],
        title="A configuration file of pamctl",
    )
    models = (sections[kind, mode] for kind in SECTIONS)
    alternatives = [choice for model in models for choice in model.get("oneOf", [model])]
    dialect = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": dialect, **shared, "anyOf": alternatives}


# --- where the files are ---------------------------------------------------------------


def config_dir() -> Path:
    """Return the shipped configuration: inside an installed package, or the checkout's."""
    package = Path(str(files("pamctl")))
    installed = package / "_config"
    return installed if installed.is_dir() else package.parent / "config"


def names(section: str) -> list[str]:
    """Return what is shipped for one section."""
    return sorted(path.stem for path in (config_dir() / section).glob("*.yaml"))


def find(section: str, name: str) -> Path:
    """Return the file that a name or path on the command line means; raise `ConfigError`."""
    if Path(name).suffix in {".yaml", ".yml"} or Path(name).name != name:
        return Path(name)
    if name in names(section):
        return config_dir() / section / f"{name}.yaml"
    near = get_close_matches(name, names(section), n=1)
    meant = f"did you mean '{near[0]}'? There are" if near else "there are"
    listed = ", ".join(names(section)) or "none"
    message = f"there is no such {section}; {meant} {listed}; or give the path of a .yaml file"
    raise ConfigError([Problem(f"--{section} {name}", "", message)])


def shown(path: Path) -> str:
    """Return a path as short as a terminal opened here needs it."""
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except (ValueError, OSError):
        return str(path)


# --- values before validation ----------------------------------------------------------


@dataclass
class Raw:
    """Values as written, and where each was written."""

    data: dict[str, Any] = field(default_factory=dict)
    origins: dict[KeyPath, str] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> Raw:
        """Read one file; raise `ConfigError`."""
        return cls._of(lambda: load(Path(shown(path))))

    @classmethod
    def parse(cls, text: str, path: Path) -> Raw:
        """Read YAML or JSON text; `path` is what errors call it."""
        try:  # JSON first: its escaped surrogate pairs are the one thing YAML reads otherwise
            data = json.loads(text)
        except (ValueError, RecursionError):
            data = None
        if isinstance(data, dict):
            return cls(data, {(): str(path)})
        return cls._of(lambda: parse(text, path))

    @classmethod
    def _of(cls, reading: Callable[[], Document]) -> Raw:
        try:
            document = reading()
        except YamlError as error:
            raise ConfigError([Problem(error.where, "", error.message)]) from None
        places = document.marks.items()
        return cls(document.data, {at: f"{document.path}:{m.line}:{m.column}" for at, m in places})

    def add_section(self, section: str, name: str) -> None:
        """Take in the file of a section, given by name or path; raise `ConfigError`."""
        file = Raw.read(find(section, name))
        self.data[section] = file.data
        self.origins |= {(section, *at): origin for at, origin in file.origins.items()}

    def put(self, keys: Sequence[str], value: object, origin: str) -> None:
        """Set one value, making the mappings on the way to it.

        Raises `LookupError` where the way leads through something that holds no keys.
        """
        container: Any = self.data
        at: KeyPath = ()
        for key in keys[:-1]:
            slot = _slot(container, key, at)
            at = (*at, slot)
            if isinstance(container, dict) and container.get(key) is None:
                container[key] = {}
                self.origins[at] = origin
            container = container[slot]
        slot = _slot(container, keys[-1], at)
        at = (*at, slot)
        container[slot] = value
        self.origins = {o: w for o, w in self.origins.items() if o[: len(at)] != at}
        self.origins[at] = origin

    def override(self, text: str) -> None:
        """Lay one `section.key=value` over the files; raise `ConfigError` naming the option."""
        origin = f"--set {text}"
        key, equals, value = (part.strip() for part in text.partition("="))
        keys = key.split(".")
        if not equals or not all(keys):
            message = "must read KEY=VALUE, as in controller.lambda_per_s=12"
            raise ConfigError([Problem(origin, "", message)])
        try:
            self.put(keys, parse_value(value), origin)
        except YamlError as error:
            raise ConfigError([Problem(origin, key, error.message)]) from None
        except LookupError as error:
            raise ConfigError([Problem(origin, key, str(error.args[0]))]) from None

    def origin(self, at: KeyPath) -> str:
        """Return where a value, or else the nearest mapping around it, was written."""
        return next((self.origins[near] for near in _outwards(at) if near in self.origins), "")

    def rank(self, at: KeyPath) -> int:
        """Return the place of a value in the order of writing."""
        order = list(self.origins)
        return next((order.index(near) for near in _outwards(at) if near in self.origins), 0)


def _slot(container: object, key: str, at: KeyPath) -> str | int:
    if isinstance(container, dict):
        return key
    if not isinstance(container, list):
        raise LookupError(f"'{_dotted(at)}' holds no keys")
    if not key.isdecimal() or int(key) >= len(container):
        raise LookupError(f"'{_dotted(at)}' has no item {key}; it holds {len(container)}")
    return int(key)


def _outwards(at: KeyPath) -> Iterable[KeyPath]:
    return (at[:depth] for depth in range(len(at), -1, -1))


def _dotted(at: KeyPath) -> str:
    return ".".join(map(str, at))


def _together(steps: Iterable[Callable[[], None]]) -> None:
    """Take every step, and only then raise the problems of them all."""
    problems: list[Problem] = []
    for step in steps:
        try:
            step()
        except ConfigError as error:
            problems += error.problems
    if problems:
        raise ConfigError(problems)


def _names_in(adapter: TypeAdapter[Any]) -> set[str]:
    return set(_place(adapter.json_schema(), ()).names())


# --- validation, and its errors in plain words -----------------------------------------


def validated(adapter: TypeAdapter[Settings], raw: Raw, title: str = "") -> Settings:
    """Make settings of raw values; `title` is the section they are, if they are one by itself.

    Raises `ConfigError`. The values go in as JSON, because pydantic is then strict about
    types (no text for a number, no 1 for true) and still takes a list for a tuple.
    """
    try:
        return adapter.validate_json(json.dumps(raw.data), strict=True)
    except ValidationError as error:
        found = _findings(error.errors(include_url=False), adapter.json_schema(), title)
    raise ConfigError(
        Problem(raw.origin(at), _dotted((title, *at) if title else at), message)
        for at, message in sorted(found.items(), key=lambda finding: raw.rank(finding[0]))
    )


@dataclass(frozen=True)
class _Place:
    """Where one of pydantic's error locations leads, followed through the JSON schema.

    On the way pydantic names not only keys but also the members of unions it tried
    (`controller.qsmc.lambda_per_s`); the schema tells the ones from the others.
    """

    schema: JsonSchema
    nodes: tuple[JsonSchema, ...]
    """What may stand here; several where a union's member is not known."""
    at: KeyPath = ()

    def step(self, name: str | int) -> _Place:
        if name == "[key]":  # pydantic's mark of an error in a key itself
            return self
        members = [member for node in self.nodes for member in self._members(node)]
        if any(len(self._members(node)) > 1 for node in self.nodes):
            named = [m for m in members if _is_called(m, name)]
            return _Place(self.schema, tuple(named or members), self.at)
        children = (_child(member, name) for member in members)
        return _Place(self.schema, tuple(c for c in children if c is not None), (*self.at, name))

    def names(self) -> list[str]:
        """Return the keys that may stand here."""
        return list(dict.fromkeys(name for properties in self._properties() for name in properties))

    def description(self, name: str) -> str:
        """Return what the model says of one of its keys."""
        told = (p[name].get("description", "") for p in self._properties() if name in p)
        return next(told, "")

    def choices(self, tag: str) -> list[str]:
        """Return the values of the key that tells a union's members apart."""
        tags = (properties.get(tag, {}) for properties in self._properties())
        return [value for tag in tags for value in tag.get("enum", [tag.get("const")])]

    def _properties(self) -> list[JsonSchema]:
        members = (member for node in self.nodes for member in self._members(node))
        return [member.get("properties", {}) for member in members]

    def _members(self, node: JsonSchema) -> list[JsonSchema]:
        """Return the alternatives of a union, or the node itself; null is none of them."""
        if "$ref" in node:
            return self._members(self.schema["$defs"][node["$ref"].rpartition("/")[2]])
        choices = node.get("oneOf", node.get("anyOf"))
        if choices is None:
            return [] if node.get("type") == "null" else [node]
        return [member for choice in choices for member in self._members(choice)]


def _is_called(member: JsonSchema, label: str | int) -> bool:
    properties = member.get("properties", {}).values()
    return label == member.get("title") or any(label == p.get("const") for p in properties)


def _child(node: JsonSchema, name: str | int) -> JsonSchema | None:
    if isinstance(name, str):
        others = node.get("additionalProperties")
        child = node.get("properties", {}).get(name, others if isinstance(others, dict) else None)
    else:
        leading = node.get("prefixItems", [])
        child = leading[name] if name < len(leading) else node.get("items")
    return child if isinstance(child, dict) else None


_MISSING = "missing, and has no default"


class _Complaint(NamedTuple):
    """One of pydantic's errors: what the value must be, or else a whole message."""

    at: KeyPath
    must: str = ""
    message: str = ""
    got: object = None
    meant: KeyPath | None = None
    """The key that an unknown one seems to stand for."""


def _findings(errors: Iterable[ErrorDetails], schema: JsonSchema, title: str) -> dict[KeyPath, str]:
    """Say of each place what is wrong there, in one message however many ways were tried."""
    complaints = [_complaint(error, schema, title) for error in errors]
    meant = {complaint.meant for complaint in complaints}
    found: dict[KeyPath, list[_Complaint]] = {}
    for complaint in complaints:
        if not (
            complaint.message.startswith(_MISSING) and complaint.at in meant
        ):  # one slip, one line
            found.setdefault(complaint.at, []).append(complaint)
    return {at: _said(at_one_place) for at, at_one_place in found.items()}


def _said(complaints: Sequence[_Complaint]) -> str:
    musts = list(dict.fromkeys(c.must for c in complaints if c.must))
    if not musts:
        return "; ".join(c.message for c in complaints)
    got = complaints[0].got
    return f"must be {' or '.join(musts)} (got {_got(got)}){_hint(musts, got)}"


def _complaint(error: ErrorDetails, schema: JsonSchema, title: str) -> _Complaint:
    kind, way, context = error["type"], error["loc"], error.get("ctx", {})
    if kind in {"extra_forbidden", "missing"}:
        return _about_key(kind, _place(schema, way[:-1]), way[-1], title)
    place = _place(schema, way)
    if kind in {"union_tag_not_found", "union_tag_invalid"}:
        return _about_tag(place, context["discriminator"].strip("'"), error["input"])
    if kind in {"value_error", "assertion_error"}:
        return _Complaint(place.at, message=str(context["error"]))
    if kind in {"too_short", "too_long"}:
        bound = "least {min_length}" if kind == "too_short" else "most {max_length}"
        message = f"must hold at {bound} items (got {{actual_length}})".format(**context)
        return _Complaint(place.at, message=message)
    if kind in _MUST:
        numbers = {k: f"{v:g}" if isinstance(v, float) else v for k, v in context.items()}
        return _Complaint(place.at, _MUST[kind].format(**numbers), got=error["input"])
    said = error["msg"]
    must = said.removeprefix("Input should be ").replace("valid ", "")
    return _Complaint(place.at, must if must != said else "", said, error["input"])


def _place(schema: JsonSchema, way: Iterable[str | int]) -> _Place:
    place = _Place(schema, (schema,))
    for name in way:
        place = place.step(name)
    return place


def _about_key(kind: str, parent: _Place, key: str | int, title: str) -> _Complaint:
    at = (*parent.at, key)
    if isinstance(key, int):
        return _Complaint(parent.at, message=f"must hold more than {key} items")
    if kind == "missing":
        about = parent.description(key)
        return _Complaint(at, message=f"{_MISSING} ({about})" if about else _MISSING)
    if (title, *at) in {(key, key), ("", key, key)}:
        message = f"unknown key; a {key}'s keys stand in its file without this heading"
        return _Complaint(at, message=message)
    meant, hint = _meant(key, parent.names())
    return _Complaint(at, message=f"unknown key{hint}", meant=(*parent.at, meant))


def _about_tag(place: _Place, tag: str, given: Any) -> _Complaint:
    at = (*place.at, tag)
    expected = _any_of(place.choices(tag))
    if tag not in given:
        return _Complaint(at, message=f"missing; it must be {expected}")
    return _Complaint(at, must=expected, got=given[tag])


# --- words -----------------------------------------------------------------------------

_NUMBER, _WHOLE, _TRUTH, _TEXT = "a number", "a whole number", "true or false", "text"
_LIST, _MAPPING = "a list", "a mapping of keys to values"
_MUST = {
    "bool_type": _TRUTH,
    "dict_type": _MAPPING,
    "enum": "{expected}",
    "finite_number": "a finite number",
    "float_type": _NUMBER,
    "frozen_set_type": _LIST,
    "greater_than": "greater than {gt}",
    "greater_than_equal": "at least {ge}",
    "int_from_float": _WHOLE,
    "int_type": _WHOLE,
    "less_than": "less than {lt}",
    "less_than_equal": "at most {le}",
    "list_type": _LIST,
    "literal_error": "{expected}",
    "model_attributes_type": _MAPPING,
    "model_type": _MAPPING,
    "multiple_of": "a multiple of {multiple_of}",
    "none_required": "null",
    "set_type": _LIST,
    "string_pattern_mismatch": "text of the form {pattern}",
    "string_too_long": "text of at most {max_length} characters",
    "string_too_short": "text of at least {min_length} characters",
    "string_type": _TEXT,
    "tuple_type": _LIST,
}
"""Pydantic's error types, as the end of a sentence that begins with `must be`."""

_UNIT = re.compile(
    r"per|length|(?:[muk]?m|inch|in|s)[23]?|[mun]s|min|k?hz|rad|deg|m?n|k?g|[km]?pa|bar|psi|atm"
    r"|m?v|k|c|j|counts?|ticks?|percent"
)


def _stem(key: str) -> str:
    """Return a key without the unit at its end: `lambda` of `lambda_per_s`."""
    parts = key.lower().split("_")
    while len(parts) > 1 and _UNIT.fullmatch(parts[-1]):
        parts.pop()
    return "_".join(parts)


def _meant(key: str, known: Sequence[str]) -> tuple[str, str]:
    """Return the key that was probably meant ('' if none is near), and how to say so."""
    stems = {_stem(name): name for name in reversed(known)}
    if _stem(key) in stems and key not in known:
        name = stems[_stem(key)]
        return name, f"; did you mean '{name}'? The unit is part of the name"
    near = get_close_matches(key.lower(), known, n=1) or [
        stems[stem] for stem in get_close_matches(_stem(key), stems, n=1)
    ]
    if near:
        return near[0], f"; did you mean '{near[0]}'?"
    return "", f"; there are {', '.join(known)}" if 0 < len(known) <= 12 else ""


def _any_of(values: Iterable[object]) -> str:
    *first, last = (f"'{value}'" if isinstance(value, str) else str(value) for value in values)
    return f"{', '.join(first)} or {last}" if first else last


def _got(value: object) -> str:
    """Show a value as the user wrote it, or what kind of thing it is."""
    if value is None or isinstance(value, dict):
        return "nothing" if value is None else "a mapping"
    if isinstance(value, float) and not math.isfinite(value):
        return f"{value}".replace("nan", ".nan").replace("inf", ".inf")
    written = repr(value) if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return written if len(written) <= 40 else f"{written[:37]}..."


def _hint(musts: Sequence[str], got: object) -> str:
    """Name the habit behind a wrong value, where there is a common one."""
    if got is None and _MAPPING in musts:
        return "; leave the key out, or write {}"
    if not isinstance(got, str):
        return ""
    if _TRUTH in musts and got.lower() in {"on", "off", "yes", "no", "y", "n"}:
        return "; YAML 1.2 knows only true and false"
    if _NUMBER not in musts and _WHOLE not in musts:
        return ""
    if re.fullmatch(r"[-+]?[\d.]+(e[-+]?\d+)?", got):
        return "; leave out the quotes"
    if re.fullmatch(r"[-+]?\d+,\d+", got):
        return "; write the decimals after a point"
    if re.match(r"[-+]?[\d.]+\s*[^\d\s]", got):
        return "; a bare number, in the unit that the key names"
    return ""
