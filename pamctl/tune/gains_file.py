"""The gains as a controller file that says how it was made."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from pamctl.control.law_registry import find_law
from pamctl.settings.yaml12 import dump_yaml
from pamctl.tune.gains_trial import BOUNDS, GainsVerdict
from pamctl.tune.plant_ensemble import Member

_WIDTH = 98


class Scores(NamedTuple):
    """How gains did on a set of plants."""

    plants: int
    inside: int
    """Plants on which every error is inside the strictest column of Table IV."""
    median: float
    p95: float
    worst: float
    failures: tuple[tuple[str, str, float], ...]
    """Name, reason and largest error over its bound of each plant that is not inside."""

    @property
    def share(self) -> float:
        """Share of the plants inside."""
        return self.inside / self.plants


def summarise_verdicts(members: Sequence[Member], verdicts: Sequence[GainsVerdict]) -> Scores:
    """Summarise verdicts, one for each plant."""
    ratios = sorted(verdict.worst for verdict in verdicts)
    outside = [
        (member.name, verdict.why, verdict.worst)
        for member, verdict in zip(members, verdicts, strict=True)
        if not verdict.is_inside
    ]
    return Scores(
        plants=len(ratios),
        inside=len(ratios) - len(outside),
        median=ratios[len(ratios) // 2],
        p95=ratios[min(len(ratios) - 1, round(0.95 * (len(ratios) - 1)))],
        worst=ratios[-1],
        failures=tuple(sorted(outside, key=lambda failure: -failure[2])),
    )


def format_gains_file(gains: Mapping[str, Any], command: str, effort: str, reported: str) -> str:
    """Return the text of a controller file; the arguments after the gains are for its header."""
    law = find_law(str(gains["law"]))
    paragraphs = [
        f"{law.title}: {law.equation}. Units: mm, s, V.",
        f"Made by:  {command}",
        f"{effort} {reported}",
        "Score: the largest of every error over its bound in the strictest column of Table IV "
        f"(max {BOUNDS.max_m * 1e6:g}, RMS {BOUNDS.rms_m * 1e6:g}, steady "
        f"{BOUNDS.steady_m * 1e6:g} um; experiment 2 RMS {BOUNDS.moving_rms_m * 1e6:g} um); "
        "below 1 is inside. Cost: the score plus a tenth of the mean of these errors, of the "
        "named plants and of the drawn ones added up. Simulated; nothing was measured on a rig.",
    ]
    lines: list[str] = []
    for paragraph in paragraphs:
        lines += [
            f"# {line}"
            for line in textwrap.wrap(
                paragraph, _WIDTH, break_long_words=False, break_on_hyphens=False
            )
        ]
    return "\n".join(lines) + "\n" + dump_yaml(dict(gains))
