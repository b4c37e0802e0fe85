"""A tuning task: the law, the plants to tune for, and the plants that score the gains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pamctl.control.law_registry import installed_laws
from pamctl.log.run_meta import bare_name
from pamctl.new_file import require_place
from pamctl.settings.config_files import find_config_file
from pamctl.settings.known_effects import build_compensation
from pamctl.settings.problems import ConfigError, Problem
from pamctl.settings.resolve import (
    read_section_file,
    require_muscle,
    resolve,
    settings_to_data,
)
from pamctl.tune.gains_trial import GainsTrial
from pamctl.tune.plant_ensemble import Member, draw_ensemble, make_fixed_members
from pamctl.tune.search_space import find_space

_DEFAULT_SIZE = 16
_DEFAULT_HELD_OUT = 200
_FRESH_SEED_OFFSET = 1_000_003
"""Added to the seed for plants that the search has not seen."""


@dataclass(frozen=True)
class TuningTask:
    """What is tuned, for which plants, and what judges the result."""

    law: str
    drawn: list[Member]
    """Plants of which a quantile counts."""
    named: list[Member]
    """Plants of which each counts."""
    fresh: list[Member]
    """Drawn plants for the score, none of which the search sees."""
    seed: int
    out: Path | None
    checked: Any
    """Controller to score; None to seek one."""
    start: dict[str, Any] | None
    compensate: tuple[str, ...] = ()
    """Effects that the gains undo, each with the numbers of the plant that it is judged on."""

    @property
    def trial(self) -> GainsTrial:
        """How gains are judged in a search: on a few named plants by the whole experiments."""
        return GainsTrial("short" if self.drawn else "whole")

    @property
    def elite_trial(self) -> GainsTrial | None:
        """What the best gains of a search on drawn plants must stand as well."""
        return GainsTrial("whole") if self.drawn else None

    @classmethod
    def of(
        cls,
        law: str | None,
        plants: Sequence[str],
        size: int | None,
        seed: int,
        held_out: int | None,
        out: Path | None,
        check: str | None,
        start: str | None,
        compensate: Sequence[str] = (),
    ) -> TuningTask:
        """Make a task of the options of `pamctl tune`; raise `ConfigError`."""
        checked = None if check is None else _read("controller", check, "--check")
        law = checked.law if checked is not None else law or ""
        if law not in installed_laws():
            known = ", ".join(installed_laws())
            raise _option_error(f"--law {law}".strip(), f"must be one of {known}")
        if checked is None:
            _require_space(law)
            _require_new(out)
        began = None if start is None else _read("controller", start, "--start")
        if began is not None and began.law != law:
            raise _option_error(f"--start {start}", f"holds gains of {began.law}, not of {law}")
        if began is not None and began.length_unit != "mm":
            raise _option_error(f"--start {start}", "the search works in mm, not in inches")
        named = make_fixed_members([(bare_name(name), _read_muscle(name)) for name in plants])
        draws = size is not None or not plants
        if compensate and draws:
            raise _option_error(
                f"--compensate {compensate[0]}",
                "undoes what a plant file says: give --plant FILE, and no --ensemble",
            )
        _require_undoable(compensate, named)
        if held_out is not None and not draws:
            message = "there are no fresh plants: with --plant, give --ensemble too"
            raise _option_error(f"--held-out {held_out}", message)
        drawn = draw_ensemble(size or _DEFAULT_SIZE, seed) if draws else []
        judges = held_out or _DEFAULT_HELD_OUT
        fresh = draw_ensemble(judges, seed + _FRESH_SEED_OFFSET) if draws else []
        begun = None if began is None else settings_to_data(began)
        if checked is not None and compensate:
            checked = checked.model_copy(update={"compensate": tuple(compensate)})
        names = tuple(compensate)
        return cls(law, drawn, named, fresh, seed, out, checked, begun, names)


def _option_error(where: str, message: str) -> ConfigError:
    return ConfigError([Problem(where, "", message)])


def _require_undoable(names: Sequence[str], members: Sequence[Member]) -> None:
    """Refuse what a run on one of the plants would refuse."""
    base = resolve()
    controller = base.controller.model_copy(update={"compensate": tuple(names)})
    for member in members:
        try:
            build_compensation(member.plant, base.rig, controller)
        except ValueError as error:
            raise _option_error(f"--compensate {' '.join(names)}", str(error)) from None


def _require_space(law: str) -> None:
    try:
        find_space(law)
    except ValueError as error:
        raise _option_error(f"--law {law}", str(error)) from None


def _require_new(out: Path | None) -> None:
    if out is None:
        raise _option_error("--out is required", "name a new file for the gains")
    require_place(out)


def _read_muscle(name: str) -> Any:
    plant = _read("plant", name)
    try:
        require_muscle(plant)
    except ValueError as error:
        raise ConfigError([Problem(name, "", str(error))]) from error
    return plant


def _read(section: str, name: str, option: str = "") -> Any:
    return read_section_file(section, find_config_file(section, name, option))
