"""The cases: each situation at two sizes, over three excitations, with its right answer."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from hidden.effects import CALLED, Size
from hidden.hostile.file_of_lab import record_of
from hidden.hostile.lab import Answer, Channel, Kind, Lab, SetupCause
from hidden.hostile.programs import EXCITATIONS
from hidden.rig import HiddenRig, Record, hidden_rig
from pamctl.plant.model import MuscleParameters, PlantSettings

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

    @property
    def rig(self) -> HiddenRig:
        """Its numbers are a few per cent off the paper's, and its effects hidden."""
        return hidden_rig(self.effects, seed=self.seed)

    def records(self) -> tuple[list[Record], list[Record]]:
        """Return the (training, held-out) records as the user's files hold them.

        They were recorded in turn, one to fit and one to judge: what changes from record to record
        changes in both.
        """
        rig, (train, held_out) = self.rig, EXCITATIONS[self.excitation](self.seed)
        order = [run for pair in zip(train, held_out, strict=True) for run in pair]
        last = max(len(order) - 1, 1)
        made = {run.name: record_of(rig, self.lab, run, k / last) for k, run in enumerate(order)}
        return [made[run.name] for run in train], [made[run.name] for run in held_out]

    def start_plant(self) -> PlantSettings:
        """Return the plant file that the user typed."""
        numbers = MuscleParameters().model_dump()
        numbers |= {name: numbers[name] * by for name, by in self.lab.plant_factors.items()}
        return PlantSettings(parameters=MuscleParameters(**{**numbers, **self.lab.plant}))


def _two(**fields: tuple[Any, Any]) -> Pair:
    """Return the small and the large laboratory, of each field its two values."""
    small, large = (Lab(**{name: values[k] for name, values in fields.items()}) for k in (0, 1))
    return small, large


def _each(key: str, values: tuple[float, float]) -> tuple[dict[str, float], dict[str, float]]:
    """Return the two values of a field that is a mapping."""
    return {key: values[0]}, {key: values[1]}


def _set_up(kind: Kind, number: str) -> Answers:
    """Return the answers that name one cause."""
    return _same(Answer(setup=(SetupCause(kind, number),)))


def _with(answers: Answers, **changes: Any) -> Answers:
    return replace(answers[0], **changes), replace(answers[1], **changes)


def _same(answer: Answer) -> Answers:
    return answer, answer


def _name(*effects: str) -> Answer:
    return Answer(effects=frozenset(effects))


NONE = (Lab(), Lab())


def null_situations() -> Iterator[Situation]:
    """Nothing is wrong but numbers that a recalibration finds."""
    yield Situation("nothing", "null", NONE, _same(Answer(silent=True)))
    symmetric: dict[str, tuple[float, float]] = {
        "temperature_k": (1.05, 1.12),
        "braid_turns": (1.03, 0.93),
        "braid_contact_area_m2": (1.2, 0.8),
    }
    for number, factors in symmetric.items():
        # Only a product of it and numbers that are fitted anyway shows: nothing is left to name.
        known = Answer(silent=True, also=(SetupCause("plant_constant", number),))
        labs = _two(plant_factors=_each(number, factors))
        yield Situation(f"wrong_{number}", "null", labs, _same(known))
    known = Answer(silent=True, also=(SetupCause("clock_rate", "t_s"),))
    yield Situation("clock_of_all", "null", _two(time_rate=(0.005, 0.03)), _same(known))


def set_up_situations() -> Iterator[Situation]:
    """What is wired, typed or set otherwise than the plant file and the columns say."""
    for name, (small, large) in {"null_up": (0.02, 0.15), "null_down": (-0.05, -0.2)}.items():
        # Laps that are shifted to one side: what is left of a command u is exactly u - volts.
        laps = [{"overlap_fill_v": v, "overlap_vent_v": -v} for v in (small, large)]
        answers = _set_up("null_offset", "")
        yield Situation(name, "set_up", _two(truth=(laps[0], laps[1])),
                        _with(answers, equal=frozenset({"null_offset"})))  # fmt: skip
    place = "atmospheric_pressure_pa"
    yield Situation(
        "atmosphere_gauge_sensor",
        "set_up",
        _two(true_atmosphere_pa=(94e3, 80e3), sensor_is_gauge=(True, True)),
        _with(_set_up("plant_constant", place), beside=frozenset({"pressure_sensor_gain"})),
    )
    yield Situation(
        "atmosphere_absolute_sensor",
        "set_up",
        _two(true_atmosphere_pa=(98e3, 88e3)),
        _with(
            _set_up("plant_constant", place),
            beside=frozenset({"pressure_sensor_gain", "pressure_sensor_offset"}),
        ),
    )
    yield from _wrong_plant_numbers()
    yield from _wrong_columns()


