"""The cases: each situation at two sizes, over three excitations, with its right answer."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from hidden.effects import CALLED, Size
from hidden.hostile.causes import Answer, Kind, SetupCause
from hidden.hostile.lab import Channel, Lab
from hidden.hostile.programs import EXCITATIONS

SIZES = ("small", "large")

Pair = tuple[Lab, Lab]
Answers = tuple[Answer, Answer]
Effects = Mapping[str, Size]


@dataclass(frozen=True)
class Situation:
    """What a laboratory did not know, small and large."""

    name: str
    group: str
    labs: Pair
    answers: Answers
    effects: tuple[Effects, Effects] = field(default_factory=lambda: ({}, {}))


@dataclass(frozen=True)
class HostileCase:
    """One examination."""

    situation: Situation
    size: str
    excitation: str

    @property
    def id(self) -> str:
        """Its name in the results."""
        return f"{self.situation.name}/{self.size}/{self.excitation}"

    @property
    def seed(self) -> int:
        """Fixed for a case, different for each."""
        return zlib.crc32(self.id.encode()) % 1_000_000

    @property
    def _index(self) -> int:
        return SIZES.index(self.size)

    @property
    def lab(self) -> Lab:
        """What is wrong."""
        return self.situation.labs[self._index]

    @property
    def answer(self) -> Answer:
        """What may be said."""
        return self.situation.answers[self._index]

    @property
    def effects(self) -> Effects:
        """What is hidden in the rig besides."""
        return self.situation.effects[self._index]


def _labs(make: Callable[[float], Lab], sizes: tuple[float, float]) -> Pair:
    """Return the two laboratories of one kind."""
    return make(sizes[0]), make(sizes[1])


def _set_up(
    kind: Kind, number: str, sizes: tuple[float | None, float | None] = (None, None)
) -> Answers:
    """Return the answers that name one cause, of a value for each size."""
    small, large = (Answer(setup=(SetupCause(kind, number, value),)) for value in sizes)
    return small, large


def _with(answers: Answers, **changes: Any) -> Answers:
    return replace(answers[0], **changes), replace(answers[1], **changes)


def _same(answer: Answer) -> Answers:
    return answer, answer


def null_situations() -> Iterator[Situation]:
    """Nothing is wrong but numbers that a recalibration finds."""
    yield Situation("nothing", "null", (Lab(), Lab()), _same(Answer(silent=True)))
    symmetric: dict[str, tuple[float, float]] = {
        "temperature_k": (1.05, 1.12),
        "braid_turns": (1.03, 0.93),
        "braid_contact_area_m2": (1.2, 0.8),
    }
    for number, factors in symmetric.items():
        # Only a product of it and numbers that are fitted anyway shows: nothing is left to name.
        cause = SetupCause("plant_constant", number)
        yield Situation(
            f"wrong_{number}",
            "null",
            _labs(partial(_mistyped, number), factors),
            _same(Answer(silent=True, also=(cause,))),
        )
    yield Situation(
        "clock_of_all",
        "null",
        (Lab(time_rate=0.005), Lab(time_rate=0.03)),
        _same(Answer(silent=True, also=(SetupCause("clock_rate", "t_s"),))),
    )


def set_up_situations() -> Iterator[Situation]:
    """What is wired, typed or set otherwise than the plant file and the columns say."""
    for name, offsets in {"null_up": (0.02, 0.15), "null_down": (-0.05, -0.2)}.items():
        yield Situation(
            name,
            "set_up",
            _labs(_nulled, offsets),
            _with(_set_up("null_offset", "", offsets), equal=frozenset({"null_offset"})),
        )
    place = "atmospheric_pressure_pa"
    yield Situation(
        "atmosphere_gauge_sensor",
        "set_up",
        (
            Lab(true_atmosphere_pa=94e3, sensor_is_gauge=True),
            Lab(true_atmosphere_pa=80e3, sensor_is_gauge=True),
        ),
        _with(
            _set_up("plant_constant", place, (94e3, 80e3)),
            beside=frozenset({"pressure_sensor_gain"}),
        ),
    )
    absolute = (Lab(true_atmosphere_pa=98e3), Lab(true_atmosphere_pa=88e3))
    yield Situation(
        "atmosphere_absolute_sensor",
        "set_up",
        absolute,
        _with(
            _set_up("plant_constant", place, (98e3, 88e3)),
            beside=frozenset({"pressure_sensor_gain", "pressure_sensor_offset"}),
        ),
    )
    yield from _wrong_plant_numbers()
    yield from _wrong_columns()


def _wrong_plant_numbers() -> Iterator[Situation]:
    length = _set_up("plant_constant", "rest_length_m", (0.2, 0.2))
    yield Situation(
        "rest_length_short",
        "set_up",
        (Lab(plant_factors={"rest_length_m": 0.99}), Lab(plant_factors={"rest_length_m": 0.97})),
        length,
    )
    yield Situation(  # a file that is too long is the equation of a lost length
        "rest_length_long",
        "set_up",
        (Lab(plant_factors={"rest_length_m": 1.01}), Lab(plant_factors={"rest_length_m": 1.03})),
        _with(length, equal=frozenset({"end_cap"})),
    )
    yield Situation(
        "braid_length",
        "set_up",
        (Lab(plant_factors={"braid_length_m": 1.005}), Lab(plant_factors={"braid_length_m": 1.03})),
        _set_up("plant_constant", "braid_length_m", (0.232, 0.232)),
    )
    yield Situation(  # the large one: the gauge's reading typed as absolute
        "supply",
        "set_up",
        (Lab(plant_factors={"tank_pressure_pa": 0.93}), Lab(plant={"tank_pressure_pa": 340e3})),
        _set_up("plant_constant", "tank_pressure_pa", (441.3e3, 441.3e3)),
    )


def _wrong_columns() -> Iterator[Situation]:
    channels: tuple[Channel, ...] = ("valve_v", "pressure_pa", "position_m")
    for channel in channels:
        answer = Answer(
            setup=(SetupCause("sign", channel),), refusal=("sign", "invert", "negative", "opposite")
        )
        yield Situation(
            f"sign_{channel}",
            "set_up",
            (Lab(inverted=(channel,)), Lab(inverted=(channel,))),
            _same(answer),
            ({}, {"valve_deadband": 5}),
        )
    yield Situation(
        "encoder_scale",
        "set_up",
        (Lab(position_scale=1.03), Lab(position_scale=4.0)),
        _with(
            _set_up("scale", "position_m", (1.03, 4.0)),
            equal=frozenset({"encoder_scale"}),
            refusal=("scale", "unit", "travel", "stroke", "count", "longer", "limit"),
        ),
    )
    yield Situation(  # the small one: taken for absolute; the large one: the zero is added twice
        "gauge",
        "set_up",
        (Lab(pressure_zero_shift_pa=-101.3e3), Lab(pressure_zero_shift_pa=101.3e3)),
        _with(
            _set_up("gauge", "pressure_pa"),
            equal=frozenset({"pressure_sensor_offset"}),
            refusal=("gauge", "absolute", "atmosphere", "vacuum"),
        ),
    )
    yield Situation(
        "decimated_command",
        "set_up",
        (Lab(decimation=5), Lab(decimation=20)),
        _with(
            _set_up("decimated_command", ""),
            beside=frozenset({"command_delay"}),
            refusal=("rate", "decimat", "held", "once in", "resampl", "Hz"),
        ),
    )


def _mistyped(number: str, factor: float) -> Lab:
    return Lab(plant_factors={number: factor})


def _nulled(volts: float) -> Lab:
    # Laps that are shifted to one side: what is left of a command u is exactly u - volts.
    return Lab(truth={"overlap_fill_v": volts, "overlap_vent_v": -volts})


def time_situations() -> Iterator[Situation]:
    """Columns that do not belong to the same instant, and clocks that do not run alike."""
    shifts: dict[str, tuple[Channel, float, float]] = {
        "pressure_late": ("pressure_pa", 1e-3, 5e-3),
        "pressure_early": ("pressure_pa", -2e-3, -5e-3),
        "position_late": ("position_m", 2e-3, 5e-3),
        "position_early": ("position_m", -1e-3, -4e-3),
        "command_late": ("valve_v", 1e-3, 3e-3),
        "command_early": ("valve_v", -1e-3, -5e-3),
    }
    for name, (channel, small, large) in shifts.items():
        beside = {"pressure_late": {"pressure_sensor_lag"}}.get(name, set())
        equal = {"command_delay"} if name == "command_early" else set()
        answers = _with(
            _set_up("skew", channel, (small, large)),
            beside=frozenset(beside),
            equal=frozenset(equal),
        )
        labs = Lab(late_s={channel: small}), Lab(late_s={channel: large})
        yield Situation(name, "time", labs, answers)
    # Samples that are older than their stamp, at which the command acts: the command is early.
    yield Situation(
        "stamps_late",
        "time",
        _labs(_stamped_late, (0.5e-3, 1.5e-3)),
        _with(_set_up("skew", "valve_v", (-0.5e-3, -1.5e-3)), equal=frozenset({"command_delay"})),
    )
    clocks: dict[Channel, tuple[float, float]] = {
        "valve_v": (3e-4, 1e-3),
        "pressure_pa": (-3e-4, -1e-3),
    }
    for channel, rates in clocks.items():
        labs = Lab(clock_rates={channel: rates[0]}), Lab(clock_rates={channel: rates[1]})
        yield Situation(f"clock_{channel}", "time", labs, _set_up("clock_rate", channel, rates))


def _stamped_late(seconds: float) -> Lab:
    return Lab(late_s={"pressure_pa": seconds, "position_m": seconds})


CHANGING = {
    "stiffness": ("stiffness", "stiffness_n_per_m", 0.01, 0.04),
    "friction": ("mu_k", "kinetic_friction_per_m", 0.05, 0.15),
    "valve_gain": ("valve_m2_per_v", "valve_gain_m2_per_v", 0.02, 0.06),
}
"""What changes: the number's name in the truth and in the plant file, and the share."""


