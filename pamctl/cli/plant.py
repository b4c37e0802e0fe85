"""`pamctl plant`: a plant file from a datasheet, and a plant file as an FMU."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pamctl.cli.failure import Failed
from pamctl.cli.options import JsonOption
from pamctl.cli.output import print_json
from pamctl.exit_codes import ExitCode
from pamctl.new_file import require_place, write_files

if TYPE_CHECKING:
    from pamctl.plant.model import PlantSettings

plant_app = typer.Typer(
    no_args_is_help=True, help="Make and export plant files, which describe a rig."
)

_ACTUATORS = ("muscle", "direct", "chamber", "cylinder")


@plant_app.callback()
def _group() -> None:
    """Make and export plant files, which describe a rig."""


@plant_app.command("new")
def make_plant(
    out: Annotated[Path, typer.Option("--out", metavar="FILE.yaml", help="New plant file")],
    actuator: Annotated[
        str,
        typer.Option("--actuator", metavar="|".join(_ACTUATORS), help="What moves, or is filled"),
    ] = "muscle",
    given: Annotated[
        list[str] | None,
        typer.Option(
            "--value",
            metavar="NAME=NUMBER",
            help="A number with its unit, such as rest_length_m='200 mm'; can be repeated",
            show_default="a usual one, to edit in the file",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write a plant file to edit: every number in SI with what it means, and which are fitted."""
    require_place(out)
    if actuator not in _ACTUATORS:
        which = f"{actuator!r} is not one of {', '.join(_ACTUATORS)}"
        raise typer.BadParameter(which, param_hint="--actuator")
    from pamctl.settings.datasheet.plant_file import build_plant, format_new_plant

    texts = _split_given(given or [], actuator)
    values = _collect_numbers(actuator, texts)
    plant = build_plant(actuator, values)
    names = _list_fitted(plant)
    fitted = ", ".join(names) or "nothing"
    write_files({out: format_new_plant(actuator, values, texts, fitted)})
    if as_json:
        print_json({"plant": str(out), "actuator": actuator, "numbers": values, "fitted": names})
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


def _collect_numbers(actuator: str, given: dict[str, str]) -> dict[str, float]:
    """Return all numbers in SI: those that are given, and the defaults of the others."""
    from pamctl.settings.datasheet.datasheet_units import read_quantity
    from pamctl.settings.datasheet.plant_questions import list_questions

    values: dict[str, float] = {}
    for question in list_questions(actuator):
        if question.name in given:
            value = read_quantity(question.name, given[question.name], values)
            question.check(value)
            values[question.name] = value
        elif question.default is not None:
            values[question.name] = question.default
        elif not question.is_optional:
            raise Failed(
                ExitCode.USAGE,
                f"{question.name} ({question.meaning}) has no default: "
                f"give --value {question.name}='...' in {question.units}",
            )
    return values


def _list_fitted(plant: PlantSettings) -> list[str]:
    from pamctl.diagnose.evidence.weigh import CALIBRATED, LOAD
    from pamctl.diagnose.plant_numbers import value_of

    names = [name for name in CALIBRATED[plant.actuator] if value_of(plant, name)]
    load = [LOAD] if plant.actuator == "direct" else []
    return [name for name in (*names, *load) if name not in plant.known]
