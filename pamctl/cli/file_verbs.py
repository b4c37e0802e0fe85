"""`pamctl config` and `pamctl plant`, the files that a user writes; `pamctl manual`, to read."""

from __future__ import annotations

import json
import shlex
import sys
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hal.backend import find_backends
from pamctl.base.errors import ConfigError, ExitCode, Problem
from pamctl.base.new_file import require_place, write_files
from pamctl.base.texts import hint_at_nearest
from pamctl.cli.failure import Failed
from pamctl.cli.options import MAP, Options, argument, flag, option, verb
from pamctl.cli.output import print_result, print_run_settings, read_records, tell
from pamctl.cli.settings_from_options import SettingsOptions, find_argument_file
from pamctl.settings.config_files import config_dir, read_tables
from pamctl.settings.resolve import (
    SECTIONS,
    build_config_schema,
    check_config_file,
    read_section_file,
    shorten_path,
)

if TYPE_CHECKING:
    from pamctl.diagnose.guess_plant import Guess
    from pamctl.diagnose.record import Record
    from pamctl.plant.model import PlantSettings

config_app = typer.Typer(
    no_args_is_help=True, help="Check, show and describe the configuration files."
)
plant_app = typer.Typer(
    no_args_is_help=True, help="Make and export plant files, which describe a rig."
)


class FilesOptions(Options):
    """`pamctl config check`."""

    files: list[Path] = argument("[FILE]...", "Files to check", None, shown="the shipped files")


@config_app.command("check")
@verb
def check_files(asked: FilesOptions) -> None:
    """Validate files, each by itself: one line per file, or one per problem."""
    shipped = (path for kind in SECTIONS for path in sorted((config_dir() / kind).glob("*.yaml")))
    checked: list[tuple[Path, str, tuple[Problem, ...]]] = []
    for path in asked.files or shipped:
        try:
            checked.append((path, check_config_file(path, partial(read_tables, tell=tell)), ()))
        except ConfigError as error:
            checked.append((path, "", error.problems))
    documents = [
        {
            "file": shorten_path(path),
            "kind": kind or None,
            "ok": not problems,
            "problems": [problem.as_dict() for problem in problems],
        }
        for path, kind, problems in checked
    ]
    lines = [
        line
        for path, kind, problems in checked
        for line in map(str, problems or [f"{shorten_path(path)}: ok ({kind})"])
    ]
    print_result(documents, "\n".join(lines), as_json=asked.as_json)
    if any(problems for _, _, problems in checked):
        raise typer.Exit(ExitCode.BAD_CONFIG)


@config_app.command("show")
@verb
def show(asked: SettingsOptions) -> None:
    """Print the configuration a run with the same options would use, defaults included."""
    settings, _ = asked.resolve()
    print_run_settings(settings, as_json=asked.as_json)


@config_app.command("schema")
def print_schema() -> None:
    """Print the JSON schema that editors complete and check the files with."""
    typer.echo(json.dumps(build_config_schema(), indent=2))


# --- plants -----------------------------------------------------------------------------------

_ACTUATORS = ("muscle", "direct", "chamber", "cylinder")


@plant_app.callback()
def _group() -> None:
    """Make and export plant files, which describe a rig."""


class NewPlantOptions(Options):
    """`pamctl plant new`."""

    out: Path = option("--out FILE.yaml", "New plant file", ...)
    actuator: str | None = option(
        f"--actuator {'|'.join(_ACTUATORS)}",
        "What moves, or is filled: one valve and one chamber, no piston with air on both sides",
        shown="muscle; with --from by the columns",
    )
    measured: list[Path] = option(
        "--from FILE",
        "Log, or measured file such as CSV, from which numbers are guessed; can be repeated",
        shown="none",
    )
    map_path: Path | None = MAP
    given: list[str] = option(
        "--value NAME=NUMBER",
        "A number with its unit, such as rest_length_m='200 mm'; can be repeated",
        shown="a usual one, to edit in the file",
    )