def _wrong_plant_numbers() -> Iterator[Situation]:
    length = _set_up("plant_constant", "rest_length_m")
    short, long = (
        _two(plant_factors=_each("rest_length_m", f)) for f in ((0.99, 0.97), (1.01, 1.03))
    )
    yield Situation("rest_length_short", "set_up", short, length)
    # A file that is too long is the equation of a lost length.
    lost = _with(length, equal=frozenset({"end_cap"}))
    yield Situation("rest_length_long", "set_up", long, lost)
    braid = _two(plant_factors=_each("braid_length_m", (1.005, 1.03)))
    answers = _set_up("plant_constant", "braid_length_m")
    yield Situation("braid_length", "set_up", braid, answers)
    # The large one: the gauge's reading typed as absolute.
    supply = (
        Lab(plant_factors={"tank_pressure_pa": 0.93}), Lab(plant={"tank_pressure_pa": 340e3}),
    )  # fmt: skip
    answers = _set_up("plant_constant", "tank_pressure_pa")
    yield Situation("supply", "set_up", supply, answers)


def _wrong_columns() -> Iterator[Situation]:
    channels: tuple[Channel, ...] = ("valve_v", "pressure_pa", "position_m")
    for channel in channels:
        answer = Answer(
            setup=(SetupCause("sign", channel),), refusal=("sign", "invert", "negative", "opposite")
        )
        labs = _two(inverted=((channel,), (channel,)))
        yield Situation(f"sign_{channel}", "set_up", labs, _same(answer),
                        ({}, {"valve_deadband": 5}))  # fmt: skip
    yield Situation(
        "encoder_scale",
        "set_up",
        _two(position_scale=(1.03, 4.0)),
        _with(
            _set_up("scale", "position_m"),
            equal=frozenset({"encoder_scale"}),
            refusal=("scale", "unit", "travel", "stroke", "count", "longer", "limit"),
        ),
    )
    yield Situation(  # the small one: taken for absolute; the large one: the zero is added twice
        "gauge",
        "set_up",
        _two(pressure_zero_shift_pa=(-101.3e3, 101.3e3)),
        _with(
            _set_up("gauge", "pressure_pa"),
            equal=frozenset({"pressure_sensor_offset"}),
            refusal=("gauge", "absolute", "atmosphere", "vacuum"),
        ),
    )
    yield Situation(
        "decimated_command",
        "set_up",
        _two(decimation=(5, 20)),
        _with(
            _set_up("decimated_command", ""),
            beside=frozenset({"command_delay"}),
            refusal=("rate", "decimat", "held", "once in", "resampl", "Hz"),
        ),
    )


def time_situations() -> Iterator[Situation]:
    """Columns that do not belong to the same instant, and clocks that do not run alike."""
    shifts: dict[str, tuple[Channel, tuple[float, float]]] = {
        "pressure_late": ("pressure_pa", (1e-3, 5e-3)),
        "pressure_early": ("pressure_pa", (-2e-3, -5e-3)),
        "position_late": ("position_m", (2e-3, 5e-3)),
        "position_early": ("position_m", (-1e-3, -4e-3)),
        "command_late": ("valve_v", (1e-3, 3e-3)),
        "command_early": ("valve_v", (-1e-3, -5e-3)),
    }
    for name, (channel, late_s) in shifts.items():
        beside = {"pressure_late": {"pressure_sensor_lag"}}.get(name, set())
        equal = {"command_delay"} if name == "command_early" else set()
        skew = _set_up("skew", channel)
        answers = _with(skew, beside=frozenset(beside), equal=frozenset(equal))
        yield Situation(name, "time", _two(late_s=_each(channel, late_s)), answers)
    # Samples that are older than their stamp, at which the command acts: the command is early.
    small, large = ({"pressure_pa": s, "position_m": s} for s in (0.5e-3, 1.5e-3))
    early = _set_up("skew", "valve_v")
    yield Situation("stamps_late", "time", _two(late_s=(small, large)),
                    _with(early, equal=frozenset({"command_delay"})))  # fmt: skip
    clocks: dict[Channel, tuple[float, float]] = {
        "valve_v": (3e-4, 1e-3),
        "pressure_pa": (-3e-4, -1e-3),
    }
    for channel, rates in clocks.items():
        labs = _two(clock_rates=_each(channel, rates))
        yield Situation(f"clock_{channel}", "time", labs, _set_up("clock_rate", channel))


