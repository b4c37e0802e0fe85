"""Gains that are not those of the file they are named after: shown wherever the name is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

CHANGES = "controller_changes"
"""Key beside `controller`, the name of the file: what differs from it; missing if nothing does."""

BESIDE_GAINS = ("event", "tick", "t_ns", "row", "from_t_s", "ramp_s")
"""What a message of gains holds besides: when they changed, and how fast."""


def describe_changes(gains: Mapping[str, Any], of_file: Mapping[str, Any]) -> str:
    """Say which gains differ from the file's: `lambda_per_s 60 (file 37.82)`; empty if none do."""
    return ", ".join(
        f"{name} {_spell(gains[name])} (file {_spell(of_file.get(name, 'none'))})"
        for name in gains
        if gains[name] != of_file.get(name)
    )


def spell_controller(named: Mapping[str, Any]) -> str:
    """Return the controller's name, with a star and the changes where gains were changed."""
    name, changes = str(named.get("controller") or ""), named.get(CHANGES)
    return f"{name}*, {changes}" if changes else name


def list_gain_changes(
    gains: Sequence[Mapping[str, Any]],
) -> list[tuple[Mapping[str, Any], Mapping[str, Any], str]]:
    """Return the messages before and after each change, with the name of the gain that changed."""
    return [
        (before, after, name)
        for before, after in pairwise(gains)
        for name in after
        if name not in BESIDE_GAINS and after[name] != before.get(name)
    ]


def describe_running_changes(gains: Sequence[Mapping[str, Any]]) -> str | None:
    """Say how gains changed while the law ran: `lambda_per_s 37.82 to 60`; None if none did."""
    names = dict.fromkeys(name for *_, name in list_gain_changes(gains))
    said = (
        f"{name} {_spell(gains[0].get(name))} to {_spell(gains[-1].get(name))}" for name in names
    )
    return ", ".join(said) or None


def _spell(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
