"""The forms of a motion, as an experiment file states them; each form is described once.

`kind: sine` moves the muscle, with lengths in mm and in closed loop; `kind: valve_sine` moves the
valve, in V and in open loop. A form's class makes both. In a field's name here, `u` stands for the
one unit or the other: `amplitude_u` is the key `amplitude_mm` or `amplitude_v`.
"""

from __future__ import annotations

import math
import random
import re
from inspect import cleandoc
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal, TypeVar, cast

from pydantic import ConfigDict, Field, create_model, model_validator

from hal.calibration import Configured
from pamctl.base.chosen_model import build_once
from pamctl.control.sketch import Sketch
from pamctl.control.waves import (
    MOST_TONES,
    Sampled,
    SpeedChange,
    Sweep,
    Tone,
    Tones,
    scale_to_peak,
)

Seconds = Annotated[float, Field(ge=1e-6, le=86_400)]
Hertz = Annotated[float, Field(ge=1e-5, le=250)]
Count = Annotated[int, Field(ge=1, le=100_000)]
Level = Annotated[float, Field(ge=-1000, le=1000)]
Size = Annotated[float, Field(ge=1e-6, le=1000)]
Jerk = Annotated[float, Field(ge=1e-6, le=1e12, description="the highest jerk of a step or corner")]
Seed = Annotated[int, Field(ge=0)]
Trigger = Annotated[
    str | None,
    Field(min_length=1, max_length=100, description="mark at the start of each period, numbered"),
]
Fade = Annotated[
    Seconds | None, Field(description="time to grow and to decay; one period if absent")
]

SHORTEST_S = 5e-10
"""A course takes shorter times for none."""
MOST_ROWS = 8000
"""A table travels with the settings, into the log and to the daemon."""

_RANDOM_TONES = 24
# Peaks of the polynomials: of the jerk of a motion from rest to rest over 1 m in 1 s, and of a
# change of speed by 1 m/s in 1 s.
_STEP_JERK = 52.5
_CORNER_JERK = 10.0 / math.sqrt(3.0)
_CORNER_RISE = 0.34375
"""How far a corner from +1 to -1 m/s within 1 s rises."""


class Drawn(Configured):
    """An experiment, or a part of one: it draws itself into a course."""

    IS_VALVE: ClassVar[bool | None] = None
    """Whether it moves the valve, in open loop; None: neither valve nor muscle by itself."""
    IS_PART: ClassVar[bool] = False
    """It stands within a sequence only."""

    def draw(self, sketch: Sketch) -> None:
        """Add itself to a course."""
        raise NotImplementedError


class Form(Drawn):
    """What all forms share."""

    SI: ClassVar[float] = 1.0
    """One unit of the keys in m, or in V."""


def _name_keys(unit: str) -> ConfigDict:
    """Return the configuration that names the keys in a unit."""

    def name_key(field: str) -> str:
        return re.sub(r"_u(?=$|_per)", f"_{unit}", field)

    return ConfigDict(alias_generator=name_key, serialize_by_alias=True)


class _InMm(Form):
    model_config = _name_keys("mm")
    SI = 1e-3
    IS_VALVE = False


class _InVolts(Form):
    model_config = _name_keys("v")
    IS_VALVE = True


FORMS: dict[str, type[Form]] = {}
"""The forms by their kinds; `find_form` makes the model of a kind."""
_Form = TypeVar("_Form", bound=Form)


def _in_both_units(form: type[_Form]) -> type[_Form]:
    """Make two kinds of a form: one of the muscle and one of the valve."""
    stem = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", form.__name__.removesuffix("Form")).lower()
    FORMS[stem] = FORMS[f"{_OF_VALVE}{stem}"] = form
    return form


_OF_VALVE = "valve_"


@build_once
def find_form(kind: str) -> type[Form]:
    """Return the model of a kind, made at its first use; a run has one of them or none."""
    form = FORMS[kind]
    is_valve = kind.startswith(_OF_VALVE)
    whose, unit, loop = ("Valve", _InVolts, "open") if is_valve else ("Muscle", _InMm, "closed")
    kind_of: Any = Literal[kind]
    made = create_model(
        f"{whose}{form.__name__}",
        __base__=(form, unit),
        __module__=__name__,
        __doc__=f"{cleandoc(form.__doc__ or '')} Of the {whose.lower()}, in {loop} loop.",
        kind=(kind_of, ...),
    )
    return cast(type[Form], made)


