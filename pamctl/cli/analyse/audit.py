"""`pamctl audit`: what can an excitation not see, and not tell apart?"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pamctl.cli.options import JsonOption, PlantOption
from pamctl.cli.output import print_json
from pamctl.cli.settings_from_options import find_argument_file
from pamctl.settings.config_files import DEFAULT_NAMES, find_config_file
from pamctl.settings.resolve import read_section_file, resolve

if TYPE_CHECKING:
    from pamctl.diagnose import Record


def audit(
    what: Annotated[
        str,
        typer.Argument(
            metavar="EXPERIMENT|LOG",
            help="Name of an experiment, experiment file (.yaml) or log (.mcap)",
        ),
    ],
    plant: PlantOption = None,
    verbose: Annotated[
        bool, typer.Option("--verbose", help="Say why each effect cannot be shown")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Show which effects an experiment or a log cannot show, before anything is fitted.

    An experiment is simulated with the default controller and the simulated rig's sensors.
    """
    start = read_section_file("plant", find_config_file("plant", plant or DEFAULT_NAMES["plant"]))
    from pamctl.cli.analyse.audit_text import format_audit
    from pamctl.diagnose.audit import audit_run

    record = _make_record(what, plant)
    found = audit_run(record, start)
    runs_here = start.actuator == "muscle" and not record.is_imported
    if as_json:
        print_json(found.as_dict())
    else:
        advise = partial(_write_advice, actuator=start.actuator, runs_here=runs_here)
        typer.echo("\n".join(format_audit(found, advise, verbose=verbose)))


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


def _write_advice(experiment: str, *, actuator: str, runs_here: bool) -> str:
    from pamctl.diagnose.report.next_experiment import write_advice

    return write_advice(experiment, actuator, runs_here=runs_here)
