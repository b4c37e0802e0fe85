"""Put the numbers together: the settings, checked as a whole, and the text of the file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import TypeAdapter

from pamctl.plant.model import PlantSettings
from pamctl.settings.datasheet.plant_questions import list_questions
from pamctl.settings.resolve import RawSettings, validate_settings
from pamctl.settings.yaml12 import dump_yaml


def build_plant(actuator: str, values: Mapping[str, float]) -> PlantSettings:
    """Return the plant of these numbers in SI; raise ConfigError where they do not fit together."""
    plant: PlantSettings = validate_settings(
        TypeAdapter(PlantSettings), RawSettings(_nest(actuator, values), {(): "the plant"}), "plant"
    )
    return plant


def format_new_plant(
    actuator: str, values: Mapping[str, float], texts: Mapping[str, str], fitted: str
) -> str:
    """Write the file, with the meaning of each number behind it.

    `texts` say where numbers are from, `fitted` which of them a diagnosis fits.
    """
    lines = [
        "# Written by `pamctl plant new`, to edit. All numbers are in SI.",
        f"# `pamctl diagnose` fits {fitted}; it takes the other numbers as they are.",
    ]
    questions = list_questions(actuator)
    meanings = {
        q.name.rpartition(".")[2]: q.meaning + (f"; {texts[q.name]}" if q.name in texts else "")
        for q in questions
    }
    for line in dump_yaml(_nest(actuator, values)).splitlines():
        meaning = meanings.get(line.partition(":")[0].strip())
        lines.append(f"{line:<42}  # {meaning}" if meaning else line)
    absent = [q for q in questions if q.is_optional and q.name not in values]
    lines += [f"# {q.name} is absent; --value {q.name}='...' adds it: {q.meaning}" for q in absent]
    return "\n".join([*lines, ""])


def _nest(actuator: str, values: Mapping[str, float]) -> dict[str, Any]:
    """Return the numbers in the places that they have in a file."""
    data: dict[str, Any] = {"base": "paper", "actuator": actuator}
    effects: dict[str, dict[str, float]] = {}
    parameters: dict[str, float] = {}
    for name, value in values.items():
        effect, dot, number = name.partition(".")
        if dot:
            effects.setdefault(effect, {})[number] = value
        elif name in PlantSettings.model_fields:
            data[name] = value
        else:
            parameters[name] = value
    return {**data, "parameters": parameters, **({"effects": effects} if effects else {})}
