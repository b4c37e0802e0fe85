"""Write the reference pages that the code knows: verbs, settings, log schema, effects and more.

    python scripts/generate_reference.py [--check]

Writes into pamctl/manual/reference/, between the comments `<!-- begin NAME -->` and
`<!-- end NAME -->` of a page; what stands around them is written by hand. `--check` writes nothing
and leaves with 3 if a page differs.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import json
import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import typer
from measured_table import format_table, replace_between

import pamctl
from hal import rig
from hal.calibration import Configured
from pamctl import safety, signals
from pamctl.base import errors
from pamctl.cli.app import app
from pamctl.control.forms import Drawn
from pamctl.log import schema as log_schema
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.effects.places import PLACES
from pamctl.plant.parameters import parameters_of
from pamctl.session.experiment_form import FORMS, list_keys, list_models

ROOT = Path(__file__).resolve().parents[1]
REFERENCE = ROOT / "pamctl" / "manual" / "reference"


def read_attribute_docs(module: Any) -> dict[str, dict[str, str]]:
    """Return, by class and attribute, the docstring that follows each attribute of a module."""
    docs: dict[str, dict[str, str]] = {}
    for node in ast.parse(inspect.getsource(module)).body:
        if isinstance(node, ast.ClassDef):
            for before, after in pairwise(node.body):
                match before, after:
                    case (
                        (ast.AnnAssign(target=ast.Name(name)) | ast.Assign([ast.Name(name)])),
                        ast.Expr(ast.Constant(str(text))),
                    ):
                        docs.setdefault(node.name, {})[name] = " ".join(text.split())
    return docs


def _plain(text: str) -> str:
    """Return words that Markdown shows as they are, on one line."""
    return " ".join(text.replace("\\[", "[").replace("<", "&lt;").split())


# --- verbs ------------------------------------------------------------------------------


def walk_verbs() -> Iterator[tuple[str, Any]]:
    """Return every verb by the words that call it, in the order of the help."""

    def walk(command: Any, words: str) -> Iterator[tuple[str, Any]]:
        children = getattr(command, "commands", None)
        if not children or command.invoke_without_command:
            yield words, command
        if children:
            for name, child in children.items():
                yield from walk(child, f"{words} {name}")

    yield from walk(typer.main.get_command(app), "pamctl")


def write_verbs() -> dict[str, str]:
    """Return the help of every verb, as the terminal shows it, and the exit codes."""
    verbs = dict(walk_verbs())
    does = {
        words: _plain((command.help or "").split("\n\n")[0]) for words, command in verbs.items()
    }
    table = [[f"[`{words}`](#{_anchor(words)})", told] for words, told in does.items()]
    parts = [format_table(["verb", "does"], table), ""]
    for words, command in verbs.items():
        parts += [f"## `{words}`\n", f"```\n{_print_help(words, command)}\n```\n"]
    return {"verbs": "\n".join(parts), "exit_codes": write_exit_codes()}


def _print_help(words: str, command: Any) -> str:
    """Return the help of a verb as plain text."""
    command.rich_markup_mode = None
    context = command.context_class(
        command, info_name=words, terminal_width=_WIDTH, max_content_width=_WIDTH
    )
    return "\n".join(line.rstrip() for line in command.get_help(context).splitlines()).replace(
        "\\[", "["
    )


_WIDTH = 100


# --- settings ---------------------------------------------------------------------------


_BOUNDS = {
    "exclusiveMinimum": "above", "minimum": "from", "exclusiveMaximum": "below", "maximum": "to",
}  # fmt: skip


def _reference_in(spec: Mapping[str, Any]) -> str:
    return str(spec.get("$ref", "")).removeprefix("#/$defs/")


def _alternatives(spec: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    found = spec.get("anyOf") or spec.get("oneOf") or [spec]
    return [one for one in found if one.get("type") != "null"]


def _referenced(spec: Mapping[str, Any]) -> list[str]:
    """Return the definitions that a key's value, or the items of its list, may be."""
    names = []
    for one in _alternatives(spec):
        names += [_reference_in(one)] if "$ref" in one else []
        if one.get("type") == "array":
            names += _referenced(one["items"])
    return names


