"""The runs of a sweep: every combination of the swept values, and that as often as it is repeated.

All combinations are run once before any is repeated: a drift of the rig then spreads over all
values, and does not look like an effect of one.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

from pamctl.control.experiment import plan_experiment
from pamctl.exit_codes import ExitCode
from pamctl.json_text import to_json
from pamctl.settings.resolve import RunSettings

_MOST_RUNS = 10_000
_KEY = re.compile(r"\s*([^=\s]+)\s*=\s*(.*)", re.DOTALL)


class SweepError(Exception):
    """A sweep cannot be made or continued. The message says why, and what to do."""

    exit_code = ExitCode.USAGE


class SweepRequest(NamedTuple):
    """What `--set` says: settings that are swept, and overrides that are the same in all runs."""

    swept: Mapping[str, Sequence[str]]
    """The values of each key, as they were written."""
    fixed: tuple[str, ...]

    def list_points(self) -> list[tuple[str, ...]]:
        """Return the overrides `key=value` of every combination, the last key fastest."""
        options = [[f"{key}={value}" for value in values] for key, values in self.swept.items()]
        return list(product(*options))

    def list_overrides(self) -> list[tuple[str, ...]]:
        """Return all overrides of every combination."""
        return [(*self.fixed, *point) for point in self.list_points()]

    def read_point(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the swept settings by key, as they were understood."""
        return {key: _read_setting(settings, key) for key in self.swept}

    def mark_base(self, settings: Mapping[str, Any]) -> str:
        """Return a short mark of all settings but the swept ones and the seed.

        A sweep is continued under the same settings only: else its runs could not be compared.
        """
        left = _leave_out(settings, {"seed", *self.swept})
        return hashlib.sha256(to_json(left)).hexdigest()[:16]


class SweepRun(NamedTuple):
    """One run of a sweep."""

    point: Mapping[str, Any]
    """The swept settings, by key."""
    repeat: int
    """From 0."""
    number: int
    """Number of the point, from 0."""

    @property
    def place(self) -> str:
        """What tells it from the other runs of the sweep."""
        return to_json([sorted(self.point.items()), self.repeat]).decode()

    @property
    def title(self) -> str:
        """Its settings, for people."""
        said = ", ".join(f"{key}={value}" for key, value in self.point.items())
        return f"{said}, repeat {self.repeat + 1}"


def parse_sweep(overrides: Sequence[str], repeats: int) -> SweepRequest:
    """Split overrides into swept and fixed ones: `key=1,2,3` is swept; raise SweepError.

    A comma within brackets or quotes belongs to the value.
    """
    swept: dict[str, list[str]] = {}
    fixed = []
    for override in overrides:
        found = _KEY.fullmatch(override)
        values = _split_values(found[2]) if found else []
        if found is None or len(values) < 2:
            fixed.append(override)
            continue
        key = found[1]
        if key in swept:
            raise SweepError(f"--set {override}: {key} is swept already; write all its values once")
        if "" in values:
            raise SweepError(f"--set {override}: a value is empty; write {key}=1,2,3")
        if len(set(values)) < len(values):
            raise SweepError(f"--set {override}: a value stands twice; repeat it with --repeat")
        swept[key] = values
    if not swept:
        raise SweepError(
            "nothing is swept; give a setting several values: --set controller.lambda_per_s=20,40"
        )
    request = SweepRequest(swept, tuple(fixed))
    if (runs := len(request.list_points()) * repeats) > _MOST_RUNS:
        raise SweepError(f"these are {runs} runs, {_MOST_RUNS} are allowed; sweep fewer values")
    return request


def _split_values(text: str) -> list[str]:
    values, depth, quote = [""], 0, ""
    for character in text:
        if quote:
            quote = "" if character == quote else quote
        elif character in "\"'":
            quote = character
        elif character in "[{":
            depth += 1
        elif character in "]}":
            depth -= 1
        if character == "," and not depth and not quote:
            values.append("")
        else:
            values[-1] += character
    return [value.strip() for value in values]


def list_runs(points: Sequence[Mapping[str, Any]], repeats: int) -> list[SweepRun]:
    """Return all runs in their order."""
    return [
        SweepRun(point, repeat, number)
        for repeat in range(repeats)
        for number, point in enumerate(points)
    ]


def require_end(settings: RunSettings) -> None:
    """Raise SweepError where a run would have no end."""
    if settings.duration_s is None and math.isinf(plan_experiment(settings.experiment).duration_s):
        raise SweepError("this experiment has no end; give each run a length with --duration")


def _read_setting(settings: Any, key: str) -> Any:
    for part in key.split("."):
        settings = settings.get(part) if isinstance(settings, Mapping) else None
    return settings


def _leave_out(settings: Mapping[str, Any], keys: set[str], above: str = "") -> dict[str, Any]:
    return {
        name: _leave_out(value, keys, f"{above}{name}.") if isinstance(value, Mapping) else value
        for name, value in sorted(settings.items())
        if f"{above}{name}" not in keys
    }
