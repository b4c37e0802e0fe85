"""`pamctl audit`: what can an excitation not see, and not tell apart?"""

from __future__ import annotations

import string
import textwrap
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from pamctl.cli.options import PlantOptions, argument, flag, verb
from pamctl.cli.output import print_json
from pamctl.cli.settings_from_options import find_argument_file
from pamctl.settings.resolve import resolve

if TYPE_CHECKING:
    from pamctl.diagnose import Record
    from pamctl.diagnose.audit import Audit, Inseparable


class AuditOptions(PlantOptions):
    """`pamctl audit`."""

    what: str = argument(
        "EXPERIMENT|LOG", "Name of an experiment, experiment file (.yaml) or log (.mcap)"
    )
    verbose: bool = flag("--verbose", "Say why each effect cannot be shown")


@verb
def audit(asked: AuditOptions) -> None:
    """Show which effects an experiment or a log cannot show, before anything is fitted.

    An experiment is simulated with the default controller and the simulated rig's sensors.
    """
    plant = asked.read_plant()
    from pamctl.diagnose.audit import audit_run
    from pamctl.diagnose.report.next_experiment import write_advice

    record = _make_record(asked.what, asked.plant)
    found = audit_run(record, plant)
    runs_here = plant.actuator == "muscle" and not record.is_imported
    if asked.as_json:
        print_json(found.as_dict())
    else:
        advise = partial(write_advice, actuator=plant.actuator, runs_here=runs_here)
        typer.echo("\n".join(format_audit(found, advise, verbose=asked.verbose)))


def _make_record(what: str, plant: str | None) -> Record:
    if Path(what).suffix == ".mcap":
        from pamctl.diagnose.record import record_of

        return record_of(what)
    find_argument_file("experiment", what)  # its error names what the user typed
    from pamctl.diagnose import Record
    from pamctl.simulate.closed_loop import simulate_run

    run = simulate_run(resolve(experiment=what, plant=plant))
    return Record(
        Path(what).stem,
        run.t_s,
        valve_v=run["valve_v"],
        pressure_pa=run["pressure_pa"],
        position_m=run["position_m"],
        experiment=what,
    )


# --- the words --------------------------------------------------------------------------------

_WIDTH = 100
_NONE = "x"
Advise = Callable[[str], str]


def format_audit(found: Audit, advise: Advise, *, verbose: bool) -> list[str]:
    """Return the lines of an audit, at most 100 columns wide; the reasons with `verbose`."""
    seen = f"shows {len(found.sees)} effects: {', '.join(found.sees) or 'none'}"
    lines = [*textwrap.wrap(seen, _WIDTH, subsequent_indent="  "), ""]
    if found.blind_spots:
        lines.append("cannot show, at the smallest size of interest:")
        lines += _format_blind_spots(found, advise, verbose=verbose)
    else:
        lines.append("no blind spots")
    if found.inseparable:
        lines += [
            "",
            "cannot tell apart, at that size:",
            *_format_matrix(found.inseparable, advise),
        ]
    if found.unasked:
        lines += ["", *_format_unasked(found.unasked, verbose=verbose)]
    if not verbose and (found.blind_spots or found.unasked):
        lines += ["", "--verbose says why."]
    return lines


def _format_blind_spots(found: Audit, advise: Advise, *, verbose: bool) -> Iterator[str]:
    width = max(len(spot.name) for spot in found.blind_spots) + 2
    for spot in found.blind_spots:
        yield f"  {spot.name:<{width}}{spot.visibility}"
        add = f"add: {advise(spot.experiment)}" if spot.experiment else ""
        said = [spot.why] if verbose else []
        for text in [*said, *([add] if add and verbose else [])]:
            yield from textwrap.wrap(
                text, _WIDTH, initial_indent="      ", subsequent_indent="      "
            )
    if not verbose:
        for experiment in sorted({spot.experiment for spot in found.blind_spots} - {""}):
            shown = ", ".join(s.name for s in found.blind_spots if s.experiment == experiment)
            text = f"add: {advise(experiment)}  # for {shown}"
            yield from textwrap.wrap(text, _WIDTH, initial_indent="  ", subsequent_indent="      ")


def _format_unasked(unasked: Sequence[tuple[str, str]], *, verbose: bool) -> Iterator[str]:
    if not verbose:
        text = f"does not ask {len(unasked)} effects: {', '.join(name for name, _ in unasked)}"
        yield from textwrap.wrap(text, _WIDTH, subsequent_indent="  ")
        return
    yield "does not ask:"
    width = max(len(name) for name, _ in unasked) + 2
    for name, why in unasked:
        yield from textwrap.wrap(
            f"  {name:<{width}}{why}", _WIDTH, subsequent_indent=" " * (width + 2)
        )


def _format_matrix(pairs: Sequence[Inseparable], advise: Advise) -> Iterator[str]:
    """Draw a row and a column for each effect; a letter names what tells the two apart."""
    names = sorted({name for pair in pairs for name in pair.names})
    experiments = sorted({pair.experiment for pair in pairs} - {""})
    letter = {"": _NONE, **dict(zip(experiments, string.ascii_lowercase, strict=False))}
    cells = {frozenset(pair.names): letter.get(pair.experiment, "?") for pair in pairs}
    width = max(map(len, names)) + 6
    yield f"  {'':<{width}}" + "".join(f"{number:>3}" for number in range(1, len(names) + 1))
    for number, row in enumerate(names, 1):
        marks = "".join(f"{cells.get(frozenset((row, column)), '.'):>3}" for column in names)
        yield f"  {number:>3} {row:<{width - 4}}{marks}"
    for experiment in experiments:
        text = f"{letter[experiment]}: {advise(experiment)}"
        yield from textwrap.wrap(text, _WIDTH, initial_indent="  ", subsequent_indent="     ")
    if _NONE in cells.values():
        yield f"  {_NONE}: no shipped experiment separates them"