def __getattr__(name: str) -> type[Form]:
    """Return a model by its name: pickle looks for it here."""
    for kind, form in FORMS.items():
        if name == f"{'Valve' if kind.startswith(_OF_VALVE) else 'Muscle'}{form.__name__}":
            return find_form(kind)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


@_in_both_units
class SineForm(Form):
    """A sine about an offset; `cycles` at full amplitude."""

    offset_u: Level = 0.0
    amplitude_u: Size
    frequency_hz: Hertz
    cycles: Count = 10
    fade_s: Fade = None
    trigger: Trigger = None

    def draw(self, sketch: Sketch) -> None:
        """Grow within a fade, go on for the cycles, decay."""
        period_s = 1.0 / self.frequency_hz
        fade_s = self.fade_s or period_s
        sketch.approach(self.SI * self.offset_u)
        sketch.trigger(self.trigger, period_s, self.cycles, fade_s)
        wave = Tones((Tone(self.SI * self.amplitude_u, math.tau * self.frequency_hz, 0.0),))
        sketch.draw_wave(wave, self.SI * self.offset_u, self.cycles * period_s, (fade_s, fade_s))


@_in_both_units
class MultisineForm(Form):
    """Many tones at once, all of them multiples of 1 / period_s: for frequency responses.

    They are spread evenly over the octaves, of equal amplitude, with phases drawn from the seed.
    """

    offset_u: Level = 0.0
    amplitude_u: Annotated[float, Field(gt=0, le=1000, description="highest peak")]
    low_hz: Hertz
    high_hz: Hertz
    period_s: Seconds
    periods: Count = 4
    tones: Annotated[int, Field(ge=1, le=MOST_TONES)] = 20
    seed: Seed = 1
    fade_s: Annotated[Seconds, Field(description="time to grow and to decay")] = 1.0
    trigger: Trigger = None

    @model_validator(mode="after")
    def _check_tones(self) -> MultisineForm:
        require_rising(self.low_hz, self.high_hz)
        if not self.list_harmonics():
            raise ValueError(
                f"no multiple of 1 / period_s ({1 / self.period_s:g} Hz) lies between low_hz "
                f"{self.low_hz:g} and high_hz {self.high_hz:g}; make the period longer"
            )
        return self

    def list_harmonics(self) -> list[int]:
        """Return the multiples of 1 / period_s; fewer than `tones` where they would coincide."""
        first = math.ceil(self.low_hz * self.period_s - 1e-9)
        last = math.floor(self.high_hz * self.period_s + 1e-9)
        ratio = (self.high_hz / self.low_hz) ** (1.0 / max(self.tones - 1, 1))
        wanted = (round(self.low_hz * self.period_s * ratio**i) for i in range(self.tones))
        return sorted({n for n in wanted if max(first, 1) <= n <= last})

    def draw(self, sketch: Sketch) -> None:
        """Grow, go through the periods, decay."""
        drawn = random.Random(f"multisine {self.seed}")
        tones = [
            Tone(1.0, math.tau * n / self.period_s, drawn.uniform(0.0, math.tau))
            for n in self.list_harmonics()
        ]
        wave = scale_to_peak(tones, self.SI * self.amplitude_u, self.period_s)
        sketch.approach(self.SI * self.offset_u)
        sketch.trigger(self.trigger, self.period_s, self.periods, self.fade_s)
        whole_s, fades_s = self.periods * self.period_s, (self.fade_s, self.fade_s)
        sketch.draw_wave(wave, self.SI * self.offset_u, whole_s, fades_s)


