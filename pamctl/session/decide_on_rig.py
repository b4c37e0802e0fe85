"""Decide on the rig: run, diagnose, choose the next program, run it, until one explanation is left.

Nothing moves without the caller's rig: a daemon's, or a simulated one. Each program was simulated
under every explanation within the rig's limits before it is run; the rig's own safety watches it
as any run. An exception, such as Ctrl-C or a trip, ends the rounds; the investigation keeps what
was found so far.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pamctl.base.texts import count_of
from pamctl.control.experiment import plan_experiment
from pamctl.diagnose import Diagnosis, Verdict, diagnose
from pamctl.diagnose.record import Record
from pamctl.diagnose.report.diagnosis_page import write_diagnosis
from pamctl.diagnose.report.finding_words import spell_names
from pamctl.diagnose.report.verdict_words import sentence
from pamctl.report.report import Points, Report, ReportTable, Section
from pamctl.session.pamctl_error import PamctlError, translate_errors
from pamctl.session.rig_plan import BETWEEN_S, FULL_PROGRAM, RigPlan, require_inside
from pamctl.session.steered_rig import SteeredRig
from pamctl.settings.config_files import find_config_file
from pamctl.settings.resolve import read_section_file, settings_to_data


@dataclass(frozen=True)
class RigRound:
    """One program on the rig, and the diagnosis of all records so far."""

    number: int
    program: str
    why: str
    log: str
    rig_time_s: float
    """Homing, program and rest."""
    diagnosis: Diagnosis

    @property
    def left(self) -> tuple[str, ...]:
        """The explanations that the data leave open; one where they are decided."""
        return self.diagnosis.explanations

    def as_dict(self) -> dict[str, Any]:
        """Return what the document holds."""
        return {
            "round": self.number,
            "program": self.program,
            "why": self.why,
            "log": self.log,
            "rig_time_s": round(self.rig_time_s, 3),
            "verdict": self.diagnosis.verdict.value,
            "sentence": sentence(self.diagnosis),
            "explanations_left": [*self.left],
            "forecasts": [f.as_dict() for f in self.diagnosis.forecasts if f.record == self.log],
        }


MOST_TOGETHER = 2
"""Programs that may refute an explanation together, where none does alone."""
_OPEN = (Verdict.AMBIGUOUS, Verdict.PARTIAL, Verdict.DESCRIBED)

Progress = Callable[[str], None]


@dataclass(frozen=True)
class NextProgram:
    """What is run next, and why."""

    experiment: Mapping[str, Any]
    name: str
    why: str
    lasts_s: float


@dataclass
class Investigation:
    """What was run and found so far; it grows round by round."""

    plan: RigPlan
    records: list[Record] = field(default_factory=list)
    rounds: list[RigRound] = field(default_factory=list)
    diagnosis: Diagnosis | None = None
    stopped: str = ""
    """Why no further program was run."""
    is_decided: bool = False
    """One explanation is left, or nothing is missing."""

    @property
    def rig_time_s(self) -> float:
        """Time on the rig so far."""
        return sum(each.rig_time_s for each in self.rounds)

    @property
    def programs(self) -> int:
        """Programs that were run."""
        return sum(bool(each.program) for each in self.rounds)

    def as_dict(self) -> dict[str, Any]:
        """Return the document's key `on_rig`."""
        return {
            "rounds": [each.as_dict() for each in self.rounds],
            "stopped": self.stopped,
            "is_decided": self.is_decided,
            "rig_time_s": round(self.rig_time_s, 3),
            "plan": self.plan.as_dict(),
        }


def decide_on_rig(
    rig: SteeredRig,
    investigation: Investigation,
    *,
    progress: Progress = lambda line: None,
) -> None:
    """Run rounds on the rig until the investigation is decided, or says why it stopped.

    Records that the investigation has already are diagnosed first. Raises `PamctlError` where a
    run does not end well: its rounds so far remain.
    """
    plan = investigation.plan
    if plan.first is None:
        _conclude(investigation, None, 0.0, progress)
    else:
        first = NextProgram(plan.first, plan.first_name, "the first program", plan.first_s)
        _run_round(rig, investigation, first, progress)
    while True:
        following = _choose_next(investigation)
        if isinstance(following, str):
            investigation.stopped = following
            return
        rig.sleep(BETWEEN_S)
        _run_round(rig, investigation, following, progress)


def _run_round(
    rig: SteeredRig,
    investigation: Investigation,
    program: NextProgram,
    progress: Progress,
) -> None:
    number = investigation.programs + 1
    progress(f"round {number}: {program.name}, {program.lasts_s:.1f} s; {program.why}")
    run = rig.run(program.experiment, name=program.name)
    investigation.records.append(run.to_record())
    _conclude(investigation, program, run.duration_s + BETWEEN_S, progress)


def _conclude(
    investigation: Investigation,
    program: NextProgram | None,
    rig_time_s: float,
    progress: Progress,
) -> None:
    """Diagnose all records; each of their blocks is left out in turn."""
    records = investigation.records
    with translate_errors():
        found = diagnose(records, [], investigation.plan.start, progress=progress)
    found = replace(found, is_of_daemon=True)
    investigation.diagnosis = found
    investigation.rounds.append(
        RigRound(
            investigation.programs + bool(program),
            program.name if program else "",
            program.why if program else "the given logs",
            records[-1].name if program else ", ".join(r.name for r in records),
            rig_time_s,
            found,
        )
    )
    last = investigation.rounds[-1]
    left = f"; left: {', '.join(last.left)}" if len(last.left) > 1 else ""
    progress(f"round {last.number}: {found.verdict.value}{left}")


