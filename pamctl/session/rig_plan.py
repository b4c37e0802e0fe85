"""The plan of a diagnosis on the rig: its first program, its budget, the limits that hold."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from math import isnan
from typing import Any

import numpy as np

from pamctl.base.errors import ExitCode
from pamctl.base.texts import count_of
from pamctl.control.experiment import Experiment, plan_experiment
from pamctl.diagnose.deciding_program import MIXED, PROGRAMS
from pamctl.diagnose.drawn_programs import ProgramRun, RigLimits, read_rig_limits, sample_levels
from pamctl.log.run_meta import file_safe_name
from pamctl.plant.drive import drive_coupled
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.session.pamctl_error import PamctlError
from pamctl.settings.config_files import find_config_file, read_tables
from pamctl.settings.resolve import read_section_file, settings_to_data

FULL_PROGRAM = "diagnosis"
"""The shipped program that shows nearly every effect."""
HOMING_S = 12.0
"""Rig time that homing may take before the first program; later ones need none."""
BETWEEN_S = 2.0
"""Vented rest between two programs."""
_KPA, _MM = 1e-3, 1e3


@dataclass(frozen=True)
class Budget:
    """How much may be asked of the rig."""

    runs: int = 4
    """Programs, with the first one."""
    minutes: float = 5.0
    """Time on the rig, with homing and rests; without the computing between."""


@dataclass(frozen=True)
class RigPlan:
    """What will be run first, and what holds for all that follows."""

    budget: Budget
    limits: RigLimits
    backend: str
    start: PlantSettings
    first: Mapping[str, Any] | None
    """Keys of the first program; None where logs take its place."""
    first_name: str
    first_s: float
    demand: ProgramRun | None
    """The start model under the first program."""
    period_s: float = 1e-3

    @property
    def is_first_full(self) -> bool:
        """Tell whether the first program is the shipped one that shows nearly every effect."""
        return self.first is not None and self.first_name == FULL_PROGRAM

    def describe(self) -> str:
        """Say the plan in a few lines, before anything moves."""
        return "\n".join(self._list_lines())

    def _list_lines(self) -> Iterator[str]:
        limits, budget = self.limits, self.budget
        yield (
            f"rig: {self.backend}; its limits hold: {_KPA * limits.pressure_pa:.0f} kPa absolute, "
            f"{_MM * limits.low_m:g} to {_MM * limits.high_m:g} mm, {limits.command_v:g} V"
        )
        if self.first is None:
            yield "first: the given logs are diagnosed"
        else:
            yield f"first program: {self.first_name}, {self.first_s:.1f} s{self._say_demand()}"
        more = budget.runs if self.first is None else budget.runs - 1
        yield (
            f"then: up to {more} more of 5 to 10 s, each the one of {PROGRAMS + MIXED} that best "
            "separates what is left"
        )
        yield (
            f"budget: {count_of(budget.runs, 'program')} and {budget.minutes:g} min on the rig; "
            f"between two, the muscle rests vented for {BETWEEN_S:g} s"
        )

    def _say_demand(self) -> str:
        if self.demand is None:
            return "; the daemon checks it against the envelope"
        return (
            f"; by the start model up to {_KPA * float(self.demand.pressure_pa.max()):.0f} kPa "
            f"absolute and {_MM * float(self.demand.position_m.max()):.1f} mm"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for `--json`."""
        return {
            "backend": self.backend,
            "limits": {
                "pressure_pa": self.limits.pressure_pa,
                "low_m": self.limits.low_m,
                "high_m": self.limits.high_m,
                "command_v": self.limits.command_v,
            },
            "first": None if self.first is None else self.first_name,
            "first_s": self.first_s,
            "runs": self.budget.runs,
            "minutes": self.budget.minutes,
            "rest_s": BETWEEN_S,
        }


def make_rig_plan(
    settings: Mapping[str, Any],
    start: PlantSettings,
    experiment: str | None,
    budget: Budget,
) -> RigPlan:
    """Plan a diagnosis on a rig with these settings; `experiment` is None where logs come first.

    Raises `PamctlError` where the first program does not fit the budget or the rig's limits, by the
    start model.
    """
    limits = read_rig_limits(settings, "the daemon's settings")
    backend = str(settings["rig"]["backend"])
    if start.actuator != "muscle":
        reason = f"--on-rig moves a muscle; the plant file says actuator: {start.actuator}"
        raise PamctlError(f"{reason}; give --plant of a muscle", ExitCode.USAGE)
    period_s = 1.0 / float(settings["rig"]["loop"]["rate_hz"])
    plan = RigPlan(budget, limits, backend, start, None, "", 0.0, None, period_s)
    if experiment is None:
        return plan
    path = find_config_file("experiment", experiment, "--experiment")
    data = read_section_file("experiment", path, (), read_tables)
    keys, lasts_s = settings_to_data(data), plan_experiment(data).duration_s
    _require_time(experiment, lasts_s, budget)
    demand = require_inside(experiment, data, plan)
    name = file_safe_name(experiment)
    return replace(plan, first=keys, first_name=name, first_s=lasts_s, demand=demand)


def _require_time(experiment: str, lasts_s: float, budget: Budget) -> None:
    if HOMING_S + lasts_s > 60.0 * budget.minutes:
        raise PamctlError(
            f"the experiment {experiment} lasts {lasts_s:.0f} s, and homing up to {HOMING_S:.0f} s:"
            f" more than --minutes {budget.minutes:g}; allow more, or name a shorter --experiment",
            ExitCode.USAGE,
        )


def require_inside(experiment: str, data: Experiment, plan: RigPlan) -> ProgramRun | None:
    """Return the start model under an experiment; raise `PamctlError` beyond the rig's limits.

    None for motions in closed loop, and for waves: the daemon checks those against the envelope.
    """
    limits, segments = plan.limits, plan_experiment(data).segments
    if any(s.shape is not None or isnan(s.valve_v) for s in segments):
        return None
    commands_v = sample_levels(segments, plan.period_s)
    steps_s = np.full(len(commands_v) - 1, plan.period_s)
    driven = drive_coupled(plant_parameters(plan.start), commands_v, steps_s)
    run = ProgramRun(driven.pressure_pa, driven.position_m)
    if not limits.allows(run):
        raise PamctlError(
            f"the experiment {experiment} needs, by the start model, up to "
            f"{_KPA * float(run.pressure_pa.max()):.0f} kPa absolute and "
            f"{_MM * float(run.position_m.max()):.1f} mm; the rig's limits are "
            f"{_KPA * limits.pressure_pa:.0f} kPa and {_MM * limits.high_m:g} mm, of which "
            f"{100 * limits.spare_share:g} % stay free; name a gentler --experiment",
            ExitCode.CHECK_FAILED,
        )
    return run
