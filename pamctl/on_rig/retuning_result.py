"""What retuning on the rig came to: the gains that were tried, and tracking before and after."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from pamctl.on_rig.rig_plan import REST_S
from pamctl.session.run import Run


@dataclass
class Retuning:
    """What was tried, and what the rig said to it; it grows with what is done."""

    why: str = "it was interrupted"
    is_kept: bool = False
    """The rig goes on with the new gains."""
    gains: dict[str, Any] | None = None
    """The keys of a controller file; None where nothing better was found."""
    runs: dict[str, Run] = field(default_factory=dict)
    """`before` and `after`, as far as they were run."""

    @property
    def rig_time_s(self) -> float:
        """Time on the rig, with the rests."""
        return sum(run.duration_s + REST_S for run in self.runs.values())

    def as_dict(self) -> dict[str, Any]:
        """Return what the document holds."""
        return {
            "why": self.why,
            "is_kept": self.is_kept,
            "gains": self.gains,
            "rig_time_s": round(self.rig_time_s, 3),
            **{name: _describe_run(self.runs.get(name)) for name in ("before", "after")},
        }


def _describe_run(run: Run | None) -> dict[str, Any] | None:
    if run is None:
        return None
    found = run.metrics
    return {
        "log": run.path.name,
        "max_error_m": found.max_error_m,
        "rms_error_m": found.rms_error_m,
    }