@_in_both_units
class ChirpForm(Form):
    """One tone from one frequency to another, evenly over the octaves or over the frequencies."""

    offset_u: Level = 0.0
    amplitude_u: Size
    start_hz: Hertz
    end_hz: Hertz
    duration_s: Seconds
    spacing: Literal["logarithmic", "linear"] = "logarithmic"
    fade_s: Annotated[
        Seconds | None,
        Field(description="time to grow and to decay, within duration_s; "
        "if absent, a period of the frequency there, a tenth of the duration at most"),
    ] = None  # fmt: skip
    trigger: Annotated[
        str | None, Field(min_length=1, max_length=100, description="mark at the start")
    ] = None

    @model_validator(mode="after")
    def _check_fade(self) -> ChirpForm:
        if self.fade_s is not None and 2 * self.fade_s >= self.duration_s:
            raise ValueError(
                f"fade_s {self.fade_s:g} at both ends leaves nothing of duration_s "
                f"{self.duration_s:g}"
            )
        return self

    def draw(self, sketch: Sketch) -> None:
        """Grow, sweep, and decay within the duration."""
        grows_s, decays_s = self.find_fades_s()
        sketch.approach(self.SI * self.offset_u)
        sketch.trigger(self.trigger, self.duration_s, 1)
        sketch.draw_wave(
            self.make_wave(),
            self.SI * self.offset_u,
            self.duration_s - grows_s - decays_s,
            (grows_s, decays_s),
            full_from_s=grows_s,
        )

    def make_wave(self) -> Sweep:
        """Return the tone about zero."""
        is_logarithmic = self.spacing == "logarithmic"
        amplitude = self.SI * self.amplitude_u
        return Sweep(amplitude, self.start_hz, self.end_hz, self.duration_s, is_logarithmic)

    def find_fades_s(self) -> tuple[float, float]:
        """Return how long it grows and how long it decays."""
        if self.fade_s is not None:
            return self.fade_s, self.fade_s
        longest_s = 0.1 * self.duration_s
        return min(1.0 / self.start_hz, longest_s), min(1.0 / self.end_hz, longest_s)


@_in_both_units
class RandomForm(Form):
    """Random motion within a band of frequencies; another seed gives another motion."""

    offset_u: Level = 0.0
    amplitude_u: Annotated[float, Field(gt=0, le=1000, description="highest peak")]
    low_hz: Annotated[float, Field(ge=0, le=250)] = 0.0
    high_hz: Hertz
    duration_s: Seconds
    seed: Seed = 1
    fade_s: Annotated[Seconds, Field(description="time to grow and to decay")] = 1.0

    @model_validator(mode="after")
    def _check_band(self) -> RandomForm:
        require_rising(self.low_hz, self.high_hz)
        return self

    def draw(self, sketch: Sketch) -> None:
        """Grow, go on for the duration, decay."""
        drawn = random.Random(f"random {self.seed}")
        width_hz = (self.high_hz - self.low_hz) / _RANDOM_TONES
        tones = [
            Tone(
                math.sqrt(-2.0 * math.log(1.0 - drawn.random())),
                math.tau * (self.low_hz + (i + drawn.random()) * width_hz),
                drawn.uniform(0.0, math.tau),
            )
            for i in range(_RANDOM_TONES)
        ]
        wave = scale_to_peak(tones, self.SI * self.amplitude_u, self.duration_s)
        fades_s = (self.fade_s, self.fade_s)
        sketch.draw_wave(wave, self.SI * self.offset_u, self.duration_s, fades_s)


@_in_both_units
class RoundedSquareForm(Form):
    """Between two levels, with transitions of a given highest jerk; it begins at the lower one."""

    offset_u: Level = 0.0
    amplitude_u: Size
    frequency_hz: Hertz
    jerk_u_per_s3: Jerk
    cycles: Count = 5
    trigger: Trigger = None

    @model_validator(mode="after")
    def _check_transition(self) -> RoundedSquareForm:
        half_s, lasts_s = 0.5 / self.frequency_hz, self._transition_s()
        if lasts_s > half_s:
            enough = 2 * self.amplitude_u * _STEP_JERK / half_s**3
            raise ValueError(
                f"a transition at this jerk lasts {lasts_s:.3g} s, longer than half a period of "
                f"{half_s:.3g} s; raise the jerk to {enough:.3g}"
            )
        return self

    def _transition_s(self) -> float:
        return find_step_s(2 * self.amplitude_u, self.jerk_u_per_s3)

    def draw(self, sketch: Sketch) -> None:
        """Go up and down, as long at each level as the period leaves."""
        low = self.SI * (self.offset_u - self.amplitude_u)
        high = self.SI * (self.offset_u + self.amplitude_u)
        half_s, lasts_s = 0.5 / self.frequency_hz, self._transition_s()
        sketch.approach(low)
        sketch.trigger(self.trigger, 2 * half_s, self.cycles)

        def draw_cycle() -> None:
            for there in (high, low):
                sketch.move(there, lasts_s)
                if half_s > lasts_s:
                    sketch.hold(half_s - lasts_s)

        sketch.repeat(self.cycles, draw_cycle)


