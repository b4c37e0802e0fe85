"""Gains that change while the loop runs, on a ramp, so that the command does not jump.

The loop and the replay of its log compute the same gains for the same tick: all that the ramp
depends on is in the log.
"""

from __future__ import annotations

from typing import Any, TypeVar

from pamctl.control.law import LawSettings, filter_gains
from pamctl.control.law_registry import law_of
from pamctl.realtime.tick import TickSetup

SHORTEST_RAMP_S = 0.05
"""A gain that jumps makes the command jump. Spread over 50 ticks the change is smooth."""

Numbers = TypeVar("Numbers")


class GainRampError(ValueError):
    """Gains that cannot replace those in use while the muscle moves."""


class GainRamp:
    """The set-up of the tick, with the gains of the moment."""

    def __init__(self, setup: TickSetup, controller: LawSettings) -> None:
        """Begin with the gains of `setup`; `controller` is what they were made of."""
        self._controller = controller
        self._setup = setup
        self._from = self._to = setup
        self._begin_s = 0.0
        self._ramp_s = 0.0

    def change(self, controller: LawSettings, t_s: float, ramp_s: float) -> None:
        """Go from the gains of the moment to others within `ramp_s` (s), from `t_s` on.

        Raises `GainRampError` for another law, and for settings that change only between runs.
        """
        require_blendable(self._controller, controller)
        self._controller = controller
        self._from = self.at(t_s)
        self._to = fit_law(self._setup, controller)
        self._begin_s = t_s
        self._ramp_s = max(ramp_s, SHORTEST_RAMP_S)
        self._setup = self._from

    def replace(self, controller: LawSettings) -> None:
        """Take other gains, or another law, at once: while no law moves the muscle."""
        self._controller = controller
        self._setup = self._from = self._to = fit_law(self._setup, controller)

    @property
    def is_settled(self) -> bool:
        """No ramp is under way."""
        return self._setup is self._to

    @property
    def settled_setup(self) -> TickSetup | None:
        """The set-up at all times to come; None while a ramp is under way."""
        return self._setup if self._setup is self._to else None

    def at(self, t_s: float) -> TickSetup:
        """Return the set-up of the tick at `t_s`."""
        if self._setup is self._to:
            return self._setup
        share = (t_s - self._begin_s) / self._ramp_s
        self._setup = self._to if share >= 1.0 else blend_gains(self._from, self._to, share)
        return self._setup


def fit_law(setup: TickSetup, controller: LawSettings) -> TickSetup:
    """Return a set-up with the law, the gains and the filters of a gains file."""
    law = law_of(controller)
    return setup._replace(
        filters=filter_gains(controller),
        gains=law.gains_within(controller, setup.limits.command_v),
        armed=law.armed,
    )


def require_blendable(old: LawSettings, new: LawSettings) -> None:
    """Raise `GainRampError` where there is nothing between the two that would still be a law."""
    if old.law != new.law:
        raise GainRampError("another law takes effect with the next run, not while the loop runs")
    law = law_of(new)
    names = [name for name in law.settings.model_fields if not law.may_blend(name)]
    fixed = [name for name in names if getattr(old, name) != getattr(new, name)]
    if fixed:
        raise GainRampError(
            f"another {' or '.join(fixed)} takes effect with the next run: {law.title} with it is "
            "another law"
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