def change_situations() -> Iterator[Situation]:
    """Numbers that drift within or between the records, or change at an instant."""
    for name, (mine, theirs, small, large) in CHANGING.items():
        cause = _set_up("drift", theirs, (-small, -large))
        within = Lab(within={mine: -small}), Lab(within={mine: -large})
        between = Lab(between={mine: -small}), Lab(between={mine: -large})
        yield Situation(
            f"{name}_within", "change", within, _with(cause, equal=frozenset({"drift"}))
        )
        yield Situation(f"{name}_between", "change", between, cause)
    yield Situation(  # to call it a leak is true as well: when it began is what has to be said
        "leak_from_half",
        "change",
        (Lab(at_half={"chamber_leak_m2": 1e-8}), Lab(at_half={"chamber_leak_m2": 4e-8})),
        _with(_set_up("change_at_instant", "chamber_leak"), beside=frozenset({"chamber_leak"})),
    )
    yield Situation(
        "softer_from_half",
        "change",
        (Lab(at_half_factors={"stiffness": 0.98}), Lab(at_half_factors={"stiffness": 0.93})),
        _set_up("change_at_instant", "stiffness_n_per_m", (-0.02, -0.07)),
    )


def noise_situations() -> Iterator[Situation]:
    """The physics is right; the columns are not white around it."""

    def said(*words: str, silent_large: bool = True) -> Answers:
        small = Answer(noise=words, silent=True)
        return small, replace(small, silent=silent_large)

    many: dict[str, tuple[Pair, Answers]] = {
        "filtered": (
            (Lab(filter_hz=60.0), Lab(filter_hz=30.0)),
            _same(Answer(noise=("filtered",))),
        ),
        "hum": (
            (Lab(hum_hz=50.0, hum_pa=400.0), Lab(hum_hz=60.0, hum_pa=3000.0, hum_m=20e-6)),
            said("hum", silent_large=False),
        ),
        "spikes": (
            (Lab(spikes=0.002, spike_pa=8e3), Lab(spikes=0.002, spike_pa=60e3, spike_m=0.3e-3)),
            said("outliers", silent_large=False),
        ),
        "dropouts": (
            (Lab(dropouts=0.001), Lab(dropouts=0.005)),
            said("dropouts", silent_large=False),
        ),
        "noise_with_flow": ((Lab(noise_with_flow=1.0), Lab(noise_with_flow=4.0)), said("flow")),
        "wander": ((Lab(wander_pa=500.0), Lab(wander_pa=2000.0)), said("wander")),
        "coarse": ((Lab(adc_bits=10), Lab(adc_bits=8)), said("coarse")),
        "stamp_jitter": (
            (Lab(jittered_stamps_s=0.1e-3), Lab(jittered_stamps_s=0.5e-3)),
            said("jitter", silent_large=False),
        ),
    }
    for name, (labs, answers) in many.items():
        yield Situation(name, "noise", labs, answers)
    deadband: Effects = {"valve_deadband": 5}
    named = Answer(effects=frozenset(deadband))
    for name in ("filtered", "hum", "spikes", "noise_with_flow"):
        labs, _ = many[name]
        yield Situation(f"deadband_with_{name}", "mixed", labs, _same(named), (deadband, deadband))


