"""Refuse data that would mislead the diagnosis; say why, and what to do.

Data of which nothing can be computed are refused in any case. What a rule doubts is refused unless
the user accepts that rule, with a reason, which the document keeps.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pamctl.base.errors import ExitCode, Problem
from pamctl.base.texts import count_of, hint_at_nearest
from pamctl.diagnose.record import Record, SensorFault
from pamctl.diagnose.record_doubts import (
    FEWEST_SAMPLES,
    doubt_actuator,
    doubt_excitation,
    doubt_record,
    doubt_sensors,
    list_used_channels,
)
from pamctl.plant.effects.description import describe_unused
from pamctl.plant.model import PlantSettings

RULES = (
    "actuator", "short", "gap", "coarse", "command_unit", "regulator", "pressure_unit",
    "position_unit", "position_sign", "clipped", "shifted", "still",
)  # fmt: skip
"""The rules by the names that `--accept` takes; the manual says what each doubts."""


def leave_out_unused(
    records: Sequence[Record], plant: PlantSettings
) -> tuple[list[Record], list[SensorFault]]:
    """Return the records without the channels that this plant's model does not read."""
    kept, faults = list[Record](), dict[str, SensorFault]()
    for record in records:
        unused = [c for c in record.channels if c not in list_used_channels(record, plant)]
        without: dict[str, Any] = dict.fromkeys(unused)
        if "valve_v" in unused:
            without |= {"acts_after_s": None, "held_v": None}
        kept.append(replace(record, **without) if unused else record)
        for channel in unused:
            says = describe_unused(channel, plant.actuator)
            faults[channel] = SensorFault(channel, "unused", says)
    return kept, [*faults.values()]


class BadData(Exception):
    """The measurement cannot be diagnosed; the message says why and what to do."""

    exit_code = ExitCode.BAD_DATA


class UnknownRule(Exception):
    """A rule is to be accepted that does not exist, or without a reason."""

    exit_code = ExitCode.USAGE


@dataclass(frozen=True)
class AcceptedDoubt:
    """What a rule doubts, and why the user accepts it."""

    rule: str
    reason: str
    """The user's words."""
    doubts: tuple[str, ...]
    """What the rule says of these data."""

    def as_dict(self) -> dict[str, object]:
        """Return what the document holds."""
        return {"rule": self.rule, "reason": self.reason, "doubts": list(self.doubts)}


def read_acceptances(texts: Iterable[str]) -> dict[str, str]:
    """Return reasons by rule from texts such as `gap=the logger paused`; raise `UnknownRule`."""
    accepted: dict[str, str] = {}
    for text in texts:
        rule, _, reason = (part.strip() for part in text.partition("="))
        if rule not in RULES:
            hint = hint_at_nearest(rule, RULES)
            raise UnknownRule(
                f"--accept {text}: there is no rule {rule!r}{hint} (rules: {', '.join(RULES)})"
            )
        if not reason:
            raise UnknownRule(
                f'--accept {text}: say why, such as --accept {rule}="seen and harmless"; '
                "the document keeps the reason"
            )
        accepted[rule] = reason
    return accepted


def check_measured_runs(
    records: Sequence[Record],
    plant: PlantSettings,
    accepted: Mapping[str, str] | None = None,
    given: Sequence[Record] = (),
) -> tuple[AcceptedDoubt, ...]:
    """Raise `BadData` with every reason found, a line each; return the doubts that are accepted.

    Whether the plant file is one of what was measured is asked first, of the records as they were
    `given`, with all their channels. What hardly varies is asked where units and times are right,
    and what is clipped or shifted where all that is.
    """
    if not records:
        raise BadData("no records; give at least one log")
    faults = [fault for record in records for fault in _find_faults(record)]
    faults += _find_different_channels(records)
    if faults:
        raise BadData("\n".join(dict.fromkeys(fault.sentence for fault in faults)))
    known = accepted or {}
    doubts = [doubt for record in given or records for doubt in doubt_actuator(record, plant)]
    if all(doubt.key in known for doubt in doubts):
        doubts += [doubt for record in records for doubt in doubt_record(record, plant)]
    if all(doubt.key in known for doubt in doubts):
        doubts += doubt_excitation(records, plant)
    if all(doubt.key in known for doubt in doubts):
        doubts += [doubt for record in records for doubt in doubt_sensors(record, plant)]
    return _judge_doubts(doubts, known)


def _judge_doubts(
    doubts: Sequence[Problem], accepted: Mapping[str, str]
) -> tuple[AcceptedDoubt, ...]:
    refused = [d for d in doubts if d.key not in accepted]
    if refused:
        reasons = (
            f"{doubt.sentence} (if it is right as it is: --accept {doubt.key}=REASON)"
            for doubt in refused
        )
        raise BadData("\n".join(dict.fromkeys(reasons)))
    found: dict[str, list[str]] = {}
    for doubt in doubts:
        found.setdefault(doubt.key, []).append(doubt.sentence)
    return tuple(
        AcceptedDoubt(rule, accepted[rule], tuple(dict.fromkeys(texts)))
        for rule, texts in found.items()
    )


def _find_faults(record: Record) -> Iterator[Problem]:
    """Find what no reason can mend: nothing could be computed."""
    if len(record) < FEWEST_SAMPLES:
        few = f"{count_of(len(record), 'sample')}, fewer than {FEWEST_SAMPLES}"
        yield Problem(record.name, "few", few, fix="record a whole excitation")
        return
    for channel in record.channels:
        wrong = ~np.isfinite(record[channel])
        if wrong.any():
            text = (
                f"{channel} is NaN or infinite in {count_of(int(wrong.sum()), 'row')}, "
                f"the first is row {int(np.argmax(wrong))}"
            )
            yield Problem(record.name, "not_finite", text, fix="remove or repair them")
            return
    if not np.isfinite(record.t_s).all() or np.any(record.step_s <= 0.0):
        row = int(np.argmax(~(record.step_s > 0.0))) + 1
        text, fix = f"t_s does not increase at row {row}", "sort or repair the time column"
        yield Problem(record.name, "time", text, fix=fix)


def _find_different_channels(records: Sequence[Record]) -> Iterator[Problem]:
    channels = {record.channels for record in records}
    if len(channels) > 1:
        listed = "; ".join(sorted({f"{r.name} has {', '.join(r.channels)}" for r in records}))
        text = f"the records do not hold the same channels: {listed}"
        yield Problem("", "channels", text, fix="give records with the same columns")