@plant_app.command("new")
@verb
def make_plant(asked: NewPlantOptions) -> None:
    """Write a plant file to edit: every number in SI with what it means, and which are fitted."""
    out = asked.out
    require_place(out)
    if asked.actuator not in (*_ACTUATORS, None):
        which = f"{asked.actuator!r} is not one of {', '.join(_ACTUATORS)}"
        raise typer.BadParameter(which, param_hint="--actuator")
    from pamctl.settings.datasheet import build_plant, format_new_plant

    records = _read_whole(asked)
    actuator = asked.actuator or _guess_actuator(records)
    texts = _split_given(asked.given, actuator)
    values, guesses = _collect_numbers(actuator, texts, records)
    plant = build_plant(actuator, values)
    _tell_unfit(records, plant)
    names = _list_fitted(plant, records)
    fitted = ", ".join(names) or "nothing"
    texts = {name: f"given as {text}" for name, text in texts.items()}
    texts |= {name: f"guessed, {guess.how}" for name, guess in guesses.items()}
    papers = _list_papers(actuator, texts)
    at_length = ", at this rest length" if "rest_length_m" in texts else ""
    texts |= dict.fromkeys(papers, f"of the paper's muscle{at_length}")
    write_files({out: format_new_plant(actuator, values, texts, fitted, [*guesses])})
    document = {"plant": str(out), "actuator": actuator, "numbers": values, "fitted": names}
    lines = []
    if records:
        document["guessed"] = {name: guess._asdict() for name, guess in guesses.items()}
        if asked.actuator is None:
            lines.append(f"by the columns: actuator {actuator}")
    lines += [f"guessed: {name} = {g.value:.4g}, {g.how}" for name, g in guesses.items()]
    if records and papers:
        lines.append(
            f"of the paper's muscle, as none was given: {', '.join(papers)}; no fit finds the "
            "sizes of another: measure yours, and give each with --value"
        )
    column_map = ["--map", asked.map_path] if asked.map_path else []
    measured = [str(path) for path in asked.measured] or ["LOG"]
    words = ["pamctl", "diagnose", *measured, *column_map, "--plant", out, "--out", "DIR"]
    lines += [
        f"plant: {out}",
        f"`pamctl diagnose` will fit {fitted}, from these values on; "
        "it takes the other numbers as they are",
        f"next: {shlex.join(map(str, words))}",
    ]
    print_result(document, "\n".join(lines), as_json=asked.as_json)


def _read_whole(asked: NewPlantOptions) -> list[Record]:
    """Return the records, with what is missing in them bridged."""
    records = read_records(asked.measured, asked.map_path)
    if not records:
        return []
    from pamctl.diagnose.mend import fill_missing

    return [fill_missing(record)[0] for record in records]


def _list_papers(actuator: str, texts: dict[str, str]) -> list[str]:
    """Return the sizes of a muscle that are the paper's: neither given nor guessed."""
    sizes = ("rest_length_m", "braid_length_m", "braid_turns") if actuator == "muscle" else ()
    return [name for name in sizes if name not in texts]


def _tell_unfit(records: list[Record], plant: PlantSettings) -> None:
    """Say at once why `diagnose` would refuse these records with this plant file."""
    if records:
        from pamctl.diagnose.guess_plant import doubt_numbers
        from pamctl.diagnose.record_doubts import doubt_actuator, doubt_record

        problems = [p for record in records for p in doubt_actuator(record, plant)]
        problems = problems or [p for record in records for p in doubt_record(record, plant)]
        for doubt in (*(p.sentence for p in problems), *doubt_numbers(records, plant)):
            tell(f"warning: {doubt}")


class ExportPlantOptions(Options):
    """`pamctl plant export`."""

    plant: str = argument("NAME|FILE", "Plant file to export")
    out: Path = argument("OUT.fmu", "New file")
    sources_only: bool = flag(
        "--sources-only", "Compile nothing: the importer compiles the sources inside"
    )


