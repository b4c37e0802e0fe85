"""The rigs of all suites with their truths in one form: whole suites, and a short list of all."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import yaml

from hidden.ball_screw_drive import BallScrewCase, ball_screw_cases
from hidden.dirty import DirtyRig
from hidden.effects import CALLED, OUT_OF_CATALOGUE, SINGLES
from hidden.examination import cases as suite
from hidden.examination.cases import PAIRS, Case, plant_on_paper
from hidden.examination.oracle import SURE, oracle_of
from hidden.hostile.lab import FITTED
from hidden.hostile.misread import NULLS, NullCase
from hidden.hostile.situations import HostileCase, Situation, all_cases, all_situations
from hidden.hostile.visible import is_hopeless
from hidden.rig import Record
from hidden.rungs import (
    NAMES,
    RUNGS,
    Cause,
    Rung,
    Said,
    Where,
    carried_rung,
    find_twins,
    named_cause,
    where_of,
)
from hidden.uncatalogued import UNCATALOGUED
from pamctl.plant.model import PlantSettings

Handed = tuple[list[Record], list[Record]]
Made = tuple[Handed, Mapping[str, Any]]
"""Records to fit and to judge by, and the plant file's content."""

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = "short"


@dataclass(frozen=True)
class ScoredCase:
    """One rig of the list: how it is made, and what is true of it."""

    key: str
    group: str
    make: Callable[[], Made]
    find_causes: Callable[[], list[Cause]]
    ignored: frozenset[str] = frozenset(f"plant_constant.{name}" for name in FITTED)
    """Numbers that are off by a few per cent in every rig: to find them is never false."""
    refusal: tuple[str, ...] = field(default=())
    """Refused for a reason that holds one of these words, it is right."""
    without: tuple[str, ...] = ()
    """Names that are taken out of the catalogue."""

    @property
    def causes(self) -> list[Cause]:
        """What is really there."""
        return self.find_causes()

    def correct_verdict(self, verdict: str, said: Said) -> str:
        """Return the verdict, where a refusal may be the right one."""
        if any(re.search(word, said.refusal, re.IGNORECASE) for word in self.refusal):
            return "right at name"
        return verdict


def draw_list(seed: int) -> list[ScoredCase]:
    """Return the 24 cases of a seed; consecutive seeds go round all effects and situations."""
    return [
        *_singles(seed), *_halves(seed), *_pairs(seed), *_nulls(seed), *_hostile(seed),
        *_dirty(seed), *_uncatalogued(seed), *_measured(),
    ]  # fmt: skip


def draw_nulls(seed: int) -> list[ScoredCase]:
    """Return the thirty ways to read a healthy rig badly."""
    return [_misread(kind, seed) for kind in NULLS]


def draw_hostile(seed: int) -> list[ScoredCase]:
    """Return each situation of a laboratory at two sizes over three excitations."""
    return [_hostile_case(c.situation, c.size, c.excitation, seed) for c in all_cases()]


def draw_suite(seed: int) -> list[ScoredCase]:
    """Return all hidden rigs: nulls, each effect at three sizes, pairs, unknown and bad ones."""
    return [
        *map(_suite_case, suite.all_cases(repeat=seed)),
        *map(_on_ball_screw, ball_screw_cases()),
    ]


def draw_quick(seed: int) -> list[ScoredCase]:
    """Return a few of everything in that suite, for minutes."""
    return [*map(_suite_case, suite.quick_cases(seed))]


LISTS = {
    "short": draw_list, "nulls": draw_nulls, "hostile": draw_hostile, "suite": draw_suite,
    "quick": draw_quick,
}  # fmt: skip

CATALOGUE = (*SINGLES, *CALLED, "slewing_driver")
TO_CATALOGUE = {**CALLED, "slewing_driver": "valve_slew"}
SAME_SETUP = {
    "encoder_scale": "scale.position_m",
    "command_delay": "skew.valve_v",
    "end_cap": "plant_constant.rest_length_m",
}
"""Effects that are a fault of the set-up in other words, by the equations: either word is right."""
STRIDE = 11
"""Neighbours in a table are alike: one list should hold unlike ones."""