def _choose_next(investigation: Investigation) -> NextProgram | str:
    """Return the next program, or why there is none."""
    following = _find_question(investigation)
    if isinstance(following, str):
        return following
    budget = investigation.plan.budget
    if investigation.programs >= budget.runs:
        return f"the budget of {count_of(budget.runs, 'program')} is spent"
    needed_s = investigation.rig_time_s + following.lasts_s + BETWEEN_S
    if needed_s > 60.0 * budget.minutes:
        return f"the budget of {budget.minutes:g} min on the rig would be passed"
    return following


def _find_question(investigation: Investigation) -> NextProgram | str:
    found = investigation.diagnosis
    assert found is not None
    if found.verdict is Verdict.BAD_DATA:
        return f"these data cannot be diagnosed: {found.reason}"
    chosen = found.deciding if found.verdict in _OPEN else None
    more = investigation.plan.budget.runs - investigation.programs
    if chosen is not None and chosen.sureness > 1.0 / np.clip(more, 1, MOST_TOGETHER):
        name = f"decide-{investigation.programs + 1}"
        why = "to tell apart " + " and ".join(chosen.explanations)
        return NextProgram(chosen.to_experiment(), name, why, chosen.duration_s)
    if found.verdict in (Verdict.AMBIGUOUS, Verdict.DESCRIBED) and chosen is not None:
        return "no program within the limits promises to separate what is left"
    if found.verdict is Verdict.AMBIGUOUS:
        return (
            "no program within the rig's limits was found"
            if len(found.explanations) > 1
            else "no program can tell an effect from a column that is off: mend the record"
        )
    full_runs = sum(each.program == FULL_PROGRAM for each in investigation.rounds)
    if found.verdict in (Verdict.PARTIAL, Verdict.NONE_KNOWN):
        if full_runs > 1 or (full_runs and not investigation.plan.is_first_full):
            return "what is left is none of the known effects, and no program promises more"
        why = "a full program shows in which regime the remainder lies"
        return _make_full_program(investigation, why)
    alone = found.verdict in (Verdict.NO_DISCREPANCY, Verdict.MISCALIBRATED)
    unseen = [s for s in found.audit.blind_spots if s.experiment] if found.audit else []
    if alone and unseen and not full_runs:
        names = ", ".join(spot.name for spot in unseen)
        return _make_full_program(investigation, f"these records cannot show {names}")
    investigation.is_decided = True
    return "nothing is missing that these programs show" if alone else "one explanation is left"


def _make_full_program(investigation: Investigation, why: str) -> NextProgram | str:
    """Return the full program with a seed of its own, if the rig's limits allow it."""
    data = read_section_file("experiment", find_config_file("experiment", FULL_PROGRAM))
    again = data.model_copy(update={"seed": data.seed + 1 + investigation.programs})
    try:
        require_inside(FULL_PROGRAM, again, investigation.plan)
    except PamctlError as error:
        return error.reason
    lasts_s = plan_experiment(again).duration_s
    return NextProgram(settings_to_data(again), FULL_PROGRAM, why, lasts_s)


def write_investigation(investigation: Investigation, out: Path) -> list[str]:
    """Write the folder and return the names in it; nothing where nothing was diagnosed yet.

    Raises NewFileError: then nothing is left.
    """
    if investigation.diagnosis is None:
        return []
    return write_diagnosis(
        investigation.diagnosis,
        out,
        [record.name for record in investigation.records],
        investigation.records,
        beside={"on_rig": investigation.as_dict()},
        story=lambda page: tell_rounds(page, investigation),
    )


def tell_rounds(page: Report, investigation: Investigation) -> None:
    """Tell round by round what was run, why, what was expected and what came of it."""
    page.add(Section("On the rig, round by round"))
    page.add(
        ReportTable(
            ["round", "program", "on the rig", "verdict", "explanations left"],
            [
                [
                    str(each.number),
                    each.program or "given logs",
                    f"{each.rig_time_s:.0f} s",
                    each.diagnosis.verdict.value.replace("_", " "),
                    "; ".join(map(spell_names, each.left)) or "-",
                ]
                for each in investigation.rounds
            ],
            f"{investigation.rig_time_s:.0f} s on the rig. It stopped there because "
            f"{investigation.stopped}.",
        )
    )
    page.add(Points([*map(_tell_round, investigation.rounds)]))


def _tell_round(each: RigRound) -> str:
    parts = [f"Round {each.number}, {each.program or 'given logs'}: {each.why}."]
    for forecast in each.diagnosis.forecasts:
        if forecast.record == each.log:
            came = "was not fitted again" if forecast.found is None else f"{forecast.found:.2f}"
            parts.append(
                f"Expected: {spell_names(forecast.refuted)} leaves {forecast.expected:.2f} times "
                f"the sensor's noise in the {forecast.block}; found: {came}."
            )
    return " ".join(parts)
