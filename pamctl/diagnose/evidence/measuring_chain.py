"""What lies between the plant and a file, as a part of the pool.

Columns that are late, smoothed, of another clock or turned round, or that show the command too; the
air of the place; numbers of the plant file that no fit moves.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from pamctl.diagnose.evidence.pool import CHAIN, Hypothesis, Unknown, Variant
from pamctl.plant.effects.description import Actuator
from pamctl.plant.terms import REFERENCES

ATMOSPHERE = "atmospheric_pressure_pa"
"""Of the plant; behind CHAIN a gauge sensor's readings follow it, as the file added the plant's."""
TURNED = "turned"
"""The kind of a column of the wrong sign."""
ADDED = "added"
"""The kind of a pressure to which the atmosphere was added twice."""
HIGH_UP = 0.4
"""Of the air's pressure at sea level, the share that the highest laboratories lack."""
HEAVIER = 12.0
"""Times the plant file's mass that may move."""
SWITCHED = (TURNED, ADDED)
"""Kinds that are so or not: there is nothing between."""
STOP = "stop"
"""The kind of an end that is seen elsewhere."""
CROSSTALK = "crosstalk"
"""The kind of a sensor's line into which the command couples."""
FULL_SCALE_V = 10.0
"""A command of this size couples at most a sensor's whole range into its line."""

SCALE = "scale"
"""The kind, and the place, of a factor between what drives a mechanism and its position."""

HOME = f"{CHAIN}home."
"""Begins a zero that is free beside an effect which homing does not see."""


def free_home(hypothesis: Hypothesis) -> Hypothesis:
    """Return the hypothesis with a zero that it leaves open: an encoder is homed within a play."""
    if hypothesis.family != "encoder_backlash":
        return hypothesis
    variants = []
    for variant in hypothesis.variants:
        (width,) = variant.sizes
        half = 0.5 * width.high
        zero = Unknown(f"{HOME}position_m", 0.0, -half, half, width.scale)
        variants.append(variant._replace(shapes=(*variant.shapes, zero)))
    return replace(hypothesis, variants=tuple(variants))


def share_scale(hypothesis: Hypothesis, drivers: Sequence[str]) -> Hypothesis:
    """Return the hypothesis as the scale of the position, or of the measured columns that drive it.

    By a force of s times the size a mechanism moves s times as far, with other sizes of its other
    laws: no data tell a force constant that is low from a position that is shown too large.
    """
    if hypothesis.family != "encoder_scale" or not drivers:
        return hypothesis
    setup = SCALE, " or ".join([*drivers, "position_m"])
    akin = (*hypothesis.akin, "encoder~curve(position)")  # it can mimic it, at another place
    return replace(hypothesis, place=SCALE, kind=SCALE, akin=akin, setup=setup)


def list_of_chain(
    channels: Sequence[str],
    plant: Mapping[str, float],
    period_s: float,
    actuator: Actuator,
    reach: Mapping[str, tuple[float, float]],
) -> Iterator[Hypothesis]:
    """Yield what makes a file differ from the plant; `reach` is the range of each column.

    Columns that are late, smoothed, of another clock, turned round, or that show the command too;
    the air of the place; numbers of the plant file that no fit moves.
    """
    tick, places = period_s, {"pressure_pa": "pressure_sensor", "position_m": "encoder"}
    for channel in channels:
        place, short = places.get(channel, channel), channel.split("_")[0]
        late = Unknown(f"{CHAIN}late.{channel}", tick, -20 * tick, 20 * tick, tick, 0.0, 0.4 * tick)
        yield Hypothesis(f"{short}_late", place, "lag", (Variant({}, (late,)),), f"{short}_late",
                         setup=("skew", channel))  # fmt: skip
        width = Unknown(
            f"{CHAIN}smooth.{channel}", 4 * tick, 0.0, 100 * tick, 2 * tick, 0.0, 0.4 * tick
        )
        name = f"{short}_smoothed"
        yield Hypothesis(
            name, place, "lag", (Variant({}, (width,)),), name, setup=("filtered", channel)
        )
        yield _make_turn(short, place, channel)
        yield _make_clock(short, place, channel)
    if actuator != "direct":
        analog = [(c, at) for c, at in places.items() if c in channels and "command" in reach]
        yield from (_make_crosstalk(channel, place, reach) for channel, place in analog)
        yield _make_turn("valve", "valve", "valve_v")
        yield _make_clock("all", "clock", "t_s")
        # Logged too early it is a delay of the rig.
        late = Unknown(f"{CHAIN}late.valve_v", tick, 0.0, 20 * tick, tick, 0.0, 0.4 * tick)
        yield Hypothesis(
            "valve_late", "valve", "lag", (Variant({}, (late,)),), "valve_late",
            setup=("skew", "valve_v"),
        )  # fmt: skip
        yield _make_clock("valve", "valve", "valve_v")
    if "pressure_pa" in channels:
        air = plant["atmospheric_pressure_pa"]
        name = f"{CHAIN}added.pressure_pa"
        added = Unknown(name, air, 0.9 * air, 1.1 * air, 0.01 * air, 0.0, air)
        yield Hypothesis(
            "atmosphere_added", "pressure_sensor", ADDED, (Variant({}, (added,)),),
            "atmosphere_added", setup=(ADDED, "pressure_pa"),
        )  # fmt: skip
        gauge, absolute = (
            _make_number("atmosphere", "pressure_sensor", number, air, 0.02, HIGH_UP)
            for number in (f"{CHAIN}atmosphere", ATMOSPHERE)
        )
        yield replace(gauge, variants=(*gauge.variants, *absolute.variants))
    if actuator == "muscle":
        for name, share in (("rest_length_m", 0.01), ("temperature_k", 0.02)):
            place = "pull" if name == "rest_length_m" else "air"
            yield _make_number(name.rsplit("_", 1)[0], place, name, plant[name], share, 0.05)
        yield _make_mass(plant["mass_kg"])
    if plant.get("stroke_m") and "position" in reach:
        yield _make_stop(plant["stroke_m"], *reach["position"])