def _in_turn(names: Collection[str], seed: int, count: int) -> list[str]:
    every = [*names]
    return [every[STRIDE * (count * seed + k) % len(every)] for k in range(count)]


def _hidden_case(kind: str, name: str, effects: dict[str, float], seed: int) -> ScoredCase:
    case = Case(f"{kind}/{name}", kind, {**effects}, program=PROGRAM, repeat=seed,
                encoder_homed="external_load" not in effects)  # fmt: skip

    return ScoredCase(f"{case.id}#{seed}", kind, partial(_make, case),
                      partial(_hidden_causes, effects))  # fmt: skip


class _Drawn(Protocol):
    """A case of any suite."""

    def records(self) -> Handed:
        """Return the records to fit, and those to judge by."""

    def start_plant(self) -> PlantSettings:
        """Return the user's plant file."""


def _make(case: _Drawn) -> Made:
    return case.records(), case.start_plant().model_dump()


def _hidden_causes(effects: dict[str, float]) -> list[Cause]:
    return [_cause_of(effect, size, PROGRAM) for effect, size in effects.items()]


def _cause_of(effect: str, multiple: float, program: str) -> Cause:
    name = TO_CATALOGUE.get(effect, effect)
    also = [SAME_SETUP[name]] if name in SAME_SETUP else []
    return named_cause(name, carried_rung(name, multiple, program), *also)


def _suite_case(case: Case) -> ScoredCase:
    key = f"{case.id}#{case.repeat}@{case.program}"
    refusal = (".",) if case.group == "bad" else ()
    return ScoredCase(key, case.group, partial(_make, case), partial(_suite_causes, case),
                      refusal=refusal, without=case.removed)  # fmt: skip


def _suite_causes(case: Case) -> list[Cause]:
    causes = []
    for effect, size in case.effects.items():
        multiple = size[0] if isinstance(size, tuple) else size
        if effect in OUT_OF_CATALOGUE:
            causes.append(_unnamed_cause(effect))
        elif effect in case.removed:
            causes.append(_removed_cause(effect, multiple, case.program))
        elif case.group in ("blind", "bad") or effect == "moving_mass":  # the mass is fitted
            causes.append(named_cause(effect, "none"))
        else:
            causes.append(_cause_of(effect, multiple, case.program))
    if case.group == "bad":  # to refuse it is all that is right
        causes.append(Cause(case.damage, frozenset(), "name"))
    return causes


def _removed_cause(name: str, multiple: float, program: str) -> Cause:
    """Return what is left to say of an effect without its name: its place, or a twin's name."""
    rung = min(carried_rung(name, multiple, program), "place", key=RUNGS.index)
    twins = find_twins(name, multiple, program) if rung != "none" else frozenset[str]()
    also = {SAME_SETUP[name]} if name in SAME_SETUP else set[str]()
    return Cause(f"{name}, unnamed", where_of(name), rung, twins | also)


def _on_ball_screw(case: BallScrewCase) -> ScoredCase:
    causes = [named_cause(name) for name in sorted(case.names)]
    causes.append(named_cause("external_load", "none"))
    return ScoredCase(case.id, "ball_screw", partial(_make, case), partial(list, causes))


def _singles(seed: int) -> Iterator[ScoredCase]:
    """Size 1 and 3 in turn; 3 where nobody could see 1."""
    for k, name in enumerate(_in_turn(CATALOGUE, seed, 6)):
        alone = oracle_of(PROGRAM).get(name, {}).get("1", {}).get("alone", 0.0)
        size = 1.0 if k % 2 == 0 and alone >= SURE else 3.0
        yield _hidden_case("single", f"{name}/{size:g}", {name: size}, seed)