def edge_situations() -> Iterator[Situation]:
    """No cliff: a large effect beside one that is hardly there, and a tank that runs empty."""
    none = (Lab(), Lab())
    deadband = Answer(effects=frozenset({"valve_deadband"}))
    yield Situation(
        "deadband_and_dead_volume",
        "edge",
        none,
        _same(deadband),
        ({"valve_deadband": 5, "dead_volume": 0.1}, {"valve_deadband": 5, "dead_volume": 0.5}),
    )
    yield Situation(
        "deadband_and_spool",
        "edge",
        none,
        (deadband, Answer(effects=frozenset({"valve_deadband", "valve_spool"}))),
        ({"valve_deadband": 5, "valve_spool": 0.5}, {"valve_deadband": 5, "valve_spool": 3}),
    )
    yield Situation(
        "finite_tank",
        "edge",
        (
            Lab(truth={"regulator_pa_s_per_kg": 2e7, "tank_m3": 5e-3}),
            Lab(truth={"regulator_pa_s_per_kg": 4e7, "tank_m3": 1e-3}),
        ),
        _same(Answer(effects=frozenset({"supply_droop"}))),
    )


def unknown_situations() -> Iterator[Situation]:
    """What no catalogue has, or had once: no name is right, or the one that has come since."""
    none = (Lab(), Lab())
    yield Situation(
        "second_spring",
        "unknown",
        (
            Lab(truth={"stop_m": 14e-3, "stop_n_per_m": 900.0}),
            Lab(truth={"stop_m": 14e-3, "stop_n_per_m": 3000.0}),
        ),
        _same(Answer(unknown=True)),
    )
    yield Situation(
        "sensor_bow",
        "unknown",
        (Lab(pressure_bow=0.005), Lab(pressure_bow=0.02)),
        _set_up("bow", "pressure_pa", (1750.0, 7000.0)),
    )
    for name, called in CALLED.items():
        if name != "hysteretic_spring":
            known = Answer(effects=frozenset({called}))
            yield Situation(name, "unknown", none, _same(known), ({name: 3}, {name: 10}))


def all_situations() -> Iterator[Situation]:
    """Return every situation."""
    for made in (
        null_situations, set_up_situations, time_situations, change_situations,
        noise_situations, edge_situations, unknown_situations,
    ):  # fmt: skip
        yield from made()


def all_cases() -> Iterator[HostileCase]:
    """Return every situation at two sizes over three excitations."""
    for situation in all_situations():
        for size in SIZES:
            for excitation in EXCITATIONS:
                yield HostileCase(situation, size, excitation)