def _make_stop(stroke_m: float, lowest_m: float, highest_m: float) -> Hypothesis:
    """Return an end of the stroke that is seen elsewhere: another stroke, or another zero.

    Friction holds a piston off its end while it is homed. Where both ends are seen the zero is off;
    where one is, the data do not tell. The fit begins where the piston stopped: it was not beyond.
    """
    visible = 0.01 * stroke_m
    if abs(highest_m - lowest_m - stroke_m) < visible:
        name, begin_m, neutral_m = f"{CHAIN}added.position_m", lowest_m, 0.0
        range_m = -stroke_m, stroke_m
    else:
        name, begin_m, neutral_m = "stroke_m", highest_m, stroke_m
        range_m = highest_m - visible, 1.5 * stroke_m
    size = Unknown(name, begin_m, *range_m, visible, neutral_m, visible)
    seen = Variant({}, (size,))
    setup = ("end_stop", "position_m")
    return Hypothesis("end_stop", "encoder", STOP, (seen,), "end_stop", setup=setup, far=seen)


SOFT_SHARE = 0.3
"""Of the way: over so much a soft end takes the machine's whole force, where its fit begins."""


def begin_at_soft_end(
    hypothesis: Hypothesis, reach: Mapping[str, tuple[float, float]], force_n: float
) -> Hypothesis:
    """Return a force that begins at a position, with a fit that begins near the end of the way.

    There a cushion may take the machine's whole force, `force_n`.
    """
    if hypothesis.name != "force~beyond(position)":
        return hypothesis
    low_m, high_m = reach["position"]
    soft_m, variant = SOFT_SHARE * (high_m - low_m), hypothesis.variants[0]
    (size,), (inner,) = variant.sizes, variant.shapes
    stops = replace(size, value=-force_n * REFERENCES["position"] / soft_m)
    begins = replace(inner, value=high_m - soft_m)
    return replace(hypothesis, far=variant._replace(sizes=(stops,), shapes=(begins,)))


def _make_turn(short: str, place: str, channel: str) -> Hypothesis:
    """Return a column of the wrong sign: its factor is -1, or near it."""
    factor = Unknown(f"{CHAIN}factor.{channel}", -1.0, -2.0, -0.5, 0.05, 1.0, 0.5)
    name = f"{short}_turned"
    variants = (Variant({}, (factor,)),)
    return Hypothesis(name, place, TURNED, variants, name, setup=("sign", channel))


def _make_clock(short: str, place: str, channel: str) -> Hypothesis:
    """Return a clock that parts from the others, or that of all columns: it may run much faster."""
    most, visible = (0.1, 1e-3) if channel == "t_s" else (0.02, 1e-4)
    rate = Unknown(f"{CHAIN}clock.{channel}", visible, -most, most, visible, 0.0, 1e-4)
    name = f"{short}_clock"
    variants = (Variant({}, (rate,)),)
    return Hypothesis(name, place, "clock", variants, name, setup=("clock_rate", channel))


def _make_crosstalk(
    channel: str, place: str, reach: Mapping[str, tuple[float, float]]
) -> Hypothesis:
    """Return a reading that also shows so much for each volt of the command."""
    short = channel.split("_")[0]
    low, high = reach[short]
    most, visible = (high - low) / FULL_SCALE_V, 1e-4 * (high - low)
    size = Unknown(f"{CHAIN}cross.{channel}", 10.0 * visible, -most, most, visible, 0.0, visible)
    name = f"{short}_{CROSSTALK}"
    return Hypothesis(
        name, place, CROSSTALK, (Variant({}, (size,)),), name, setup=(CROSSTALK, channel)
    )


def _make_mass(mass_kg: float) -> Hypothesis:
    """Return another moving mass: what hangs on the muscle was not weighed.

    Beside the damping it is nearly a position that is late by M / c.
    """
    size = Unknown(
        "mass_kg", 2.0 * mass_kg, mass_kg / HEAVIER, mass_kg * HEAVIER, mass_kg, mass_kg,
        0.5 * mass_kg,
    )  # fmt: skip
    setup = ("plant_constant", "mass_kg")
    return Hypothesis("mass", "pull", "constant", (Variant({}, (size,)),), "mass", setup=setup)


def _make_number(
    name: str, place: str, number: str, value: float, share: float, most: float
) -> Hypothesis:
    size = Unknown(
        number, value * (1.0 - share), value * (1.0 - most), value * (1.0 + most),
        value * share, value, 0.2 * value * share,
    )  # fmt: skip
    setup = ("plant_constant", number.lstrip(CHAIN) if name != "atmosphere" else ATMOSPHERE)
    return Hypothesis(name, place, "constant", (Variant({}, (size,)),), name, setup=setup)