@_in_both_units
class TriangleForm(Form):
    """Constant speed up and down, with rounded corners; it begins at the lower end."""

    offset_u: Level = 0.0
    amplitude_u: Annotated[float, Field(gt=0, le=1000, description="reached in the corners")]
    frequency_hz: Hertz
    rounding: Annotated[
        float, Field(ge=0.01, le=0.9, description="share of the time spent in corners")
    ] = 0.2
    cycles: Count = 5
    trigger: Trigger = None

    def draw(self, sketch: Sketch) -> None:
        """Leave the lower end from rest, and come to rest there."""
        half_s = 0.5 / self.frequency_hz
        corner_s = self.rounding * half_s
        line_s = half_s - corner_s
        low, size = self.SI * (self.offset_u - self.amplitude_u), 2 * self.SI * self.amplitude_u
        speed = size / (line_s + 2 * _CORNER_RISE * corner_s)
        # As far as from the corner's end to the middle of the line below it.
        rise, begin_s = _CORNER_RISE * speed * corner_s, 2 * _CORNER_RISE * corner_s
        under, over = low + rise, low + size - rise

        def draw_line(start: float, end: float) -> None:
            rate = (end - start) / line_s
            sketch.draw(SpeedChange(start, rate, rate, line_s), line_s, end)

        def draw_corner(at: float, rate: float) -> None:
            sketch.draw(SpeedChange(at, rate, -rate, corner_s), corner_s, at)

        def draw_middle() -> None:
            draw_line(under, over)
            draw_corner(over, speed)
            draw_line(over, under)
            draw_corner(under, -speed)

        sketch.approach(low)
        sketch.trigger(self.trigger, 2 * half_s, self.cycles, begin_s - 0.5 * corner_s)
        sketch.draw(SpeedChange(low, 0.0, speed, begin_s), begin_s, under)
        if self.cycles > 1:
            sketch.repeat(self.cycles - 1, draw_middle)
        draw_line(under, over)
        draw_corner(over, speed)
        draw_line(over, under)
        sketch.draw(SpeedChange(under, -speed, 0.0, begin_s), begin_s, low)


@_in_both_units
class RampsForm(Form):
    """At constant speed from level to level, with corners of a given highest jerk."""

    levels_u: Annotated[tuple[Level, ...], Field(min_length=2, max_length=1000)]
    speed_u_per_s: Annotated[float, Field(ge=1e-6, le=1e5)]
    jerk_u_per_s3: Jerk
    hold_s: Annotated[float, Field(ge=0, le=86_400, description="at each level")] = 1.0
    cycles: Count = 1
    trigger: Trigger = None

    def draw(self, sketch: Sketch) -> None:
        """Go from level to level."""
        levels = [self.SI * level for level in self.levels_u]

        def draw_cycle() -> None:
            sketch.approach(levels[0])
            sketch.trigger(self.trigger, 0.0, 1)
            for here, there in pairwise(levels):
                self._draw_ramp(sketch, here, there)
                if self.hold_s > SHORTEST_S:
                    sketch.hold(self.hold_s)

        sketch.repeat(self.cycles, draw_cycle)

    def _draw_ramp(self, sketch: Sketch, here: float, there: float) -> None:
        way, jerk = there - here, self.SI * self.jerk_u_per_s3
        if way == 0.0:
            return
        # Two corners take speed x corner_s of the way: a short ramp never reaches the speed.
        speed = min(
            self.SI * self.speed_u_per_s, (abs(way) * math.sqrt(jerk / _CORNER_JERK)) ** (2 / 3)
        )
        corner_s = math.sqrt(_CORNER_JERK * speed / jerk)
        rate = math.copysign(speed, way)
        begin, end = here + 0.5 * rate * corner_s, there - 0.5 * rate * corner_s
        line_s = (end - begin) / rate
        sketch.draw(SpeedChange(here, 0.0, rate, corner_s), corner_s, begin)
        if line_s > 1e-9:
            sketch.draw(SpeedChange(begin, rate, rate, line_s), line_s, end)
        sketch.draw(SpeedChange(end, rate, 0.0, corner_s), corner_s, there)