@plant_app.command("export")
@verb
def export_plant(asked: ExportPlantOptions) -> None:
    """Write a plant as an FMU (FMI 3.0, co-simulation) for Simulink and other simulators.

    It needs a C compiler, and runs on this kind of computer.
    """
    out = asked.out
    if out.suffix.lower() != ".fmu":
        raise typer.BadParameter(f"{str(out)!r} must end with .fmu", param_hint="OUT.fmu")
    from pamctl.models.fmu import write_fmu

    settings = read_section_file("plant", find_argument_file("plant", asked.plant))
    platform = write_fmu(settings, out, sources_only=asked.sources_only)
    document = {"plant": asked.plant, "fmu": str(out), "platform": platform or None}
    text = f"{out}: FMI 3.0 for co-simulation, {platform or 'sources only'}"
    print_result(document, text, as_json=asked.as_json)


class RigForPlantOptions(Options):
    """`pamctl plant rig`."""

    plant: str = argument("NAME|FILE", "Plant file")
    out: Path = argument("RIG.yaml", "New rig file")
    backend: str = option(
        f"--backend {'|'.join(find_backends().found)}",
        "Backend of the new rig file",
        "sim",
    )


@plant_app.command("rig")
@verb
def make_rig(asked: RigForPlantOptions) -> None:
    """Write a rig file for a plant: a shipped one, with limits that suit what moves."""
    out = asked.out
    known = find_backends().found
    if asked.backend not in known:
        which = f"{asked.backend!r} is not one of {', '.join(known)}"
        raise typer.BadParameter(which, param_hint="--backend")
    from pamctl.commissioning.guided import require_rig_place
    from pamctl.commissioning.suited_rig import make_rig_file

    require_rig_place(out, str(out))
    path = find_argument_file("plant", asked.plant)
    try:
        plant = read_section_file("plant", path)
        text, notes = make_rig_file(plant, asked.plant, asked.backend)
    except ValueError as error:
        raise ConfigError([Problem(asked.plant, "", str(error))]) from error
    write_files({out: text})
    document = {"plant": asked.plant, "rig_file": str(out), "notes": notes}
    words = ["pamctl", "doctor", "--rig", str(out)]
    if known[asked.backend].is_simulated:
        # There are no gains yet: open loop, but for an axis, which would drift to its end.
        motion = ["step", "--controller", "pid"] if plant.actuator == "direct" else ["diagnosis"]
        words = ["pamctl", "run", "--fast", "--experiment", *motion]
        words += ["--plant", asked.plant, "--rig", str(out)]
    lines = [f"rig file: {out}", *notes, f"next: {shlex.join(words)}"]
    print_result(document, "\n".join(lines), as_json=asked.as_json)


def _split_given(given: list[str], actuator: str) -> dict[str, str]:
    """Return the texts by name; leave with 2 for a name that this actuator does not have."""
    from pamctl.plant.catalogue import CATALOGUE
    from pamctl.settings.datasheet import list_questions

    parts = [[part.strip() for part in text.partition("=")] for text in given]
    names = [q.name for q in list_questions(actuator, [name for name, _, _ in parts])]
    texts = {}
    for text, (name, equals, number) in zip(given, parts, strict=True):
        if name not in names or not equals or not number:
            effect = CATALOGUE.get(name.partition(".")[0])
            asked = f"; its numbers are {', '.join(names)}, and EFFECT.NUMBER of an effect"
            if effect:
                known = ", ".join(p.name for p in effect.parameters if not p.choices)
                asked = f"; the numbers of {effect.name} are {known}"
            raise typer.BadParameter(
                f"{text!r} is no NAME=NUMBER of the actuator {actuator}"
                f"{hint_at_nearest(name, names)}{asked}",
                param_hint="--value",
            )
        texts[name] = number
    return texts