CHANGING = {
    "stiffness": ("stiffness", "stiffness_n_per_m", (-0.01, -0.04)),
    "friction": ("mu_k", "kinetic_friction_per_m", (-0.05, -0.15)),
    "valve_gain": ("valve_m2_per_v", "valve_gain_m2_per_v", (-0.02, -0.06)),
}
"""What changes: the number's name in the truth and in the plant file, and the shares."""


def change_situations() -> Iterator[Situation]:
    """Numbers that drift within or between the records, or change at an instant."""
    for name, (mine, theirs, shares) in CHANGING.items():
        drift = _set_up("drift", theirs)
        yield Situation(f"{name}_within", "change", _two(within=_each(mine, shares)),
                        _with(drift, equal=frozenset({"drift"})))  # fmt: skip
        yield Situation(f"{name}_between", "change", _two(between=_each(mine, shares)), drift)
    # To call it a leak is true as well: when it began is what has to be said.
    began = _set_up("change_at_instant", "chamber_leak")
    yield Situation("leak_from_half", "change",
                    _two(at_half=_each("chamber_leak_m2", (1e-8, 4e-8))),
                    _with(began, beside=frozenset({"chamber_leak"})))  # fmt: skip
    yield Situation("softer_from_half", "change",
                    _two(at_half_factors=_each("stiffness", (0.98, 0.93))),
                    _set_up("change_at_instant", "stiffness_n_per_m"))  # fmt: skip


def noise_situations() -> Iterator[Situation]:
    """The physics is right; the columns are not white around it."""

    def said(word: str, silent_large: bool = False) -> Answers:
        small = Answer(noise=(word,), silent=True)
        return small, replace(small, silent=silent_large)

    many: dict[str, tuple[Pair, Answers]] = {
        "filtered": (_two(filter_hz=(60.0, 30.0)), _same(Answer(noise=("filtered",)))),
        "hum": (
            _two(hum_hz=(50.0, 60.0), hum_pa=(400.0, 3000.0), hum_m=(0.0, 20e-6)), said("hum"),
        ),
        "spikes": (
            _two(spikes=(0.002, 0.002), spike_pa=(8e3, 60e3), spike_m=(0.0, 0.3e-3)),
            said("outliers"),
        ),
        "dropouts": (_two(dropouts=(0.001, 0.005)), said("dropouts")),
        "noise_with_flow": (_two(noise_with_flow=(1.0, 4.0)), said("flow", silent_large=True)),
        "wander": (_two(wander_pa=(500.0, 2000.0)), said("wander", silent_large=True)),
        "coarse": (_two(adc_bits=(10, 8)), said("coarse", silent_large=True)),
        "stamp_jitter": (_two(jittered_stamps_s=(0.1e-3, 0.5e-3)), said("jitter")),
    }  # fmt: skip
    for name, (labs, answers) in many.items():
        yield Situation(name, "noise", labs, answers)
    deadband: Effects = {"valve_deadband": 5}
    for name in ("filtered", "hum", "spikes", "noise_with_flow"):
        yield Situation(f"deadband_with_{name}", "mixed", many[name][0],
                        _same(_name("valve_deadband")), (deadband, deadband))  # fmt: skip


def edge_situations() -> Iterator[Situation]:
    """No cliff: a large effect beside one that is hardly there, and a tank that runs empty."""
    deadband = _name("valve_deadband")
    small, large = ({"valve_deadband": 5, "dead_volume": size} for size in (0.1, 0.5))
    yield Situation("deadband_and_dead_volume", "edge", NONE, _same(deadband), (small, large))
    small, large = ({"valve_deadband": 5, "valve_spool": size} for size in (0.5, 3))
    both = _name("valve_deadband", "valve_spool")
    yield Situation("deadband_and_spool", "edge", NONE, (deadband, both), (small, large))
    tanks = _two(
        truth=(
            {"regulator_pa_s_per_kg": 2e7, "tank_m3": 5e-3},
            {"regulator_pa_s_per_kg": 4e7, "tank_m3": 1e-3},
        )
    )
    yield Situation("finite_tank", "edge", tanks, _same(_name("supply_droop")))


def unknown_situations() -> Iterator[Situation]:
    """What no catalogue has, or had once: no name is right, or the one that has come since."""
    small, large = ({"stop_m": 14e-3, "stop_n_per_m": k} for k in (900.0, 3000.0))
    yield Situation("second_spring", "unknown", _two(truth=(small, large)),
                    _same(Answer(unknown=True)))  # fmt: skip
    yield Situation("sensor_bow", "unknown", _two(pressure_bow=(0.005, 0.02)),
                    _set_up("bow", "pressure_pa"))  # fmt: skip
    for name, called in CALLED.items():
        if name != "hysteretic_spring":
            yield Situation(name, "unknown", NONE, _same(_name(called)), ({name: 3}, {name: 10}))


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
