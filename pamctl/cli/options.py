"""What a verb may be asked, described once: the type, option, help, default and range of a value.

A verb is a function of one class of options. `verb` makes of it what typer takes:

    class CheckOptions(Options):
        paths: list[Path] = argument("LOG...", "Logs to check")
        most: int = option("--most N", "Most findings to print", 20, low=1)

    @verb
    def check_logs(asked: CheckOptions) -> None:
        ...
"""

from __future__ import annotations

import inspect
import math
import sys
from collections.abc import Callable, Iterator
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, get_args, get_type_hints

import typer

from pamctl.base.errors import ExitCode
from pamctl.cli.failure import Failed
from pamctl.settings.config_files import DEFAULT_NAMES

if TYPE_CHECKING:
    from pamctl.log.run_meta import Annotation
    from pamctl.plant.model import PlantSettings

NO_CHANGES = "no changes"

# --- how options are declared -----------------------------------------------------------------


class _Declared(NamedTuple):
    """An argument or option, and its default."""

    info: Any
    default: Any


def argument(metavar: str, told: str, default: Any = ..., *, shown: str | bool = True) -> Any:
    """Declare an argument; without a default it is required."""
    return _Declared(typer.Argument(metavar=metavar, help=told, show_default=shown), default)


def option(
    spelled: str,
    told: str,
    default: Any = None,
    *,
    shown: str | bool = True,
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
) -> Any:
    """Declare an option by its name and what stands for its value: `--last N`.

    Its value lies from `low`, or above `above`, to `high`. `shown` says in the help what a default
    of None means. With `...` for a default it is required; a range of seconds is told in the help.
    """
    name, _, metavar = spelled.partition(" ")
    limits: dict[str, Any] = {"min": low, "max": high}
    if metavar == "SECONDS" and (low is not None or above is not None):
        least = f"more than {above:g}" if low is None else f"at least {low:g}"
        told_range = f"{least} s" if high is None else f"{least} and at most {high:g} s"
        told, limits = f"{told}, {told_range}", {}
        limits["callback"] = _check_seconds(told_range, low, above or 0.0, high)
    made = typer.Option(name, metavar=metavar or None, help=told, show_default=shown, **limits)
    return _Declared(made, default)


def _check_seconds(
    told_range: str, low: float | None, above: float, high: float | None
) -> Callable[[float | None], float | None]:
    """Return what leaves with 2 outside a range; typer's own ranges call nan too small."""

    def check(seconds: float | None) -> float | None:
        if seconds is None:
            return None
        if not math.isfinite(seconds):
            raise typer.BadParameter(f"must be finite and {told_range} (got {seconds:g})")
        is_low = seconds <= above if low is None else seconds < low
        if is_low or (high is not None and seconds > high):
            raise typer.BadParameter(f"must be {told_range} (got {seconds:g})")
        return seconds

    return check


def flag(name: str, told: str) -> Any:
    """Declare an option without a value."""
    return _Declared(typer.Option(name, help=told), False)


class Options:
    """What a verb was asked: an attribute for each argument and option, those of a subclass first.

    A list is empty where nothing was given.
    """

    as_json: bool = flag("--json", "Print one JSON document as the result")

    def __init__(self, context: typer.Context | None, given: dict[str, Any]) -> None:
        """`given` holds a value for each of them."""
        vars(self).update(given)
        self._context = context

    def is_typed(self, name: str) -> bool:
        """Tell whether an option was given, and is not at its default."""
        source = None if self._context is None else self._context.get_parameter_source(name)
        return source is not None and source.name == "COMMANDLINE"

    @property
    def inner_verb(self) -> str | None:
        """The verb after this one: a group such as `pamctl runs` is a verb too."""
        return None if self._context is None else self._context.invoked_subcommand


def verb(do: Callable[[Any], None]) -> Callable[..., None]:
    """Make what typer takes of a verb and its class of options."""
    (asked, *_) = get_type_hints(do).values()
    fields = list(list_fields(asked))
    lists = [one.name for one in fields if "list[" in str(get_args(one.annotation)[0])]

    @wraps(do)
    def carry_out(context: typer.Context, **given: Any) -> None:
        do(asked(context, given | {name: given[name] or [] for name in lists}))

    context = inspect.Parameter("context", _BY_NAME, annotation=typer.Context)
    made: Any = carry_out
    made.__signature__ = inspect.Signature([context, *fields])
    made.__annotations__ = {one.name: one.annotation for one in (context, *fields)}
    del made.__wrapped__
    return carry_out


_BY_NAME = inspect.Parameter.KEYWORD_ONLY


