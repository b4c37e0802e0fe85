"""Compare one log with several plants, given by the names of their files."""

from __future__ import annotations

from collections.abc import Sequence

from pamctl.compare.coupled_gap import Comparison, compare_model
from pamctl.log import Log
from pamctl.plant.model import plant_parameters
from pamctl.settings.config_files import DEFAULT_NAMES, find_config_file
from pamctl.settings.resolve import SECTIONS, RawSettings, read_section_file, validate_settings

OWN_PLANT = "the log's own"


def compare_plants(log: Log, names: Sequence[str]) -> dict[str, Comparison]:
    """Compare a log with each plant; by default with the log's own plant, or the default plant.

    Raises `ConfigError` and `LogError`.
    """
    if not names and "plant" in log.config:
        raw = RawSettings(log.config["plant"], {(): f"{log.path}:config.json"})
        plants = {OWN_PLANT: validate_settings(SECTIONS["plant"], raw, title="plant")}
    else:
        plants = {
            name: read_section_file("plant", find_config_file("plant", name))
            for name in names or [DEFAULT_NAMES["plant"]]
        }
    return {
        name: compare_model(log, plant_parameters(settings), settings.actuator)
        for name, settings in plants.items()
    }
