"""`pamctl plant`: a plant file from a datasheet, and a plant file as an FMU."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pamctl.cli.failure import Failed, print_error
from pamctl.cli.options import JsonOption
from pamctl.cli.output import print_json
from pamctl.exit_codes import ExitCode
from pamctl.new_file import require_place, write_files

if TYPE_CHECKING:
    from pamctl.plant.model import PlantSettings
    from pamctl.settings.datasheet.plant_questions import PlantQuestion

plant_app = typer.Typer(
    no_args_is_help=True, help="Make and export plant files, which describe a rig."
)

_ACTUATORS = {
    "muscle": "a braided pneumatic muscle behind a valve",
    "direct": "a mass that a measured force moves, with or without a piston: axis, cylinder",
    "chamber": "a volume that does not change, behind a valve",
}


@plant_app.callback()
def _group() -> None:
    """Make and export plant files, which describe a rig."""


@plant_app.command("new")
def make_plant(
    out: Annotated[Path, typer.Option("--out", metavar="FILE.yaml", help="New plant file")],
    actuator: Annotated[
        str | None,
        typer.Option(
            "--actuator",
            metavar="|".join(_ACTUATORS),
            help="What moves, or is filled",
            show_default="asked",
        ),
    ] = None,
    given: Annotated[
        list[str] | None,
        typer.Option(
            "--value",
            metavar="NAME=NUMBER",
            help="A number with its unit, such as rest_length_m='200 mm'; can be repeated",
            show_default="asked",
        ),
    ] = None,
    yes: Annotated[
        bool,
        typer.Option(
            "--yes", help="Ask nothing, and take the defaults of numbers that are not given"
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Write a plant file: ask for its numbers, with their units, and say which will be fitted.

    Ctrl-C leaves without a file.
    """
    require_place(out)
    kind = _choose_actuator(actuator, ask=not yes)
    from pamctl.settings.datasheet.plant_file import build_plant, format_new_plant

    values, texts = _collect_numbers(kind, _split_given(given or [], kind), ask=not yes)
    plant = build_plant(kind, values)
    names = _list_fitted(plant)
    fitted = ", ".join(names) or "nothing"
    write_files({out: format_new_plant(kind, values, texts, fitted)})
    if as_json:
        print_json({"plant": str(out), "actuator": kind, "numbers": values, "fitted": names})
    else:
        typer.echo(
            f"plant: {out}\n`pamctl diagnose` will fit {fitted}, from these values on; "
            "it takes the other numbers as they are\n"
            f"next: pamctl diagnose LOG --plant {out} --out DIR"
        )