def list_fields(asked: type[Options]) -> Iterator[inspect.Parameter]:
    """Yield a class of options as the parameters that typer takes."""
    hints = get_type_hints(asked, include_extras=True)
    names = dict.fromkeys(
        name for kind in asked.__mro__[:-1] for name in inspect.get_annotations(kind)
    )
    for name in names:
        declared, kind = getattr(asked, name), hints[name]
        default = inspect.Parameter.empty if declared.default is ... else declared.default
        if default is None:
            kind = kind | None
        yield inspect.Parameter(
            name, _BY_NAME, default=default, annotation=Annotated[kind, declared.info]
        )


# --- what several verbs are asked -------------------------------------------------------------

PLANT = option(
    "--plant NAME|FILE", "Plant file with the model of the muscle", shown=DEFAULT_NAMES["plant"]
)
CONTROLLER = option(
    "--controller NAME|FILE", "Control law and its gains", shown=DEFAULT_NAMES["controller"]
)
CONTROLLER_FROM = option(
    "--controller-from FILE.py[:NAME]",
    "Python file that defines the control law; its gains come from --controller",
    shown="none",
)
LOGS = option("--logs DIRECTORY", "Directory with the logs", Path("logs"))
JOBS = option("--jobs N", "Number of parallel workers", shown="all CPUs", low=1)
CLUSTER = option(
    "--cluster ADDRESS",
    "Scheduler of a Dask cluster whose workers share the work, such as tcp://HOST:8786; needs the "
    "package distributed",
    shown="this machine",
)
INTERACTIVE = flag(
    "--interactive", "Let a script in the page zoom its plots and read values; it needs no network"
)
MAP = option(
    "--map FILE", "File that says what the columns of a measured file hold", shown="by their names"
)
SOCKET = option(
    "--socket PATH", "Control socket of the daemon", shown="this user's, else the system's"
)
MAY_MOVE = flag("--yes", "Do not ask whether the rig may be pressurised and move")


class PlantOptions(Options):
    """The model that a verb judges with."""

    plant: str | None = PLANT

    def read_plant(self) -> PlantSettings:
        """Return the plant; raise `ConfigError`."""
        from pamctl.settings.config_files import find_config_file
        from pamctl.settings.resolve import read_section_file

        path = find_config_file("plant", self.plant or DEFAULT_NAMES["plant"])
        plant: PlantSettings = read_section_file("plant", path)
        return plant


class DataOptions(PlantOptions):
    """What the user says of measured logs."""

    accept: list[str] = option(
        "--accept RULE=REASON",
        "Rule about the data to overrule, such as gap='logger paused'; "
        "the document keeps the reason; can be repeated",
        shown="none",
    )
    noise: list[str] = option(
        "--noise CHANNEL=SIGMA",
        "Noise of a sensor, as a standard deviation in SI, such as position_m=2e-6; "
        "can be repeated",
        shown="from the records",
    )

    def read_noise(self) -> dict[str, float]:
        """Return standard deviations by channel, in SI; leave with 2 where one is wrong."""
        from pamctl.diagnose.record import parse_noise

        try:
            return parse_noise(self.noise)
        except ValueError as error:
            raise typer.BadParameter(str(error), param_hint="--noise") from error


# --- what is said of a run --------------------------------------------------------------------


class AnnotationOptions(Options):
    """What the user says of a run, for its log."""

    note: str | None = option("--note TEXT", "Note for the log", shown="none")
    operator: str | None = option("--operator NAME", "Who runs it", shown="none")
    sample: str | None = option("--sample NAME", "Muscle or part on the rig", shown="none")
    tags: list[str] = option("--tag TAG", "Tag of the log, one word; can be repeated", shown="none")

    def make_annotation(self) -> Annotation:
        """Return it; raise `AnnotationError` where a log cannot hold it."""
        from pamctl.log.run_meta import make_annotation

        return make_annotation(self.tags, self.note, self.operator, self.sample)


def require_one_place(cluster: str | None, jobs: int | None) -> None:
    """Leave with 2 if work is asked for here and on a cluster."""
    if cluster is not None and jobs is not None:
        message = "are workers on this machine: a cluster has its own"
        raise typer.BadParameter(message, param_hint="--jobs")


# --- where a verb works -----------------------------------------------------------------------


def require_linux() -> None:
    """Leave with 69 on other systems, before anything is imported that only Linux has."""
    if sys.platform != "linux":
        others = "`run --fast`, the verbs that read logs, config, reproduce and tune work here too"
        raise Failed(ExitCode.UNAVAILABLE, f"this verb needs Linux; {others}")