def _type_of(spec: Mapping[str, Any], definitions: Mapping[str, Any]) -> str:
    words = []
    for one in _alternatives(spec):
        if "$ref" in one:
            words.append(_title_of(_reference_in(one), definitions))
        elif "enum" in one:
            words.append(" or ".join(f"`{value}`" for value in one["enum"]))
        elif "const" in one:
            words.append(f"`{one['const']}`")
        elif one.get("type") == "array":
            words.append(f"list of {_type_of(one['items'], definitions)}")
        else:
            words.append(str(one.get("type", "any")))
    return " or ".join(dict.fromkeys(words))


def _bounds_of(spec: Mapping[str, Any]) -> str:
    for one in _alternatives(spec):
        if words := [f"{word} {one[key]:g}" for key, word in _BOUNDS.items() if key in one]:
            return " ".join(words)
    return ""


def _anchor(heading: str) -> str:
    return re.sub(r"[^a-z0-9_ -]", "", heading.lower()).replace(" ", "-")


def _default_in(key: str, spec: Mapping[str, Any], required: Sequence[str]) -> str:
    if key in required:
        return "required"
    value = spec.get("default")
    if isinstance(value, dict | list) or value is None or "const" in spec:
        return ""
    return f"{value:g}" if isinstance(value, float) else json.dumps(value)


def _title_of(name: str, definitions: Mapping[str, Any]) -> str:
    """Return a heading: what a file or part says of its own kind, else the key that holds it."""
    for key, value in definitions[name].get("properties", {}).items():
        if "const" in value and key in ("law", "kind", "backend", "wave"):
            return f"`{key}: {value['const']}`"
    if name == "PlantSettings":  # a file of its own, which SMC's file holds as well
        return "plant"
    for owner in definitions.values():
        for key, value in owner.get("properties", {}).items():
            if any(_reference_in(one) == name for one in _alternatives(value)):
                return f"`{key}`"
    stem = re.sub(r"(Settings|Map)$", "", name) or name
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", stem).lower()


_FILES = (
    ("Controller files", "controller.", lambda keys: "law" in keys),
    ("Experiment files", "experiment.", lambda keys: "kind" in keys),
    ("Rig files", "rig.", lambda keys: "backend" in keys),
    ("Plant files", "plant.", lambda keys: "base" in keys),
    ("Column maps of `pamctl log import`", "", lambda keys: "time" in keys),
)


def write_settings() -> dict[str, str]:
    """Return the tables of every key of every configuration file."""
    from pamctl.settings.resolve import build_config_schema

    schema = build_config_schema()
    definitions: dict[str, Any] = schema["$defs"]
    roots = [_reference_in(one) for one in schema["anyOf"]]
    parts: list[str] = []
    done: set[str] = set()
    for title, prefix, belongs in _FILES:
        files = [name for name in roots if belongs(definitions[name]["properties"])]
        parts.append(f"## {title}\n")
        if prefix:
            parts.append(f"With `--set` the keys begin with `{prefix}`.\n")
        queue = list(files)
        sections: dict[tuple[str, str], list[str]] = {}  # alike ones have one table
        while queue:
            name = queue.pop(0)
            elsewhere = name in CATALOGUE or name == "EffectSettings" or name in roots
            if name in done or (elsewhere and name not in files):
                continue
            done.add(name)
            spec = definitions[name]
            queue += [used for one in spec["properties"].values() for used in _referenced(one)]
            alike = (_plain(spec.get("description", "")), _format_keys(spec, definitions))
            sections.setdefault(alike, []).append(_title_of(name, definitions))
        for (told, table), titles in sections.items():
            parts += [f"### {', '.join(titles)}\n", f"{told}\n", table, ""]
    return {"settings": "\n".join(parts)}


def _format_keys(spec: Mapping[str, Any], definitions: Mapping[str, Any]) -> str:
    """Return the table of a model's keys."""
    rows = []
    for key, value in spec["properties"].items():
        kind = _type_of(value, definitions)
        if set(_referenced(value)) == {"EffectSettings"}:
            kind = "[effects by name](effects.md)"
        default = _default_in(key, value, spec.get("required", ()))
        meaning = _plain(str(value.get("description", "")))
        rows.append([f"`{key}`", f"{kind} {_bounds_of(value)}".rstrip(), default, meaning])
    return format_table(["key", "type", "default", "meaning"], rows)


# --- log schema -------------------------------------------------------------------------


