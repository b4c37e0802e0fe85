"""Gains that change while the loop runs: on a ramp, so that the command does not jump.

The loop and the replay of its log compute the same gains of the same tick: all that the
ramp depends on is in the log.
"""

from __future__ import annotations

from typing import Any, TypeVar

from pamctl.control.law import ControllerSettings, Gains, filter_gains, law_gains
from pamctl.realtime.tick import TickSetup

SHORTEST_RAMP_S = 0.05
"""A gain that jumps makes the command jump; over 50 ticks it is a change among others."""
DEFAULT_RAMP_S = 0.5

Numbers = TypeVar("Numbers")


class GainRampError(ValueError):
    """Gains that cannot take the place of those in use while the muscle moves."""


class GainRamp:
    """What the tick needs to know, with the gains of the moment."""

    def __init__(self, setup: TickSetup) -> None:
        """Begin with the gains of `setup`."""
        self._setup = setup
        self._from = self._to = setup
        self._begin_s = 0.0
        self._ramp_s = 0.0

    def change(self, controller: ControllerSettings, t_s: float, ramp_s: float) -> None:
        """Go from the gains of the moment to others within `ramp_s` (s), from `t_s` on.

        Raises `GainRampError` for another law or structure.
        """
        gains = law_gains(controller)
        require_same_structure(self._to.gains, gains)
        self._from = self.at(t_s)
        self._to = self._setup._replace(gains=gains, filters=filter_gains(controller))
        self._begin_s = t_s
        self._ramp_s = max(ramp_s, SHORTEST_RAMP_S)
        self._setup = self._from

    def replace(self, controller: ControllerSettings) -> None:
        """Take other gains, or another law, at once: while no law moves the muscle."""
        self._setup = self._from = self._to = self._setup._replace(
            gains=law_gains(controller), filters=filter_gains(controller)
        )

    @property
    def is_settled(self) -> bool:
        """No gains are on their way."""
        return self._setup is self._to

    def at(self, t_s: float) -> TickSetup:
        """Return the set-up of the tick at `t_s`."""
        if self._setup is self._to:
            return self._setup
        share = (t_s - self._begin_s) / self._ramp_s
        self._setup = self._to if share >= 1.0 else blend_gains(self._from, self._to, share)
        return self._setup


def require_same_structure(old: Gains, new: Gains) -> None:
    """Raise `GainRampError` where there is nothing between the two that would still be a law."""
    if old.law != new.law:
        raise GainRampError("another law takes effect with the next run, not while the loop runs")
    for here, there in ((old.qsmc.sliding, new.qsmc.sliding), (old.smc.sliding, new.smc.sliding)):
        if here.literal_reaching != there.literal_reaching:
            raise GainRampError("another reaching_law takes effect with the next run")
        if here.units_per_m != there.units_per_m:
            raise GainRampError(
                "another length_unit takes effect with the next run: it is another law"
            )


def blend_gains(old: Numbers, new: Numbers, share: float) -> Numbers:
    """Interpolate two tuples of numbers, tuples in tuples included; flags are those of `new`."""
    if old == new:
        return new
    mixed: Any
    if isinstance(old, tuple) and isinstance(new, tuple):
        parts = (blend_gains(a, b, share) for a, b in zip(old, new, strict=True))
        mixed = old._make(parts)  # type: ignore[attr-defined]
    elif isinstance(old, float) and isinstance(new, float):
        mixed = old + share * (new - old)
    else:
        mixed = new
    result: Numbers = mixed
    return result
