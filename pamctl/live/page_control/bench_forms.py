"""What the page can set: the gains of the law with their bounds, and the shipped experiments."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from pamctl.control.law_registry import find_law
from pamctl.runs.run_index import RunIndex, RunsError
from pamctl.runs.run_list import RunFilter, select_runs
from pamctl.settings.config_files import config_dir, list_shipped
from pamctl.settings.problems import ConfigError, Problem
from pamctl.settings.resolve import read_section_file, settings_to_data
from pamctl.signals import TICK_FIELDS, Phase

_MOST_RUNS = 100
_RUN_COLUMNS = (
    "path", "when_s", "controller", "experiment", "ending", "duration_s", "max_um", "rms_um",
    "steady_um", "operator", "note",
)  # fmt: skip

Form = dict[str, Any]

_BOUNDS = {
    "minimum": "low", "exclusiveMinimum": "above", "maximum": "high", "exclusiveMaximum": "below",
}  # fmt: skip


def describe_bench(status: Mapping[str, Any] | None) -> Form:
    """Return all that the page makes its forms of; without a daemon there are no gains."""
    gains = [] if status is None else describe_gains(status["controller"])
    limits = None if status is None else status["limits"]["stroke_mm"]
    return {
        "fields": describe_fields(), "phases": describe_phases(), "gains": gains,
        "experiments": list_experiments(), "stroke_mm": limits,
        "rate_hz": None if status is None else status["rate_hz"],
    }  # fmt: skip


def list_runs(status: Mapping[str, Any] | None) -> list[Form]:
    """Return the newest logs of the daemon's folder by its index, newest first."""
    try:
        folder = Path("/nonexistent" if status is None else status["logs"])
        with RunIndex(folder) as index:
            index.refresh()
            rows = select_runs(index, RunFilter(last=_MOST_RUNS), with_gains=False)
    except RunsError:
        return []
    return [{name: getattr(row, name) for name in _RUN_COLUMNS} for row in reversed(rows)]


def describe_fields() -> list[Form]:
    """Return the columns of a tick, with the stage that makes each."""
    return [{"name": field.name, "stage": field.stage} for field in TICK_FIELDS]


def describe_phases() -> list[str]:
    """Return the names of the phases by number."""
    return [phase.name.lower().replace("_", " ") for phase in Phase]


def describe_gains(controller: Mapping[str, Any]) -> list[Form]:
    """Return the numbers of a controller, each with the schema's bounds.

    `runs` says whether it may change while the law runs.
    """
    law = find_law(str(controller["law"]))
    keys = law.settings.model_json_schema()["properties"]
    return [
        {
            "name": name,
            "value": value,
            "about": keys[name].get("description", ""),
            "runs": law.may_blend(name),
            **{_BOUNDS[bound]: at for bound, at in keys[name].items() if bound in _BOUNDS},
        }
        for name, value in controller.items()
        if isinstance(value, float | int) and not isinstance(value, bool) and name in keys
    ]


@cache
def list_experiments() -> list[Form]:
    """Return the shipped experiments, each with its keys that are numbers."""
    return [
        {"name": name, "numbers": _numbers_of(load_shipped_experiment(name))}
        for name in list_shipped("experiment")
    ]


def load_shipped_experiment(name: str, changes: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return a shipped experiment with `amplitude_mm=2` and the like; raise `ConfigError`."""
    if name not in list_shipped("experiment"):  # a path is not opened for a browser
        raise ConfigError([Problem(name, "", "there is no such experiment")])
    path = config_dir() / "experiment" / f"{name}.yaml"
    return settings_to_data(read_section_file("experiment", path, changes))


def _numbers_of(experiment: Mapping[str, Any]) -> dict[str, float]:
    return {
        key: value
        for key, value in experiment.items()
        if isinstance(value, float | int) and not isinstance(value, bool)
    }
