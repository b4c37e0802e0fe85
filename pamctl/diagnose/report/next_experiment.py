"""The questions that the records leave open, and the experiment that would answer more."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d
from scipy.signal import find_peaks

from pamctl.diagnose.audit import find_separating_experiment, find_showing_experiment
from pamctl.diagnose.deciding_program import DecidingProgram, Separation
from pamctl.diagnose.diagnosis import Diagnosis, Verdict
from pamctl.diagnose.drawn_programs import sample_commands
from pamctl.diagnose.evidence.constants import LEFT_TIMES
from pamctl.diagnose.record import Record
from pamctl.diagnose.report.finding_words import list_ambiguous, spell_names
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.model import PlantSettings
from pamctl.settings.yaml12 import dump_yaml

_SQUARES = (
    "steps of the full command up and down, each held until the pressure rests",
    "steps of the driving force to and fro, each held until the axis rests",
)
MOTIONS: Mapping[str, tuple[str, str]] = {
    "chirp": (
        "a sine of the command whose frequency rises until the pressure hardly follows",
        "a sine of the driving force whose frequency rises until the position hardly follows",
    ),
    "diagnosis": (
        "one long record with steps of several sizes, slow ramps, holds and a sine of rising "
        "frequency of the command",
        "one long record with motions at several speeds both ways, reversals, holds and a sine of "
        "rising frequency",
    ),
    "again": ("the same motion once more, from the same rest",) * 2,
    "fill-and-hold": (
        "fill to several pressures, close the valve, and wait some 10 s each time",
        "hold the axis still at several loads, some 10 s each time",
    ),
    "long-holds": (
        "steps of the pressure, each held for a minute",
        "steps of the driving force, each held for a minute",
    ),
    "multisine-small": (
        "sines of several frequencies at once, with a small command around the valve's null",
        "sines of several frequencies at once, with a small driving force",
    ),
    "null-staircase": (
        "a staircase of small commands on both sides of the valve's null",
        "a staircase of small driving forces both ways, from rest",
    ),
    "slow-ramps": (
        "slow ramps of the pressure up and down, with reversals on the way",
        "slow motions to and fro at several speeds, with reversals on the way",
    ),
    "square-1": _SQUARES,
    "squares-apart": _SQUARES,
}
"""What to record instead of an experiment: behind a valve, and on a mechanism without one."""
_RUNS_AWAY = ("long-holds", "square-1", "squares-apart")
"""Experiments that hold a force: what no spring stops runs away."""
_PUSHES = "short pushes of the driving force to and fro, each stopped by one the other way"


def write_advice(
    experiment: str, plant: PlantSettings, *, runs_here: bool, has_pressure: bool = False
) -> str:
    """Write the command that runs an experiment, or what to record where pamctl does not run it."""
    if runs_here or not experiment:
        return write_command(experiment)
    named = f"a run like the experiment {experiment}"
    behind_valve, on_axis = MOTIONS.get(experiment, (named, named))
    if experiment in _RUNS_AWAY and plant.parameters.stiffness_n_per_m == 0.0:
        on_axis = _PUSHES
    if has_pressure:
        on_axis += "; at several pressures"
    return f"record: {on_axis if plant.actuator == 'direct' else behind_valve}"


def write_command(experiment: str, *, by_daemon: bool = False) -> str:
    """Write the command that runs an experiment; "none" where there is none."""
    verb = "start" if by_daemon else "run --experiment"
    return f"pamctl {verb} {experiment}" if experiment else "none"


NEXT_EXPERIMENT = "next-experiment"
"""The name of the program that was chosen; its file is beside the page."""
NEXT_COMMANDS = f"{NEXT_EXPERIMENT}.csv"
"""The file of its commands, for a system that pamctl does not run."""
NEARLY_SEEN = 3.0
"""An effect visible from this many smallest sizes on needs no other experiment."""


def list_blind_spots(diagnosis: Diagnosis) -> list[dict[str, object]]:
    """Return the effects that these records could not have shown."""
    audit = diagnosis.audit
    return [spot.as_dict() for spot in audit.blind_spots] if audit else []


def choose_next_experiment(diagnosis: Diagnosis) -> dict[str, Any] | None:
    """Return the experiment that would answer more, if there is one.

    `do` is the command that runs it, or says what to record on a rig that pamctl does not run.
    """
    if diagnosis.deciding is not None:
        run = advise_experiment(diagnosis, f"{NEXT_EXPERIMENT}.yaml")
        if not runs_here(diagnosis):
            run = (
                f"play {NEXT_COMMANDS}, the valve's command over time, and record as before. Each "
                "row holds until the next. The commands are -5 to 5 V: where your map has a gain "
                "or an offset, your card needs (command - offset) / gain"
            )
        return {**_describe_program(diagnosis.deciding), "do": run}
    experiment = _choose_experiment(diagnosis)
    if experiment is None:
        return None
    return {**experiment, "do": advise_experiment(diagnosis, str(experiment["name"]))}


def _choose_experiment(diagnosis: Diagnosis) -> dict[str, Any] | None:
    for members in list_ambiguous(diagnosis):
        effects = [name for name in members if name in CATALOGUE]
        if len(effects) > 1:
            return find_separating_experiment(effects)
    said = {f.level for f in diagnosis.findings}
    if diagnosis.verdict is Verdict.NONE_KNOWN or said & {"kind", "place", "set"}:
        why, is_own = "a full program asks every law at every speed and pressure", True
        if any(holds_full_program(record) for record in diagnosis.train):
            is_own = runs_here(diagnosis) or diagnosis.is_of_daemon
            why = "the records have motions of every kind, and more kinds promise nothing: one "
            why += "that is repeated shows how much of what is left comes again"
        return {"name": "diagnosis" if is_own else "again", "separates": [], "why": why}
    spots = [s for s in diagnosis.audit.blind_spots if s.experiment] if diagnosis.audit else []
    hidden = max(spots, key=lambda s: s.sizes, default=None)
    return find_showing_experiment(hidden.name) if hidden and hidden.sizes > NEARLY_SEEN else None


STILL_S, STILL, SWING = 0.3, 0.005, 0.05
"""A signal rests that moves by less than this share of its span in this time; it turns where it
swings by more than that share."""
FEWEST_RESTS, FEWEST_TURNS, UNLIKE = 4, 35, 30.0
"""Of a full program: tenths of the span with rests, turns, and by which factor the slowest stroke
lasts longer than quick ones, of which a tenth is quicker."""


def holds_full_program(record: Record) -> bool:
    """Tell whether the position, or else the pressure, has rests, slow strokes and quick ones."""
    rows = (record.position_m, record.pressure_pa, record.valve_v)
    values = next(row for row in rows if row is not None)
    window, span = max(1, round(STILL_S / record.period_s)), float(np.ptp(values))
    still = maximum_filter1d(values, window) - minimum_filter1d(values, window) <= STILL * span
    rising = 1e-9 * span * np.arange(len(values))  # of equal peaks the last one counts
    sides = (values + rising, rising - values)
    ends = [find_peaks(side, prominence=SWING * span)[0] for side in sides]
    strokes = np.diff(np.sort(np.concatenate(ends)))
    return (
        len(np.unique(np.round(10.0 * values[still] / (span or 1.0)))) >= FEWEST_RESTS
        and len(strokes) >= FEWEST_TURNS
        and float(strokes.max()) >= UNLIKE * float(np.quantile(strokes, 0.1))
    )


def _describe_program(chosen: DecidingProgram) -> dict[str, Any]:
    """Return the entry of a program that was chosen by simulation."""
    forecast, experiment = chosen.forecast, chosen.to_experiment()
    experiment.pop("forecast", None)
    return {
        "name": NEXT_EXPERIMENT,
        "separates": [*chosen.explanations],
        "why": explain_choice(chosen),
        "promises": chosen.promises,
        "expected": forecast["pairs"],
        "needs": {
            "duration_s": round(chosen.duration_s, 3),
            "pressure_kpa": forecast["pressure_kpa"],
            "low_mm": forecast["low_mm"],
            "high_mm": forecast["high_mm"],
            "limits_from": chosen.limits_from,
        },
        "drawn": chosen.drawn,
        "inside_limits": chosen.inside,
        "program": experiment,
    }


def spell_next(experiment: Mapping[str, Any]) -> str:
    """Return a line with what to do next: a command and a remark, or what to record, and why."""
    do = experiment["do"]
    apart = f"it {told}" if (told := tell_apart_surely(experiment)) else experiment["why"]
    if do.startswith("pamctl"):
        return f"next: {do}  # {apart}"
    return f"next {'' if do.startswith('record:') else 'step: '}{do}. Why: {apart}"


def tell_apart_surely(experiment: Mapping[str, Any]) -> str:
    """Say which explanations an experiment tells apart; empty where it does not promise to."""
    effects = experiment["separates"]
    is_sure = len(effects) > 1 and experiment.get("promises", True)
    return tell_apart(effects) if is_sure else ""


_MOST_NAMES = 3
"""Parts of an explanation that a sentence names; more cannot be read."""


def tell_apart(explanations: Sequence[str]) -> str:
    """Say which explanations an experiment tells apart; those of several parts as a list."""
    names = name_apart(explanations, "; ").split("; ")
    if len(names) == 2 and not any(" and " in name for name in names):
        return f"tells {' from '.join(names)}"
    return f"tells apart {'; '.join(f'({n}) {name}' for n, name in enumerate(names, 1))}"


def name_apart(explanations: Sequence[str], joint: str = " from ") -> str:
    """Return explanations as nouns, without what all of them have in common.

    Of many parts come first those that the fewest of the others have.
    """
    sets = [name.split(" and ") for name in explanations]
    shared = set(sets[0]).intersection(*sets)
    named = []
    for parts in sets:
        own = [part for part in parts if part not in shared]
        own.sort(key=lambda part: sum(part in others for others in sets))
        nouns = [spell_names(part) for part in own[:_MOST_NAMES]]
        nouns += [f"{len(own) - _MOST_NAMES} more"] * (len(own) > _MOST_NAMES)
        named.append(" and ".join(filter(None, [", ".join(nouns[:-1]), *nouns[-1:]])))
    return joint.join(name or "nothing more" for name in named)


def explain_choice(chosen: DecidingProgram) -> str:
    """Say what the program is expected to show, and against how many others it was chosen."""
    of = f"the best of {chosen.drawn} programs, of which {chosen.inside} stay within the limits"
    least = _describe_separation(chosen.nearest)
    if chosen.promises:
        return f"{least} ({of})"
    return f"no program is sure to decide, and this one comes nearest ({of}): {least}"


def _describe_separation(s: Separation) -> str:
    pair = name_apart([s.true, s.refuted], " is true, ")
    return (
        f"if {pair} should leave {s.residual_over_floor:.3g} times the floor of the {s.block} block"
    )


def format_experiment_file(chosen: DecidingProgram, logs: Sequence[str]) -> str:
    """Write the program as an experiment file, what it needs and what is expected as comments."""
    head = "".join(f"# {line}\n" for line in _list_head_lines(chosen, logs))
    return head + dump_yaml(chosen.to_experiment())


def _list_head_lines(chosen: DecidingProgram, logs: Sequence[str]) -> Iterator[str]:
    yield f"Written by `pamctl diagnose` from {', '.join(logs)}."
    yield f"It is to decide between: {name_apart([*chosen.explanations], '; ')}."
    yield (
        f"{chosen.duration_s:.1f} s, open loop, from the vented muscle at rest. By the fitted "
        f"models it needs up to {1e-3 * chosen.pressure_pa:.0f} kPa absolute and moves from "
        f"{1e3 * chosen.low_m:.1f} to {1e3 * chosen.high_m:.1f} mm ({chosen.limits_from} hold)."
    )
    why = explain_choice(chosen)
    yield f"{why[:1].upper()}{why[1:]}."


def format_commands(chosen: DecidingProgram, period_s: float) -> str:
    """Write the program's commands as CSV: a row where the command changes, and the last tick."""
    commands_v = sample_commands(chosen.program, period_s)
    changes = np.flatnonzero(np.diff(commands_v, prepend=np.nan))
    ticks = [*changes.tolist(), len(commands_v) - 1]
    rows = (f"{tick * period_s:.6g},{commands_v[tick]:.6g}" for tick in dict.fromkeys(ticks))
    return "\n".join(["t_s,valve_v", *rows, ""])