def _halves(seed: int) -> Iterator[ScoredCase]:
    """Half of the smallest size of interest, where that is still well visible."""
    visible = [n for n in SINGLES if oracle_of(PROGRAM)[n]["1"]["alone"] >= 4.0 * SURE]
    for name in _in_turn(visible, seed, 2):
        yield _hidden_case("half", f"{name}/0.5", {name: 0.5}, seed)


def _pairs(seed: int) -> Iterator[ScoredCase]:
    for name in [*PAIRS][2 * seed % len(PAIRS) :][:2]:
        yield _hidden_case("pair", name, {n: float(s) for n, s in PAIRS[name].items()}, seed)  # type: ignore[arg-type]


def _nulls(seed: int) -> Iterator[ScoredCase]:
    yield _hidden_case("null", "parameters", {}, seed)
    for kind in _in_turn(NULLS, seed, 2):
        yield _misread(kind, seed)


def _misread(kind: str, seed: int) -> ScoredCase:
    case = NullCase(kind, seed)
    return ScoredCase(f"misread/{case.key}", "null", partial(_make, case),
                      partial(_misreadings, kind))  # fmt: skip


def _misreadings(kind: str) -> list[Cause]:
    """Of a zero that wanders, a filter, a clock: that it is said is true, and not asked."""
    lab, there = NULLS[kind], set[Where]()
    there |= {("pressure_sensor", "time"), ("pressure_sensor", "curve")} if lab.wander_pa else set()
    there |= {("pressure_sensor", "lag")} if lab.filter_hz else set()
    names = frozenset({"clock_rate.t_s"} if lab.time_rate else ())
    return [Cause(kind, frozenset(there), "none", names)] if there or names else []


@dataclass(frozen=True)
class _DrawnHostile(HostileCase):
    draw: int

    @property
    def seed(self) -> int:
        """Another rig for each draw of a case."""
        return super().seed + 1009 * self.draw


def _hostile(seed: int) -> Iterator[ScoredCase]:
    """Large situations in turn, one in the open loop and one at random levels or in closed loop."""
    situations = {s.name: s for s in all_situations() if s.group not in ("null", "noise")}
    ways = ("open", ("closed", "random")[seed % 2])
    for way, name in zip(ways, _in_turn(situations, seed, 2), strict=True):
        yield _hostile_case(situations[name], "large", way, seed)


def _hostile_case(situation: Situation, size: str, excitation: str, seed: int) -> ScoredCase:
    case = _DrawnHostile(situation, size, excitation, seed)
    return ScoredCase(f"hostile/{case.id}#{seed}", situation.group, partial(_make, case),
                      partial(_hostile_causes, case), refusal=case.answer.refusal)  # fmt: skip


def _hostile_causes(case: HostileCase) -> list[Cause]:
    answer, causes = case.answer, []
    is_free = answer.silent or is_hopeless(case)
    for effect in {**dict.fromkeys(answer.effects), **case.effects}:
        rung: Rung = "name" if effect in answer.effects and not is_free else "none"
        causes.append(named_cause(TO_CATALOGUE.get(effect, effect), rung))
    for c in (*answer.setup, *answer.also):
        label = f"{c.kind}.{c.number or 'command'}"
        is_asked = c in answer.setup and not is_free and c.number not in FITTED
        causes.append(Cause(label, where_of(label), "name" if is_asked else "none",
                            frozenset({label, *answer.equal})))  # fmt: skip
    causes += [named_cause(name, "none") for name in answer.beside]
    for word in answer.noise:
        label = f"noise.{word}"
        causes.append(Cause(label, frozenset(), "none" if is_free else "name", frozenset({label})))
    if answer.unknown:  # the one without a name: a spring that engages late
        causes.append(Cause("second_spring", frozenset({("force", "curve")}), "place"))
    return causes


