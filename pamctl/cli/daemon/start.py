"""`pamctl start`: run an experiment."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from pamctl.cli.daemon.ask import ask, print_answer, read_section
from pamctl.cli.options import (
    NO_CHANGES,
    JsonOption,
    NoteOption,
    OperatorOption,
    SampleOption,
    SocketOption,
    TagOption,
    seconds_option,
)
from pamctl.log.annotation import make_annotation
from pamctl.log.run_meta import file_safe_name


def start(
    experiment: Annotated[
        str, typer.Argument(metavar="NAME|FILE", help="Experiment to run, as for pamctl run")
    ],
    duration_s: Annotated[
        float | None,
        seconds_option(
            "--duration",
            "End the run this long after homing",
            more_than=0.0,
            show_default="length of the experiment",
        ),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Key of the experiment to change, such as amplitude_mm=2; can be repeated",
            show_default=NO_CHANGES,
        ),
    ] = None,
    note: NoteOption = None,
    operator: OperatorOption = None,
    sample: SampleOption = None,
    tags: TagOption = None,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Run an experiment; home first if the muscle is not homed."""
    said = make_annotation(tags or (), note, operator, sample)
    data = read_section("experiment", experiment, overrides or ())
    params: dict[str, object] = {
        "experiment": data,
        "name": file_safe_name(experiment),
        "duration_s": duration_s,
    }
    params |= {**asdict(said), "tags": list(said.tags)}
    print_answer(ask(socket, "start", params), "log: {log}", as_json=as_json)