def write_log_schema() -> dict[str, str]:
    """Return the tables of the log's channels and columns."""
    docs = read_attribute_docs(signals)
    hal_docs = read_attribute_docs(rig)
    kinds = {**signals.TICK_STAGES, "compensation": signals.Compensated}
    hints = {stage: kind.__name__ for stage, kind in kinds.items()}
    rows = []
    for number, (name, kind, stage) in enumerate(signals.list_tick_fields(True), 1):
        owner = hints[stage]
        meaning = docs.get(owner, {}).get(name) or hal_docs.get(owner, {}).get(name, "")
        unit = log_schema.unit_of_column(name) if kind is not bool else ""
        rows.append([str(number), f"`{name}`", kind.__name__, unit, stage, _plain(meaning)])
    verdicts = [
        [str(bit.bit_length() - 1), _plain(meaning)] for bit, meaning in safety.VERDICTS.items()
    ]
    channels = [
        [f"`{topic}`", f"`{name}`", _plain(json.loads(text)["description"]),
         ", ".join(f"`{key}`" for key in json.loads(text)["properties"])]
        for topic, (name, text) in log_schema.JSON_SCHEMAS.items()
    ]  # fmt: skip
    header = ["number", "field", "type", "unit", "stage", "meaning"]
    phases = ", ".join(f"{phase.value} {phase.name.lower()}" for phase in signals.Phase)
    return {
        "fields": format_table(header, rows),
        "phases": f"Values of `phase`: {phases}.",
        "verdicts": format_table(["bit", "meaning"], verdicts),
        "channels": format_table(["topic", "schema", "what", "keys"], channels),
    }


# --- exit codes, effects, shipped files ---------------------------------------------------


def write_exit_codes() -> str:
    """Return the table of exit codes."""
    meanings = read_attribute_docs(errors)["ExitCode"]
    rows = [[str(code.value), f"`{code.name}`", meanings[code.name]] for code in errors.ExitCode]
    return format_table(["code", "name", "meaning"], rows)


def write_effects() -> dict[str, str]:
    """Return the places, and the catalogue of effects."""
    places = [
        [f"`{name}`", _plain(place.result), _code(place.gives), _code(_effects_at(name))]
        for name, place in PLACES.items()
    ]
    parts: list[str] = []
    for effect in CATALOGUE.values():
        parts += [f"## `{effect.name}`\n", f"Equation: {_plain(effect.equation)}.\n"]
        words = [f"Block: {effect.block}."]
        words.append(f"Seen by: {', '.join(effect.seen_by) or 'no block'}.")
        if effect.best_experiment:
            words.append(f"Best experiment: `{effect.best_experiment}`.")
        if not {"muscle", "direct"} <= {*effect.actuators}:
            kinds = " or ".join(f"`{actuator}`" for actuator in effect.actuators)
            words.append(f"Looked for in plants with the actuator {kinds} only.")
        if effect.unidentifiable:
            why = _plain(effect.unidentifiable(parameters_of({}).paper))
            words.append(f"Its size is not fitted: with the paper's numbers {why}.")
        parts.append(" ".join(words) + "\n")
        parts.append(f"If the model lacks it: {_plain(effect.signature)}.\n")
        parts += [
            f"- Distinguished from `{other}` by `{how.experiment}`: {_plain(how.why)}."
            for other, how in effect.told_from.items()
        ]
        parts += [""] if effect.told_from else []
        rows = [
            [
                f"`{p.name}`",
                p.unit,
                p.role,
                f"{p.neutral:g}",
                f"{p.low:g} to {p.high:g}",
                f"{p.smallest_of_interest:g}",
                _plain(", ".join([p.meaning, *(f"{n}: {c}" for n, c in enumerate(p.choices))])),
            ]
            for p in effect.parameters
        ]
        head = ["key", "unit", "role", "neutral", "range", "smallest of interest", "meaning"]
        parts += [format_table(head, rows), ""]
    header = ["place", "result of a kernel", "arguments", "effects"]
    return {"places": format_table(header, places), "effects": "\n".join(parts)}


def _code(names: Iterable[str]) -> str:
    return " ".join(f"`{name}`" for name in names)


def _effects_at(place: str) -> list[str]:
    return [
        name
        for name, effect in CATALOGUE.items()
        if any(entry.place == place for entry in effect.entries)
    ]