def _dirty(seed: int) -> Iterator[ScoredCase]:
    """Three muscles with an effect, one without, and a carriage."""
    rigs = [DirtyRig(4 * seed + k, is_hidden=k != 3) for k in range(4)]
    for rig in (*rigs, DirtyRig(seed, actuator="direct")):
        beside = rig.effect if rig.is_hidden else "none"
        yield ScoredCase(f"dirty/{rig.actuator}/{beside}#{rig.seed}", "dirty",
                         partial(_make, rig), partial(getattr, rig, "causes"))  # fmt: skip


TERM_WHERE: dict[str, str] = {
    "braid_friction": "friction", "damping": "friction", "force": "force", "pull": "force",
    "stiffness": "force", "supply": "supply", "opening": "valve", "exhausting": "valve",
    "command": "valve", "volume": "chamber", "encoder": "encoder",
    "pressure_sensor": "pressure_sensor",
}  # fmt: skip


def _uncatalogued(seed: int) -> Iterator[ScoredCase]:
    """Truths that no catalogue has; their place is asked, at any kind of the right driver."""
    truths = {t.name: t for t in UNCATALOGUED if not t.called}
    for name in _in_turn(truths, seed, 2):
        cause = _unnamed_cause(name)
        yield ScoredCase(f"uncatalogued/{name}#{seed}", "uncatalogued",
                         partial(_beyond_catalogue, name, seed),
                         partial(list, [cause]))  # fmt: skip


def _unnamed_cause(name: str) -> Cause:
    where: set[Where] = {
        (TERM_WHERE[place], "time" if driver == "time" else "curve")
        for place, driver in next(t for t in UNCATALOGUED if t.name == name).right
    }
    return Cause(name, frozenset(where), "place")


def _beyond_catalogue(name: str, seed: int) -> Made:
    truth = next(t for t in UNCATALOGUED if t.name == name)
    return truth.record(PROGRAM, seed), plant_on_paper().model_dump()


def _measured() -> Iterator[ScoredCase]:
    """Two seals on a test bench: dry friction that grows with pressure."""
    for name in ("zillen_napn", "zillen_o_ring"):
        yield ScoredCase(f"measured/{name}", "measured", partial(_from_bench, name), _seal_causes)


def _seal_causes() -> list[Cause]:
    """What a hand fit shows must be said; other friction of a seal may be there as well."""
    friction = frozenset(name for name, where in NAMES.items() if ("friction", "curve") in where)
    return [
        named_cause("pressure_friction"),
        Cause("seal", frozenset({("friction", "curve"), ("friction", "memory")}), "none",
              friction | {"presliding"}),
        named_cause("piston", "none"),
    ]  # fmt: skip


def _from_bench(name: str) -> Made:
    """Import the files as a user does; each part is records."""
    from measured_set import VARIABLE, SetRefused, read_set, write_pieces

    from pamctl.diagnose import record_of

    stated = os.environ.get(VARIABLE)
    measured = read_set(ROOT / "tests/real_data" / name, Path(stated) if stated else None)
    if measured.missing:
        raise SetRefused(
            f"{name}: no {', '.join(measured.missing)}; state the folder by {VARIABLE}"
        )
    with tempfile.TemporaryDirectory() as folder:
        parts = {
            part: [record_of(import_file(path, measured.folder / "map.yaml")) for path in paths]
            for part, paths in write_pieces(measured, Path(folder)).items()
        }
    plant = yaml.safe_load((measured.folder / "plant.yaml").read_text(encoding="utf-8"))
    made = {part: [Record(r.name, r.t_s, r.valve_v, r.pressure_pa, r.position_m, r.force_n)
                   for r in records] for part, records in parts.items()}  # fmt: skip
    return (made["fitted"], [*made["chosen"], *made["confirmed"]]), plant


def import_file(path: Path, column_map: Path) -> Path:
    """Import a file by the command line; return the log."""
    log = path.with_suffix(".mcap")
    command = [sys.executable, "-m", "pamctl", "log", "import", path, log, "--map", column_map]
    subprocess.run([*map(str, command)], check=True, capture_output=True, cwd=ROOT)
    return log
