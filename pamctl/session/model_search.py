"""From runs to what the model lacks, and from a model to gains."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pamctl.session.pamctl_error import translate_errors
from pamctl.session.run import Run
from pamctl.settings.config_files import find_config_file
from pamctl.settings.resolve import (
    SECTIONS,
    RawSettings,
    read_section_file,
    settings_to_data,
    validate_settings,
)

if TYPE_CHECKING:
    from pamctl.diagnose import Diagnosis
    from pamctl.plant.model import PlantSettings

    AskedPlant = str | Path | Mapping[str, Any] | PlantSettings


def find_missing_effects(
    runs: Sequence[Run],
    holdout: Sequence[Run] = (),
    plant: AskedPlant = "paper",
    *,
    progress: Callable[[str], None] = lambda line: None,
) -> Diagnosis:
    """Say what the model `plant` lacks to explain these runs, as `pamctl diagnose` does.

    The model is fitted to `runs`, with each block of samples left out in turn; `holdout` judges
    it too. `progress` gets a line at each step. The result's `plant` is the extended model;
    `pamctl.diagnose.sentence` says the result in words. Raises `PamctlError`.
    """
    from pamctl.diagnose import diagnose

    with translate_errors():
        train, held = ([run.to_record() for run in each] for each in (runs, holdout))
        return diagnose(train, held, _read_plant(plant), progress=progress)


def find_gains(
    law: str = "qsmc",
    plant: AskedPlant = "paper",
    *,
    start: Mapping[str, Any] | None = None,
    generations: int = 10,
    seed: int = 0,
    progress: Callable[[int, float], None] | None = None,
) -> dict[str, Any]:
    """Search gains for a law on a plant by simulation; return the keys of a controller file.

    Each generation tracks one cycle of experiment 1 with some tens of gains, the worst error over
    its bound of Table IV counts. `start` are gains near which the search begins [default: the
    usual ones]; `progress` gets the generation and the best figure so far. `pamctl tune` searches
    longer, on many plants and in many processes. Raises `PamctlError`.
    """
    from pamctl.tune import GainsSearch, Jury, make_fixed_members
    from pamctl.tune.gains_trial import GainsTrial

    with translate_errors():
        jury = Jury((), tuple(make_fixed_members([("plant", _read_plant(plant))])))
        near = None if start is None else dict(start)
        search = GainsSearch(law, jury, seed, near, trial=GainsTrial("short"))
        for generation in range(max(1, generations)):
            best = search.advance()
            if progress is not None:
                progress(generation + 1, best.cost)
        return settings_to_data(SECTIONS["controller"].validate_python(best.gains))


def _read_plant(plant: AskedPlant) -> PlantSettings:
    if isinstance(plant, str | Path):
        path = find_config_file("plant", str(plant), "plant")
        settings: PlantSettings = read_section_file("plant", path)
        return settings
    if isinstance(plant, Mapping):
        raw = RawSettings({**plant}, {(): "plant"})
        checked: PlantSettings = validate_settings(SECTIONS["plant"], raw, title="plant")
        return checked
    return plant