@_in_both_units
class StaircaseForm(Form):
    """Steps from level to level, each smoothed to a given highest jerk; two levels are a step."""

    levels_u: Annotated[tuple[Level, ...], Field(min_length=2, max_length=1000)]
    hold_s: Annotated[Seconds, Field(description="at each level")] = 2.0
    jerk_u_per_s3: Jerk
    cycles: Count = 1
    trigger: Trigger = None

    def draw(self, sketch: Sketch) -> None:
        """Step from level to level."""
        levels = [self.SI * level for level in self.levels_u]

        def draw_cycle() -> None:
            sketch.approach(levels[0])
            sketch.trigger(self.trigger, 0.0, 1)
            sketch.hold(self.hold_s)
            for here, there in pairwise(levels):
                if there != here:
                    sketch.move(there, find_step_s(there - here, self.SI * self.jerk_u_per_s3))
                sketch.hold(self.hold_s)

        sketch.repeat(self.cycles, draw_cycle)


@_in_both_units
class TableForm(Form):
    """Points of a CSV or MAT file, or written here, joined with a continuous third derivative.

    The curve is at rest at its first and its last point. A file is read once, before the run: its
    points travel in `t_s` and `values` from there on.
    """

    file: Annotated[
        str | None, Field(min_length=1, description="CSV or MAT file; from this file's folder")
    ] = None
    time_column: Annotated[
        str | None, Field(description="if absent, the column whose name states a time")
    ] = None
    value_column: Annotated[
        str | None, Field(description="if absent, the column whose name states the quantity")
    ] = None
    unit: Annotated[
        str | None, Field(description="of the value column; if absent, that of its name")
    ] = None
    every: Annotated[int, Field(ge=1, le=100_000, description="take each n-th row only")] = 1
    t_s: Annotated[tuple[float, ...], Field(max_length=MOST_ROWS)] = ()
    values_u: Annotated[tuple[Level, ...], Field(max_length=MOST_ROWS)] = ()
    cycles: Count = 1
    trigger: Trigger = None

    @model_validator(mode="after")
    def _check_points(self) -> TableForm:
        if len(self.t_s) < 2:
            raise ValueError(f"a table needs two points at least (it has {len(self.t_s)})")
        if len(self.t_s) != len(self.values_u):
            raise ValueError(f"{len(self.t_s)} times, but {len(self.values_u)} values")
        for row, (before_s, now_s) in enumerate(pairwise(self.t_s), 2):
            if now_s <= before_s:
                raise ValueError(
                    f"time must rise: point {row} is at {now_s:g} s after {before_s:g} s"
                )
        return self

    def draw(self, sketch: Sketch) -> None:
        """Follow the points."""
        t_s = [t - self.t_s[0] for t in self.t_s]
        values = [self.SI * value for value in self.values_u]
        curve = Sampled(t_s, values)

        def draw_cycle() -> None:
            sketch.approach(values[0])
            sketch.trigger(self.trigger, 0.0, 1)
            sketch.draw(curve, t_s[-1], values[-1])

        sketch.repeat(self.cycles, draw_cycle)


@_in_both_units
class MoveForm(Form):
    """From rest to rest, as the motions of the paper's experiments; within a sequence."""

    IS_PART = True
    to_u: Level
    duration_s: Seconds

    def draw(self, sketch: Sketch) -> None:
        """Move from where the part before has ended."""
        sketch.move(self.SI * self.to_u, self.duration_s)


def find_step_s(way: float, jerk: float) -> float:
    """Return how long a motion from rest to rest lasts whose jerk peaks at `jerk`."""
    return math.cbrt(_STEP_JERK * abs(way) / jerk)


def require_rising(low_hz: float, high_hz: float) -> None:
    """Raise ValueError for a band that is none."""
    if low_hz >= high_hz:
        raise ValueError(f"low_hz {low_hz:g} must lie below high_hz {high_hz:g}")
