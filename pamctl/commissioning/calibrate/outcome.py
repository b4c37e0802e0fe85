"""The result of a calibration, and the person whom it asks."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol

from pamctl.exit_codes import ExitCode


class CalibrationValue(NamedTuple):
    """One value for the rig file, with its uncertainty."""

    keys: tuple[str, str]
    """Section and key."""
    value: float
    unit: str
    uncertainty: float
    """Two standard deviations, of this measurement alone; 0 for what is exact."""
    how: str


class CalibrationOutcome(NamedTuple):
    """All that a calibration found."""

    values: tuple[CalibrationValue, ...]
    notes: tuple[str, ...]
    """Facts that have no key in the file: they become dated comments."""
    figures: Mapping[str, object]
    """What the values rest on: points, residuals, noise; SI, units in the names."""


class CalibrationError(Exception):
    """A measurement or an answer makes no sense; the message says why and what to check."""

    exit_code = ExitCode.CHECK_FAILED


class Operator(Protocol):
    """The person at the rig. `idle` keeps the rig going while an answer is awaited."""

    def wait(self, request: str, idle: Callable[[], object]) -> None:
        """Ask for something to be done, and wait until it is."""

    def number(self, question: str, idle: Callable[[], object]) -> float:
        """Ask for a number."""


class PreparedAnswers:
    """Answers given in advance, in the order of the questions: for scripts."""

    def __init__(self, answers: Sequence[float], idle_times: int = 30) -> None:
        """`idle_times` is how often the rig goes on before each answer."""
        self._answers = list(answers)
        self._idle_times = idle_times

    def wait(self, request: str, idle: Callable[[], object]) -> None:
        """Let the rig go on for a moment, then go on as if it were done."""
        for _ in range(self._idle_times):
            idle()

    def number(self, question: str, idle: Callable[[], object]) -> float:
        """Let the rig go on for a moment, then give the next answer."""
        self.wait(question, idle)
        if not self._answers:
            raise CalibrationError(f"no value was given for: {question}")
        return self._answers.pop(0)


def slope(x: Sequence[float], y: Sequence[float]) -> float:
    """Return the steepness of the best line through the origin (least squares)."""
    return sum(a * b for a, b in zip(x, y, strict=True)) / sum(a * a for a in x)


def list_residuals(x: Sequence[float], y: Sequence[float], scale: float) -> list[float]:
    """Return how far each point lies above the line through the origin."""
    return [b - scale * a for a, b in zip(x, y, strict=True)]


def slope_uncertainty(
    scale: float, x: Sequence[float], residuals: Sequence[float], noise: float
) -> float:
    """Return two standard deviations of a slope: each x has `noise`, and the points scatter."""
    spread = math.sqrt(sum(a * a for a in x))
    by_noise = 2.0 * scale * noise / spread
    if len(x) < 2:
        return by_noise
    variance = sum(r * r for r in residuals) / (len(x) - 1)
    return max(by_noise, 2.0 * math.sqrt(variance) / spread)


def require_near(name: str, found: float, nominal: float, hints: Mapping[float, str]) -> None:
    """Refuse a scale that is more than a quarter off the file's; `hints` explain known ratios."""
    ratio = found / nominal
    if 0.8 <= ratio <= 1.25:
        return
    known = (hint for at, hint in hints.items() if 0.9 <= ratio / at <= 1.1)
    why = next(
        known, f"if the part is another one, put its data sheet's {name} into the file first"
    )
    raise CalibrationError(
        f"{name} would be {found:.6g}, {ratio:.3g} times the file's {nominal:.6g}: {why}"
    )
