"""A verdict: one JSON file a case, VERDICTS/ID.json. `diagnosis.json` of pamctl is one.

    {"schema": 1,
     "verdict": "named",
     "effects": [{"name": "creep", "parameters": {"time_constant_s": {"value": 1.1,
                                                                     "ci90": [1.0, 1.2]}}}],
     "ambiguous": [["valve_spool", "command_delay"]],
     "blind_spots": [{"name": "chamber_leak"}],
     "gap": {"position_m": {"recalibrated": 2e-4, "extended": 1e-5, "floor": 5e-6}},
     "cpu_s": 12.5}

Only `schema` and `verdict` are required; other keys are ignored.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, Field, ValidationError

from hidden.benchmark.failure import BenchmarkError
from hidden.benchmark.records_folder import read_json


class _Number(BaseModel):
    value: float
    ci90: tuple[float, float] = (float("-inf"), float("inf"))


class _Effect(BaseModel):
    name: str
    parameters: dict[str, _Number] = Field(default_factory=dict)


class _Spot(BaseModel):
    name: str


class _Levels(BaseModel):
    recalibrated: float
    extended: float
    floor: float


class VerdictFile(BaseModel):
    """What a method says of a case."""

    schema_version: Literal[1] = Field(alias="schema")
    verdict: Literal[
        "no_discrepancy", "miscalibrated", "named", "described", "ambiguous", "partial",
        "none_known", "bad_data",
    ]  # fmt: skip
    effects: list[_Effect] = Field(default_factory=list)
    ambiguous: list[list[str]] = Field(default_factory=list)
    blind_spots: list[_Spot] = Field(default_factory=list)
    gap: dict[str, _Levels] = Field(default_factory=dict)
    cpu_s: float | None = None

    def as_document(self) -> dict[str, Any]:
        """Return it as the scorer reads it.

        A term without a name of the catalogue is an honest `none_known` to a scorer of names.
        """
        document = self.model_dump()
        if self.verdict == "described" and not self.effects:
            document["verdict"] = "none_known"
        return document


def read_verdict(path: Path) -> VerdictFile:
    """Read a verdict; raise `BenchmarkError` with the key that is wrong."""
    try:
        return VerdictFile.model_validate(read_json(path))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise BenchmarkError(f"{path}: {where}: {first['msg']}") from None