@plant_app.command("export")
def export_plant(
    plant: Annotated[str, typer.Argument(metavar="NAME|FILE", help="Plant file to export")],
    out: Annotated[Path, typer.Argument(metavar="OUT.fmu", help="New file")],
    sources_only: Annotated[
        bool,
        typer.Option(
            "--sources-only", help="Compile nothing: the importer compiles the sources inside"
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Write a plant as an FMU (FMI 3.0, co-simulation) for Simulink and other simulators.

    It needs a C compiler, and runs on this kind of computer.
    """
    if out.suffix.lower() != ".fmu":
        raise typer.BadParameter(f"{str(out)!r} must end with .fmu", param_hint="OUT.fmu")
    from pamctl.cli.settings_from_options import find_argument_file
    from pamctl.fmu.archive import write_fmu
    from pamctl.settings.resolve import read_section_file

    settings = read_section_file("plant", find_argument_file("plant", plant))
    platform = write_fmu(settings, out, sources_only=sources_only)
    if as_json:
        print_json({"plant": plant, "fmu": str(out), "platform": platform or None})
    else:
        typer.echo(f"{out}: FMI 3.0 for co-simulation, {platform or 'sources only'}")


def _choose_actuator(actuator: str | None, *, ask: bool) -> str:
    if actuator is None and ask:
        for name, meaning in _ACTUATORS.items():
            typer.echo(f"{name:<10}{meaning}", err=True)
        actuator = _read_line("actuator [muscle]: ", "--actuator") or "muscle"
    if actuator not in _ACTUATORS:
        which = f"one of {', '.join(_ACTUATORS)}"
        raise typer.BadParameter(
            f"say which: {which}" if actuator is None else f"{actuator!r} is not {which}",
            param_hint="--actuator",
        )
    return actuator


def _split_given(given: list[str], actuator: str) -> dict[str, str]:
    """Return the texts by name; leave with 2 for a name that this actuator does not have."""
    from difflib import get_close_matches

    from pamctl.settings.datasheet.plant_questions import list_questions

    names = [question.name for question in list_questions(actuator)]
    texts = {}
    for text in given:
        name, equals, number = (part.strip() for part in text.partition("="))
        if name not in names or not equals or not number:
            near = get_close_matches(name, names, 1)
            hint = f"; did you mean {near[0]}?" if near and near[0] != name else ""
            raise typer.BadParameter(
                f"{text!r} is no NAME=NUMBER of the actuator {actuator}{hint}; its numbers are "
                f"{', '.join(names)}",
                param_hint="--value",
            )
        texts[name] = number
    return texts


def _collect_numbers(
    actuator: str, given: dict[str, str], *, ask: bool
) -> tuple[dict[str, float], dict[str, str]]:
    """Return the numbers in SI, and the texts that the user gave."""
    from pamctl.settings.datasheet.datasheet_units import read_quantity
    from pamctl.settings.datasheet.plant_questions import list_questions

    values: dict[str, float] = {}
    texts: dict[str, str] = {}
    for question in list_questions(actuator):
        if question.name in given:
            text = given[question.name]
            values[question.name] = read_quantity(question.name, text, values)
            question.check(values[question.name])
            texts[question.name] = text
            continue
        answer = _ask_number(question, values) if ask and not question.is_seldom else None
        if answer is not None:
            texts[question.name], values[question.name] = answer
        elif question.default is not None:
            values[question.name] = question.default
        elif not question.is_optional:
            raise Failed(
                ExitCode.USAGE,
                f"{question.name} ({question.meaning}) has no default: "
                f"give --value {question.name}='...' in {question.units}",
            )
    return values, texts


def _ask_number(question: PlantQuestion, known: dict[str, float]) -> tuple[str, float] | None:
    """Ask until the answer can be right; None for an empty answer, where one will do."""
    from pamctl.settings.datasheet.datasheet_units import DatasheetError, read_quantity

    optional = "none" if question.is_optional else ""
    default = f"{question.default:g}" if question.default is not None else optional
    typer.echo(f"{question.meaning}  ({question.units})", err=True)
    while True:
        text = _read_line(
            f"  {question.name}{f' [{default}]' if default else ''}: ", f"--value {question.name}"
        )
        if not text and default:
            return None
        try:
            value = read_quantity(question.name, text, known)
            question.check(value)
        except DatasheetError as error:
            print_error(str(error))
            continue
        typer.echo(f"  = {value:.6g}", err=True)
        return text, value


def _read_line(prompt: str, option: str) -> str:
    """Read one answer; leave with 2 where the input ends."""
    print(prompt, end="", file=sys.stderr, flush=True)
    line = sys.stdin.readline()
    if not line:
        print(file=sys.stderr)
        raise Failed(ExitCode.USAGE, f"the input ended: give {option}, or --yes for the defaults")
    return line.strip()


def _list_fitted(plant: PlantSettings) -> list[str]:
    from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE
    from pamctl.diagnose.fitting.numbers import calibration_of

    blocks = {"direct": (MECHANICS,), "chamber": (PRESSURE,)}.get(
        plant.actuator, (PRESSURE, MECHANICS)
    )
    names = [name for block in blocks for name in calibration_of(block, plant)]
    return list(dict.fromkeys(names))
