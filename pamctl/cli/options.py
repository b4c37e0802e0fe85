"""The options that several verbs share, each with its help, its default and its range."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from pamctl.cli.failure import Failed
from pamctl.exit_codes import ExitCode
from pamctl.settings.config_files import DEFAULT_NAMES

NO_CHANGES = "no changes"

# --- what to run ------------------------------------------------------------------------------

ControllerOption = Annotated[
    str | None,
    typer.Option(
        "--controller",
        metavar="NAME|FILE",
        help="Control law and its gains",
        show_default=DEFAULT_NAMES["controller"],
    ),
]
ControllerFromOption = Annotated[
    str | None,
    typer.Option(
        "--controller-from",
        metavar="FILE.py[:NAME]",
        help="Python file that defines the control law; its gains come from --controller",
        show_default="none",
    ),
]
ExperimentOption = Annotated[
    str | None,
    typer.Option(
        "--experiment",
        metavar="NAME|FILE",
        help="Experiment to run",
        show_default=DEFAULT_NAMES["experiment"],
    ),
]
RigOption = Annotated[
    str | None,
    typer.Option(
        "--rig",
        metavar="NAME|FILE",
        help="Rig file with calibration and limits",
        show_default="that of --backend, sim",
    ),
]
PlantOption = Annotated[
    str | None,
    typer.Option(
        "--plant",
        metavar="NAME|FILE",
        help="Plant file with the model of the muscle",
        show_default=DEFAULT_NAMES["plant"],
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Setting to change, such as controller.lambda_per_s=12; can be repeated",
        show_default=NO_CHANGES,
    ),
]
SeedOption = Annotated[
    int | None,
    typer.Option(
        "--seed", metavar="N", help="Seed of the simulated noise, 0 or more", show_default="0"
    ),
]
DurationOption = Annotated[
    float | None,
    typer.Option(
        "--duration",
        metavar="SECONDS",
        help="End the run this long after homing, more than 0 s",
        show_default="length of the experiment",
    ),
]
FastOption = Annotated[
    bool, typer.Option("--fast", help="Simulate without a clock, as fast as possible")
]
RtOption = Annotated[
    str | None,
    typer.Option(
        "--rt",
        metavar="auto|require|off",
        help="Use of real-time scheduling; 'require' fails where it is not permitted",
        show_default="auto",
    ),
]
ClusterOption = Annotated[
    str | None,
    typer.Option(
        "--cluster",
        metavar="ADDRESS",
        help="Scheduler of a Dask cluster whose workers share the work, such as tcp://HOST:8786; "
        "needs the extra 'cluster'",
        show_default="this machine",
    ),
]
InteractiveOption = Annotated[
    bool,
    typer.Option(
        "--interactive",
        help="Let a script in the page zoom its plots and read values; it needs no network",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document as the result")]
SocketOption = Annotated[
    Path | None,
    typer.Option(
        "--socket",
        metavar="PATH",
        help="Control socket of the daemon",
        show_default="this user's, else the system's",
    ),
]

# --- what is said of a run --------------------------------------------------------------------

NoteOption = Annotated[
    str | None, typer.Option("--note", metavar="TEXT", help="Note for the log", show_default="none")
]
OperatorOption = Annotated[
    str | None, typer.Option("--operator", metavar="NAME", help="Who runs it", show_default="none")
]
SampleOption = Annotated[
    str | None,
    typer.Option("--sample", metavar="NAME", help="Muscle or part on the rig", show_default="none"),
]
TagOption = Annotated[
    list[str] | None,
    typer.Option(
        "--tag",
        metavar="TAG",
        help="Tag of the log, one word; can be repeated",
        show_default="none",
    ),
]


def require_one_place(cluster: str | None, jobs: int | None) -> None:
    """Leave with 2 if work is asked for here and on a cluster."""
    if cluster is not None and jobs is not None:
        message = "are workers on this machine: a cluster has its own"
        raise typer.BadParameter(message, param_hint="--jobs")


# --- times ------------------------------------------------------------------------------------


def seconds_option(
    name: str,
    help_text: str,
    *,
    at_least: float | None = None,
    more_than: float | None = None,
    at_most: float = math.inf,
    show_default: bool | str = True,
) -> Any:
    """Return an option in seconds that leaves with 2 outside its range; the help shows the range.

    Give one of `at_least` and `more_than`. typer's own ranges call nan too small.
    """
    low = f"at least {at_least:g}" if at_least is not None else f"more than {more_than:g}"
    limits = f"{low} and at most {at_most:g} s" if math.isfinite(at_most) else f"{low} s"
    return typer.Option(
        name,
        metavar="SECONDS",
        help=f"{help_text}, {limits}",
        show_default=show_default,
        callback=_check_seconds(limits, at_least, more_than, at_most),
    )


def _check_seconds(
    limits: str, at_least: float | None, more_than: float | None, at_most: float
) -> Callable[[float | None], float | None]:
    def check(seconds: float | None) -> float | None:
        if seconds is None:
            return None
        if not math.isfinite(seconds):
            raise typer.BadParameter(f"must be finite (got {seconds:g})")
        is_low = seconds < at_least if at_least is not None else seconds <= (more_than or 0.0)
        if is_low or seconds > at_most:
            raise typer.BadParameter(f"must be {limits} (got {seconds:g})")
        return seconds

    return check


# --- where a verb works -----------------------------------------------------------------------


def require_linux() -> None:
    """Leave with 69 on other systems, before anything is imported that only Linux has."""
    if sys.platform != "linux":
        others = "`run --fast`, the verbs that read logs, config, reproduce and tune work here too"
        raise Failed(ExitCode.UNAVAILABLE, f"this verb needs Linux; {others}")