class RigWords(NamedTuple):
    """What texts call a rig and its parts."""

    start_model: str
    suspects: str
    """Where to look for what no effect explains."""
    begin: str
    """How a record should begin."""


_OF_ACTUATOR: Mapping[str, RigWords] = {
    "muscle": RigWords(
        "the paper's muscle and valve",
        "supply, tubing, mounting, sensors",
        "with the muscle vented and at rest",
    ),
    "direct": RigWords(
        "a mechanism that a measured force drives",
        "guides, mounting, the drive, sensors",
        "at rest",
    ),
    "cylinder": RigWords(
        "a cylinder with a piston behind a valve",
        "supply, tubing, seals, guides, sensors",
        "with the cylinder vented and at rest",
    ),
    "chamber": RigWords(
        "a chamber of constant volume behind a valve",
        "supply, tubing, leaks, sensors",
        "with the chamber vented",
    ),
}


def words_of_rig(diagnosis: Diagnosis) -> RigWords:
    """Return the words for the actuator of the start model."""
    return _OF_ACTUATOR[diagnosis.nominal.actuator]


def runs_here(diagnosis: Diagnosis) -> bool:
    """Tell whether `pamctl run` moves this rig: a muscle whose records pamctl made."""
    imported = any(record.is_imported for record in (*diagnosis.train, *diagnosis.holdout))
    return diagnosis.nominal.actuator == "muscle" and not imported


def advise_experiment(diagnosis: Diagnosis, experiment: str) -> str:
    """Write the command for an experiment, or what to record on a rig that pamctl does not run."""
    if diagnosis.is_of_daemon:
        return write_command(experiment, by_daemon=True)
    return write_advice(
        experiment,
        diagnosis.nominal,
        runs_here=runs_here(diagnosis),
        has_pressure=all(record.pressure_pa is not None for record in diagnosis.train),
    )


def advise_own_plant(diagnosis: Diagnosis) -> str:
    """Advise a plant file where the paper's muscle does not explain another's records."""
    left = diagnosis.evidence.left_over_noise if diagnosis.evidence else {}
    is_papers = diagnosis.nominal == PlantSettings()
    if runs_here(diagnosis) or not is_papers or max(left.values(), default=0.0) <= LEFT_TIMES:
        return ""
    return (
        "the start model was the paper's muscle; if your rig is another, first write its plant "
        "file, `pamctl plant new --from FILE --out rig.yaml`, and give it with --plant"
    )
