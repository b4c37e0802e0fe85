"""`pamctl audit`: what can an excitation not see, and not tell apart?"""

from __future__ import annotations

import string
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pamctl.cli.options import PlantOptions, argument, flag, verb
from pamctl.cli.output import print_report
from pamctl.cli.settings_from_options import find_argument_file
from pamctl.settings.resolve import resolve

if TYPE_CHECKING:
    from pamctl.diagnose import Record
    from pamctl.diagnose.audit import Audit, BlindSpot, Inseparable
    from pamctl.report.report import Part, Report


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
    advise = partial(write_advice, actuator=plant.actuator, runs_here=runs_here)
    print_report(report_audit(found, advise, verbose=asked.verbose), as_json=asked.as_json)


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

_NONE = "x"
Advise = Callable[[str], str]


def report_audit(found: Audit, advise: Advise, *, verbose: bool) -> Report:
    """Return what an excitation shows and does not; with the reasons if `verbose`."""
    from pamctl.report.report import Points, Report, ReportTable, Section, Text

    report = Report("Audit", f"shows {len(found.sees)} effects", document=found.as_dict())
    report.add(Points([", ".join(found.sees)] if found.sees else []))
    spots = found.blind_spots
    if not spots:
        report.add(Text("no blind spots"))
    else:
        report.add(Section("cannot show, at the smallest size of interest"))
    if spots and verbose:
        report.add(Points([_explain_blind_spot(spot, advise) for spot in spots]))
    elif spots:
        report.add(ReportTable(["effect", ""], [[spot.name, spot.visibility] for spot in spots]))
        shown: dict[str, list[str]] = {}
        for spot in spots:
            shown.setdefault(spot.experiment, []).append(spot.name)
        adds = [f"{advise(e)}  # for {', '.join(shown[e])}" for e in sorted(shown) if e]
        report.add(Points([f"add: {add}" for add in adds]))
    if found.inseparable:
        report.add(Section("cannot tell apart, at that size"))
        report.add(*_draw_matrix(found.inseparable, advise))
    if found.unasked:
        report.add(Section(f"does not ask {len(found.unasked)} effects"))
        names = [", ".join(name for name, _ in found.unasked)]
        report.add(Points([f"{name}: {why}" for name, why in found.unasked] if verbose else names))
    if not verbose and (spots or found.unasked):
        report.add(Section("--verbose says why."), Text(""))
    return report


def _explain_blind_spot(spot: BlindSpot, advise: Advise) -> str:
    add = f"; add: {advise(spot.experiment)}" if spot.experiment else ""
    return f"{spot.name}: {spot.visibility}; {spot.why}{add}"


def _draw_matrix(pairs: Sequence[Inseparable], advise: Advise) -> Sequence[Part]:
    """Draw a row and a column for each effect; a letter names what tells the two apart."""
    from pamctl.report.report import Points, ReportTable

    names = sorted({name for pair in pairs for name in pair.names})
    experiments = sorted({pair.experiment for pair in pairs} - {""})
    letter = {"": _NONE, **dict(zip(experiments, string.ascii_lowercase, strict=False))}
    cells = {frozenset(pair.names): letter.get(pair.experiment, "?") for pair in pairs}
    rows = [
        [str(number), row, *(cells.get(frozenset((row, column)), ".") for column in names)]
        for number, row in enumerate(names, 1)
    ]
    key = [f"{letter[experiment]}: {advise(experiment)}" for experiment in experiments]
    if _NONE in cells.values():
        key.append(f"{_NONE}: no shipped experiment separates them")
    return ReportTable(["", "", *map(str, range(1, len(names) + 1))], rows), Points(key)
