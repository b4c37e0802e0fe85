"""Which cases a benchmark holds: a version, a suite, a program and a seed say it all."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

from hidden.examination.cases import Case, all_cases

VERSION = 1
"""Grows when the same seed gives other records, or the same verdict another mark."""

PROGRAMS = ("brief", "short", "standard")

_SAMPLE = (
    "null/nothing", "null/parameters",
    "single/valve_deadband/10", "single/valve_spool/10", "single/valve_asymmetry/10",
    "single/valve_leak/10", "single/command_delay/10", "single/chamber_leak/10",
    "single/supply_droop/10", "single/polytropic/10", "single/coulomb_friction/10",
    "single/presliding/10", "single/cubic_stiffness/10", "single/creep/10",
    "single/external_load/10", "single/encoder_backlash/10",
    "pair/deadband+creep", "pair/coulomb+cubic",
    "unknown/hysteretic_spring", "unknown/supply_ripple", "unknown/second_spring",
    "left_out/valve_deadband", "left_out/cubic_stiffness",
)  # fmt: skip


@dataclass(frozen=True)
class Suite:
    """A benchmark: the same four numbers give the same records everywhere."""

    name: str = "sample"
    program: str = "brief"
    seed: int = 0

    def list_cases(self) -> dict[str, Case]:
        """Return the cases by an id that says nothing of what they hide, in the ids' order."""
        if self.name == "sample":
            chosen = {case.id: case for case in all_cases(null_each=1)}
            cases: Iterator[Case] = (chosen[id] for id in _SAMPLE)
            doubled = (replace(chosen[id], repeat=1) for id in _SAMPLE[:2])
            return self._with_ids([*cases, *doubled])
        # pamctl's own loop makes the records of `own`: another method has no use for them.
        return self._with_ids([c for c in all_cases(null_each=20) if c.group != "own"])

    def _with_ids(self, cases: list[Case]) -> dict[str, Case]:
        return dict(sorted((self._id(c), self._place(c)) for c in cases))

    def _place(self, case: Case) -> Case:
        program = self.program if case.program == "standard" else case.program
        return replace(case, program=program, repeat=case.repeat + 1000 * self.seed)

    def _id(self, case: Case) -> str:
        text = f"{VERSION}/{self.program}/{self.seed}/{case.id}#{case.repeat}"
        return hashlib.sha256(text.encode()).hexdigest()[:10]

    def describe(self) -> dict[str, Any]:
        """Return what the files say of it."""
        return {"version": VERSION, **asdict(self)}


SUITES = ("sample", "all")
