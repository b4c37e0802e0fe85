"""The questions: every location x operator x driver that may act on a block, with inner numbers.

Inner numbers follow what the records reach: a width is a share of the driver's span, a time a
share of the record. Their grid is coarse; what promises is refined later.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from math import pi

import numpy as np

from pamctl.diagnose.fitting.drives import Drive
from pamctl.diagnose.measured.record import Array
from pamctl.plant.model import PlantSettings
from pamctl.plant.terms.locations import LOCATIONS, Location
from pamctl.plant.terms.operators import DRIVERS, KNOTS, OPERATORS, REFERENCES

SPAN = (0.01, 0.99)
"""Quantiles of a driver that bound its span."""
WAVES_HZ = (0.06, 12.0, 56)
"""Least and greatest frequency of a wave in time that is asked, and how many."""
LEAST_WAVES = 1.5
"""A wave in time comes back within a record. What does not is a trend, or a bend of it."""

_SHARES: Mapping[str, tuple[float, ...]] = {
    "dead_zone": (0.006, 0.02, 0.06),
    "play": (0.005, 0.015, 0.04, 0.1),
    "hysteresis": (0.001, 0.01, 0.03, 0.08, 0.2),
    "beyond": (0.3, 0.5, 0.65, 0.8),
    "onset": (0.2, 0.35, 0.5, 0.65, 0.8),
    "saturation": (0.6, 0.8, 0.9),
}
"""Inner numbers as shares of the driver's span (of its largest magnitude for a saturation)."""
_LAGS_S = {"command": (0.5e-3, 1.5e-3, 5e-3), "position": (0.05, 0.2, 0.8, 3.0),
           "pressure": (0.05, 0.2, 0.8, 3.0)}  # fmt: skip
_SLEW_S = (3e-3, 6e-3, 12e-3)
"""Times in which a slew limit lets the driver cross its span."""
_PLACE_WAVES = tuple(0.5 * k for k in range(3, 25))
"""Waves of a reading within the span: one that is half a wave off shows nothing."""


@dataclass(frozen=True)
class Span:
    """What the records reach of a driver."""

    low: float
    high: float
    largest: float

    @property
    def width(self) -> float:
        """From the least to the greatest."""
        return self.high - self.low


@dataclass(frozen=True)
class Question:
    """One term that may be missing; its columns are the doses of which it is a sum."""

    location: Location
    operator: str
    driver: str
    held: Mapping[str, float] = field(default_factory=dict)
    """The inner numbers."""
    span: Span = Span(0.0, 1.0, 1.0)

    @property
    def key(self) -> tuple[str, str, str]:
        """Location, operator and driver."""
        return self.location.name, self.operator, self.driver

    @property
    def prefix(self) -> str:
        """What stands before the names of its numbers."""
        return f"{self.location.term_name}."

    @property
    def is_following(self) -> bool:
        """Tell whether it is the command itself that follows late, or not at all."""
        return self.location.name == "command" and self.operator in (
            "dead_zone", "saturation", "lag", "play", "slew",
        )  # fmt: skip

    def fix(self) -> dict[str, float]:
        """Return the numbers that say which term it is, by full name."""
        chosen = {
            "operator": float(OPERATORS.index(self.operator)),
            "driver": float(DRIVERS.index(self.driver)),
            **self.held,
        }
        return {self.prefix + name: value for name, value in chosen.items()}

    def list_shapes(self) -> list[dict[str, float]]:
        """Return the shapes whose sum the term is: one, two phases of a wave, or a curve's hats."""
        if self.operator == "wave":
            return [{"phase": 0.0}, {"phase": 0.5 * pi}]
        if self.operator == "curve":
            return [
                {f"knot_{k}": float(k == n) for k in range(1, KNOTS + 1)}
                for n in range(1, KNOTS + 1)
            ]
        return [{}]

    def typical_shape(self) -> float:
        """Return how large the shape is where the driver is at the end of its span."""
        reference = REFERENCES[self.driver]
        if self.operator == "gain":
            return max(self.span.largest / reference, 1e-9)
        if self.operator == "beyond":
            return max((self.span.high - self.held["inner"]) / reference, 1e-9)
        if self.operator == "lag":
            return max(0.3 * self.span.width / reference, 1e-9)
        return 1.0