def write_shipped_files() -> dict[str, str]:
    """Return the tables of the files under config/, by what each says of itself."""
    parts: list[str] = []
    for folder in ("controller", "experiment", "rig", "plant"):
        rows = [
            [f"`{path.stem}`", _plain(_first_words(path))]
            for path in sorted((ROOT / "config" / folder).glob("*.yaml"))
        ]
        parts += [f"## `--{folder}`\n", format_table(["name", "what"], rows), ""]
    return {"shipped_files": "\n".join(parts)}


def _first_words(path: Path) -> str:
    """Return the first line of a file's comment, the schema's line left out."""
    lines = path.read_text(encoding="utf-8").splitlines()
    comment = (line[1:].strip() for line in lines if line.startswith("#"))
    return next(line for line in comment if not line.startswith("yaml-language-server"))


# --- the stub of the Python API -----------------------------------------------------------


def write_stub() -> str:
    """Return `pamctl/__init__.pyi`: the public names, and the classes that are made at run time."""
    lines = [
        "# Written by `python scripts/generate_reference.py`: change the code, not this file.",
        "from collections.abc import Mapping, Sequence",
        "from typing import Any, Literal",
        "",
        "from pamctl.session import gym as gym",
    ]
    forms = {form.__name__: form for form in FORMS.values()}
    for name, home in sorted(pamctl._HOMES.items(), key=lambda item: (item[1], item[0])):
        if name not in forms:
            lines.append(f"from pamctl.session.{home} import {name} as {name}")
    lines += ["", "__version__: str", ""]
    for name, form in sorted(forms.items()):
        lines += [f"class {name}(ExperimentForm):", *_quote(form.__doc__ or "")]
        for key, field in list_keys(list_models()[form.KIND]).items():
            default = "" if field.is_required() else " = ..."
            lines += [f"    {key}: {_type_in_stub(field.annotation)}{default}"]
            lines += _quote(field.description or "")
        lines.append("")
    return "\n".join(lines)


def _quote(text: str) -> list[str]:
    """Return a docstring on as many lines as it needs."""
    if not text:
        return []
    return textwrap.wrap(
        f'"""{_plain(text)}"""', 100, initial_indent="    ", subsequent_indent="    "
    )


def _type_in_stub(kind: Any) -> str:
    origin, arguments = get_origin(kind), get_args(kind)
    if kind is type(None):
        return "None"
    if origin is Annotated:
        return _type_in_stub(arguments[0])
    if origin is Literal:
        return f"Literal[{', '.join(map(repr, arguments))}]".replace("'", '"')
    if origin is tuple:
        return f"Sequence[{_type_in_stub(arguments[0])}]"
    if origin is dict:
        return f"Mapping[{', '.join(map(_type_in_stub, arguments))}]"
    if origin in (Union, UnionType):
        return " | ".join(dict.fromkeys(map(_type_in_stub, arguments)))
    if issubclass(kind, Drawn):
        return "ExperimentForm"
    return "Mapping[str, Any]" if issubclass(kind, Configured) else str(kind.__name__)


_MAKERS: dict[str, Callable[[], dict[str, str]]] = {
    "verbs": write_verbs,
    "settings": write_settings,
    "log-schema": write_log_schema,
    "effects": write_effects,
    "shipped-files": write_shipped_files,
}


def fill_page(name: str) -> str:
    """Return a page with what the code says now between its comments."""
    path = REFERENCE / f"{name}.md"
    page = path.read_text(encoding="utf-8")
    for part, text in _MAKERS[name]().items():
        page = replace_between(part, text, page, path)
    return page


PAGES = {name: partial(fill_page, name) for name in _MAKERS}


def main() -> int:
    """Write or check the pages; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--check", action="store_true", help="only say which pages differ")
    check = parser.parse_args().check
    differ = []
    written = {REFERENCE / f"{name}.md": write for name, write in PAGES.items()}
    for path, write in {**written, ROOT / "pamctl" / "__init__.pyi": write_stub}.items():
        name, text = path.stem, write().rstrip() + "\n"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            differ.append(name)
            if not check:
                path.write_text(text, encoding="utf-8")
    for name in differ:
        print(f"{name}: {'differs from the code' if check else 'written'}")
    return errors.ExitCode.CHECK_FAILED if check and differ else errors.ExitCode.OK


if __name__ == "__main__":
    sys.exit(main())