def _guess_actuator(records: list[Record]) -> str:
    """Return what the columns of all records fit; of a muscle's and a cylinder's, ask."""
    if not records:
        return "muscle"
    channels = set.intersection(*(set(r.channels) for r in records))
    if "force_n" in channels and "valve_v" not in channels:
        return "direct"
    if "position_m" not in channels:
        return "chamber"
    if not any(record.is_imported for record in records):
        return "muscle"  # which pamctl ran
    raise Failed(
        ExitCode.USAGE,
        "a braided muscle and a cylinder with a piston have the same columns: say which it is, "
        "by --actuator muscle or --actuator cylinder",
    )


def _collect_numbers(
    actuator: str, given: dict[str, str], records: list[Record]
) -> tuple[dict[str, float], dict[str, Guess]]:
    """Return all numbers in SI, and those of them that the records made.

    A number is what is given, else what the records show, else the usual one.
    """
    from pamctl.settings.datasheet import list_questions, read_quantity

    questions = list_questions(actuator, given)
    values, longer = dict[str, float](), 1.0
    for question in questions:
        if question.name in given:
            values[question.name] = read_quantity(question.name, given[question.name], values)
        elif question.default is not None:
            is_braid = question.name in ("braid_length_m", "braid_turns")
            values[question.name] = question.default * (longer if is_braid else 1.0)
        if question.name == "rest_length_m" and question.default:
            longer = values["rest_length_m"] / question.default  # with the paper's angle
    guesses: dict[str, Guess] = {}
    if records:
        from pamctl.diagnose.guess_plant import guess_numbers

        found = guess_numbers(records, actuator, values)
        guesses = {name: guess for name, guess in found.items() if name not in given}
    values |= {name: guess.value for name, guess in guesses.items()}
    missing = [
        f"{q.name} ({q.meaning}) has no default: give --value {q.name}='...' in {q.units}"
        for q in questions
        if q.name not in values and not q.is_optional
    ]
    if missing and records:
        from pamctl.diagnose.record_doubts import doubt_drive

        has_piston = "piston.area_m2" in values
        doubts = [d for r in records for d in doubt_drive(r, actuator, has_piston=has_piston)]
        missing = [*(f"no guess: {doubt.sentence}" for doubt in doubts[:1]), *missing]
    if missing:
        raise Failed(ExitCode.USAGE, "\n".join(missing))
    return values, guesses


def _list_fitted(plant: PlantSettings, records: list[Record]) -> list[str]:
    from pamctl.diagnose.evidence.weigh import LOAD, is_of_air, list_guesses, list_stated
    from pamctl.plant.model import values_of

    values = values_of(plant)
    period_s = max([record.period_s for record in records], default=1e-3)
    load = [LOAD] if plant.actuator in ("direct", "cylinder") and LOAD not in plant.known else []
    stated = [number.name for number in list_stated(values, plant.known)]
    names = dict.fromkeys([*list_guesses(values, plant, period_s), *load, *stated])
    has_command = not records or any(record.valve_v is not None for record in records)
    return [name for name in names if has_command or not is_of_air(name)]


# --- the manual -------------------------------------------------------------------------------


def manual(
    page: Annotated[
        str | None,
        typer.Argument(metavar="[PAGE]", help="Page to read", show_default="the list of all pages"),
    ] = None,
) -> None:
    """List the pages of the manual, or print one of them."""
    from pamctl.manual import UnknownPageError, list_pages, read_page

    if page is None:
        pages = list_pages()
        width = max(len(one.name) for one in pages)
        for kind, of_kind in groupby(pages, key=lambda one: one.kind):
            typer.echo(f"{kind}:")
            for one in of_kind:
                typer.echo(f"  {one.name:<{width}}  {one.title}")
        return
    try:
        text = read_page(page)
    except UnknownPageError as error:
        raise typer.BadParameter(str(error), param_hint="PAGE") from None
    if not sys.stdout.isatty():
        typer.echo(text.rstrip())
        return
    from rich.console import Console
    from rich.markdown import Markdown

    Console().print(Markdown(text))
