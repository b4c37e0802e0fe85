"""`pamctl audit`: what can an excitation not see, and not tell apart?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pamctl.cli.config import JsonOption, PlantOption, config_errors_exit, file_of_argument
from pamctl.cli.diagnose import plant_named
from pamctl.cli.offline import bad_data_exits, print_json
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
    with bad_data_exits(as_json=as_json), config_errors_exit(as_json=as_json):
        start = plant_named(plant)
        from pamctl.diagnose.audit import audit_of
        from pamctl.diagnose.measured.refuse import BadData

        try:
            found = audit_of(_record(what, plant), start)
        except BadData as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(ExitCode.BAD_DATA) from None
    if as_json:
        print_json(found.document())
    else:
        typer.echo("\n".join(_lines(found)))


def _record(what: str, plant: str | None) -> Record:
    if Path(what).suffix == ".mcap":
        from pamctl.diagnose.measured.from_log import record_of

        return record_of(what)
    from pamctl.diagnose import Record
    from pamctl.settings.resolve import resolve
    from pamctl.simulate.batch import simulated

    file_of_argument("experiment", what)  # leaves first: resolve would blame an option
    run = simulated(resolve(experiment=what, plant=plant))
    return Record(
        Path(what).stem,
        run.t_s,
        valve_v=run["valve_v"],
        pressure_pa=run["pressure_pa"],
        position_m=run["position_m"],
    )


def _lines(found: Audit) -> list[str]:
    lines = [f"shows {len(found.sees)} effects: {', '.join(found.sees) or 'none'}", ""]
    if found.blind_spots:
        lines.append("cannot show, at the smallest size of interest:")
        lines += [
            f"  {s.name:<24}{s.why}; {_advice(s.visible, s.experiment)}" for s in found.blind_spots
        ]
    else:
        lines.append("no blind spots")
    if found.inseparable:
        lines += ["", "cannot tell apart, at that size:"]
        lines += [
            f"  {' and '.join(pair.names):<44}{pair.experiment}: {pair.why}"
            for pair in found.inseparable
        ]
    return lines


def _advice(visible: str, experiment: str) -> str:
    return f"{visible}; add: {experiment}" if experiment else visible
