"""`pamctl health`: which numbers of the rig drift from run to run?"""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from pamctl.cli.options import JsonOption, PlantOption
from pamctl.cli.output import print_result
from pamctl.new_file import NewFileError, require_empty_folder, write_files
from pamctl.settings.config_files import DEFAULT_NAMES, find_config_file
from pamctl.settings.resolve import read_section_file


def health(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with the logs of one rig")],
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the results, new or empty")
    ],
    plant: PlantOption = None,
    last: Annotated[
        int | None,
        typer.Option("--last", metavar="N", min=2, help="Newest logs to fit", show_default="all"),
    ] = None,
    jobs: Annotated[
        int, typer.Option("--jobs", metavar="N", min=1, help="Number of worker processes")
    ] = 1,
    as_json: JsonOption = False,
) -> None:
    """Fit the plant's numbers to every run of a folder, and say which of them drift.

    DIR of --out gets health.json, report.html and plant.yaml, the last good state.
    A number is compared with its 90 % intervals; steps and trends are told apart.
    """
    require_empty_folder(out)
    start = read_section_file("plant", find_config_file("plant", plant or DEFAULT_NAMES["plant"]))
    from pamctl.cluster.worker_processes import start_workers
    from pamctl.health.follow_health import follow_health
    from pamctl.health.health_words import (
        build_health_document,
        describe_health,
        format_good_plant,
        write_health_page,
    )
    from pamctl.json_text import to_json
    from pamctl.report.html_page import write_html
    from pamctl.runs.run_index import RunIndex
    from pamctl.runs.run_row import UNREADABLE

    with RunIndex(folder) as index:
        index.refresh()
        rows = [row for row in index.select(with_gains=False) if row.ending != UNREADABLE]
    logs = [(folder / row.path, row.when_s) for row in rows][-last if last else 0 :]
    with start_workers(jobs) if jobs > 1 else nullcontext() as executor:
        found = follow_health(logs, start, executor, lambda line: typer.echo(line, err=True))
    document = build_health_document(found)
    files = {
        "health.json": to_json(document).decode() + "\n",
        "report.html": write_html(write_health_page(found, folder.name or str(folder))),
    }
    if found.plant is not None:
        files["plant.yaml"] = format_good_plant(found)
    failure = None
    try:
        write_files({out / name: content for name, content in files.items()})
    except NewFileError as error:
        failure = error
    text = "\n".join([*describe_health(found), f"{out}: {', '.join(files)}"])
    print_result(document, lambda: text, failure, as_json=as_json)