def measure_spans(drives: tuple[Drive, ...]) -> dict[str, Span]:
    """Return the span of every driver that the records of a block reach."""
    signals: dict[str, list[Array]] = {name: [] for name in DRIVERS}
    longest_s = 0.0
    for drive in drives:
        longest_s = max(longest_s, float(np.sum(drive.step_s)))
        signals["command"].append(drive.valve_v)
        signals["position"].append(drive.position_m)
        signals["velocity"].append(drive.velocity_m_per_s)
        load = drive.load if drive.pressed_pa is None else drive.pressed_pa
        signals["pressure"].append(load - float(np.min(load)))
    spans = {name: _measure_span(np.concatenate(parts)) for name, parts in signals.items() if parts}
    spans["time"] = Span(0.0, longest_s, longest_s)
    return {name: span for name, span in spans.items() if span.width > 0.0}


def _measure_span(values: Array) -> Span:
    low, high = (float(q) for q in np.quantile(values, SPAN))
    return Span(low, high, max(abs(low), abs(high)))


def list_questions(
    block: str, drives: tuple[Drive, ...], nominal: PlantSettings, taken: Collection[str] = ()
) -> tuple[Question, ...]:
    """Return every term that may act on a block of this plant, given what the records reach.

    A part of the plant in which a term of the names `taken` acts already holds no other.
    """
    full = {location.part for location in LOCATIONS.values() if location.term_name in taken}
    spans = measure_spans(drives)
    if nominal.actuator == "direct":  # its motion alone drives terms
        spans.pop("pressure", None)
    return tuple(
        question
        for location in LOCATIONS.values()
        if block in location.seen_by
        and location.part not in full
        and nominal.actuator in location.actuators
        for question in _ask_location(location, spans)
        if not (question.operator == "wave" and block not in location.seen_by[:1])
    )


def _ask_location(location: Location, spans: Mapping[str, Span]) -> Iterator[Question]:
    first = next((d for d in location.drivers if d in spans), None)
    if first is None:
        return
    yield Question(location, "constant", first, span=spans[first])
    for driver in location.drivers:
        span = spans.get(driver)
        if span is None:
            continue
        yield Question(location, "gain", driver, span=span)
        ends = {"low": span.low, "high": span.high}
        yield Question(location, "curve", driver, ends, span)
        for operator, inner in _list_inner_numbers(location, driver, span):
            if location.allows(operator, driver):
                yield Question(location, operator, driver, {"inner": inner}, span)


def _list_inner_numbers(location: Location, driver: str, span: Span) -> Iterator[tuple[str, float]]:
    if driver == "time":
        for share in _SHARES["onset"]:
            yield "onset", share * span.high
        if location.name in ("supply", "opening"):
            for hz in np.geomspace(*WAVES_HZ):
                if hz * span.high >= LEAST_WAVES:
                    yield "wave", float(1.0 / hz)
        return
    if location.name == "encoder" and driver == "position":
        for waves in _PLACE_WAVES:
            yield "wave", span.width / waves
    if location.name in ("force", "volume", "flow", "damping", "pull"):
        for share in _SHARES["beyond"]:
            yield "beyond", span.low + share * span.width
    if location.name == "command":
        for operator in ("dead_zone", "saturation"):
            for share in _SHARES[operator]:
                yield operator, share * (span.largest if operator == "saturation" else span.width)
        for time_s in _SLEW_S:
            yield "slew", span.width / time_s
    for operator in ("play", "hysteresis"):
        if operator == "play" and location.name != "command":
            continue
        for share in _SHARES[operator]:
            yield operator, share * span.width
    for time_s in _LAGS_S.get(driver, ()):
        yield "lag", time_s
