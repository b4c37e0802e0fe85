"""`pamctl diagnose`: which effect does the model lack?"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pamctl.cli.config import JsonOption, PlantOption, exit_on_config_errors
from pamctl.cli.offline import exit_on_bad_data, print_json
from pamctl.exit_codes import ExitCode

if TYPE_CHECKING:
    from pamctl.diagnose import Diagnosis, Record
    from pamctl.plant.model import PlantSettings


def diagnose(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Fitted on.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Made, or empty.")],
    holdout: Annotated[
        list[Path] | None,
        typer.Option("--holdout", metavar="LOG", help="Judged by; repeats. Else the logs are cut."),
    ] = None,
    plant: PlantOption = None,
    without: Annotated[
        list[str] | None,
        typer.Option("--without", metavar="EFFECT", help="Leave it out of the catalogue; repeats."),
    ] = None,
    correction: Annotated[
        bool,
        typer.Option(
            "--correction",
            help="Add what no effect explains to the model, as a table without a name.",
        ),
    ] = False,
    jobs: Annotated[int, typer.Option("--jobs", min=1, help="Worker processes.")] = 1,
    as_json: JsonOption = False,
) -> None:
    """Find where model and measurement disagree, name the missing effect, add it to the model.

    DIR gets diagnosis.json, plant.yaml (for --plant of run, tune, compare and a next
    diagnose) and report.html. Exit code 0 whatever the verdict, 65 if the data are no good.
    """
    with exit_on_bad_data(as_json=as_json), exit_on_config_errors(as_json=as_json):
        _require_room(out)
        start = read_plant_settings(plant)
        _require_known(without or [])
        from pamctl.diagnose import diagnose as diagnosed
        from pamctl.diagnose import summary
        from pamctl.diagnose.measured.from_log import record_of
        from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document

        train = [record_of(path) for path in logs]
        held = [record_of(path) for path in holdout or []]
        if not held:
            how = "the runs are split" if len(train) > 1 else "long stretches of it are held out"
            typer.echo(f"no --holdout: {how}", err=True)
        with _start_workers(jobs) as executor:
            diagnosis = diagnosed(
                train,
                held,
                start,
                without=without or (),
                correction=correction,
                executor=executor,
                progress=lambda line: typer.echo(line, err=True),
            )
        _write_results(diagnosis, out, [*logs, *(holdout or [])], [*train, *held])
    if as_json:
        print_json(build_diagnosis_document(diagnosis))
    else:
        typer.echo(summary(diagnosis))
        typer.echo(f"\n{out}: {', '.join(sorted(p.name for p in out.iterdir()))}")
    raise typer.Exit(ExitCode.BAD_DATA if diagnosis.reason else ExitCode.OK)


def read_plant_settings(name: str | None) -> PlantSettings:
    """Read a plant file by name or path; raise `ConfigError`."""
    from pamctl.settings.resolve import (
        DEFAULT_NAMES,
        SECTIONS,
        RawSettings,
        find_config_file,
        validate_settings,
    )

    file = find_config_file("plant", name or DEFAULT_NAMES["plant"])
    settings: PlantSettings = validate_settings(
        SECTIONS["plant"], RawSettings.read(file), title="plant"
    )
    return settings


def _require_room(out: Path) -> None:
    """A former diagnosis is not overwritten, nor anything else."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise typer.BadParameter(
            f"{out} exists and is not an empty folder; choose another", param_hint="--out"
        )


def _require_known(names: Sequence[str]) -> None:
    from difflib import get_close_matches

    from pamctl.plant.catalogue import CATALOGUE

    for name in names:
        if name not in CATALOGUE:
            near = get_close_matches(name, CATALOGUE, 1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise typer.BadParameter(
                f"there is no effect {name} in the catalogue{hint}", param_hint="--without"
            )


@contextmanager
def _start_workers(jobs: int) -> Iterator[Executor | None]:
    if jobs == 1:
        yield None
        return
    with ProcessPoolExecutor(jobs) as executor:
        yield executor


def _write_results(
    diagnosis: Diagnosis, out: Path, logs: Sequence[Path], records: Sequence[Record]
) -> None:
    from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
    from pamctl.diagnose.report.diagnosis_page import build_diagnosis_page
    from pamctl.diagnose.report.extended_plant_file import format_plant_file

    out.mkdir(parents=True, exist_ok=True)
    written = json.dumps(build_diagnosis_document(diagnosis), indent=2, allow_nan=False) + "\n"
    (out / "diagnosis.json").write_text(written)
    if not diagnosis.reason:
        (out / "plant.yaml").write_text(format_plant_file(diagnosis, [p.name for p in logs]))
    page = build_diagnosis_page(diagnosis, records).html()
    (out / "report.html").write_text(page, encoding="utf-8")
