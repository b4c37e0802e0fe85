"""`pamctl audit`: what can an excitation not see, and not tell apart?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pamctl.cli.config import JsonOption, PlantOption, exit_on_config_errors, find_argument_file
from pamctl.cli.diagnose import read_plant_settings
from pamctl.cli.offline import exit_on_bad_data, print_json
from pamctl.exit_codes import ExitCode

if TYPE_CHECKING:
    from pamctl.diagnose import Record
    from pamctl.diagnose.audit import Audit


def audit(
    what: Annotated[str, typer.Argument(metavar="EXPERIMENT|LOG", help="A name, .yaml or .mcap.")],
    plant: PlantOption = None,
    as_json: JsonOption = False,
) -> None:
    """Say what an experiment or a log cannot show of the catalogue, before anything is fitted.

    An experiment is simulated with the default controller and the simulated rig's sensors.
    """
    with exit_on_bad_data(as_json=as_json), exit_on_config_errors(as_json=as_json):
        start = read_plant_settings(plant)
        from pamctl.diagnose.audit import audit_run
        from pamctl.diagnose.measured.refuse import BadData

        try:
            found = audit_run(_make_record(what, plant), start)
        except BadData as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(ExitCode.BAD_DATA) from None
    if as_json:
        print_json(found.as_dict())
    else:
        typer.echo("\n".join(_format_audit(found)))


def _make_record(what: str, plant: str | None) -> Record:
    if Path(what).suffix == ".mcap":
        from pamctl.diagnose.measured.from_log import record_of

        return record_of(what)
    from pamctl.diagnose import Record
    from pamctl.settings.resolve import resolve
    from pamctl.simulate.batch import simulate_run

    find_argument_file("experiment", what)  # leaves first: resolve would blame an option
    run = simulate_run(resolve(experiment=what, plant=plant))
    return Record(
        Path(what).stem,
        run.t_s,
        valve_v=run["valve_v"],
        pressure_pa=run["pressure_pa"],
        position_m=run["position_m"],
    )


def _format_audit(found: Audit) -> list[str]:
    from pamctl.diagnose.experiments import write_command

    lines = [f"shows {len(found.sees)} effects: {', '.join(found.sees) or 'none'}", ""]
    if found.blind_spots:
        lines.append("cannot show, at the smallest size of interest:")
        lines += [
            f"  {s.name:<24}{s.why}; {_format_advice(s.visibility, s.experiment)}"
            for s in found.blind_spots
        ]
    else:
        lines.append("no blind spots")
    if found.inseparable:
        lines += ["", "cannot tell apart, at that size:"]
        lines += [
            f"  {' and '.join(pair.names):<44}{write_command(pair.experiment)}: {pair.why}"
            for pair in found.inseparable
        ]
    return lines


def _format_advice(visible: str, experiment: str) -> str:
    from pamctl.diagnose.experiments import write_command

    return f"{visible}; add: {write_command(experiment)}" if experiment else visible
