"""Refuse data that would mislead the diagnosis; say why, and what to do.

Data of which nothing can be computed are refused in any case. What a rule of `quality_rules`
doubts is refused unless the user accepts that rule, with a reason.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches

import numpy as np

from pamctl.diagnose.measured.noise.sensor_noise import Noise
from pamctl.diagnose.measured.quality_rules import (
    FEWEST_SAMPLES,
    RULES,
    Doubt,
    doubt_excitation,
    doubt_record,
    doubt_sensors,
)
from pamctl.diagnose.measured.record import Record
from pamctl.exit_codes import ExitCode
from pamctl.plant.model import PlantSettings


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
            near = get_close_matches(rule, RULES, 1)
            hint = f"; did you mean {near[0]}?" if near else ""
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
    records: Sequence[Record], plant: PlantSettings, accepted: Mapping[str, str] | None = None
) -> tuple[AcceptedDoubt, ...]:
    """Raise `BadData` with every reason found, a line each; return the doubts that are accepted."""
    faults = [fault for record in records for fault in _find_faults(record)]
    faults += _find_different_channels(records)
    if faults:
        raise BadData("\n".join(dict.fromkeys(faults)))
    doubts = [doubt for record in records for doubt in doubt_record(record, plant)]
    known = accepted or {}
    if all(doubt.rule in known for doubt in doubts):
        doubts += doubt_excitation(records, plant)
    return _judge_doubts(doubts, known)


def check_sensors(
    records: Sequence[Record],
    noises: Mapping[str, Noise],
    plant: PlantSettings,
    accepted: Mapping[str, str] | None = None,
) -> tuple[AcceptedDoubt, ...]:
    """Raise `BadData` for clipped and shifted channels; return the doubts that are accepted."""
    doubts = [doubt for record in records for doubt in doubt_sensors(record, plant, noises)]
    return _judge_doubts(doubts, accepted or {})


def _judge_doubts(
    doubts: Sequence[Doubt], accepted: Mapping[str, str]
) -> tuple[AcceptedDoubt, ...]:
    refused = [d for d in doubts if d.rule not in accepted]
    if refused:
        reasons = (
            f"{doubt.text} (if it is right as it is: --accept {doubt.rule}=REASON)"
            for doubt in refused
        )
        raise BadData("\n".join(dict.fromkeys(reasons)))
    found: dict[str, list[str]] = {}
    for doubt in doubts:
        found.setdefault(doubt.rule, []).append(doubt.text)
    return tuple(
        AcceptedDoubt(rule, accepted[rule], tuple(dict.fromkeys(texts)))
        for rule, texts in found.items()
    )


def _find_faults(record: Record) -> Iterator[str]:
    """Find what no reason can mend: nothing could be computed."""
    if len(record) < FEWEST_SAMPLES:
        yield (
            f"{record.name}: {len(record)} samples, fewer than {FEWEST_SAMPLES}; "
            "record a whole excitation"
        )
        return
    for channel in record.channels:
        wrong = ~np.isfinite(record[channel])
        if wrong.any():
            yield (
                f"{record.name}: {channel} is NaN or infinite in {int(wrong.sum())} rows, "
                f"the first is row {int(np.argmax(wrong))}; remove or repair them"
            )
            return
    if not np.isfinite(record.t_s).all() or np.any(record.step_s <= 0.0):
        row = int(np.argmax(~(record.step_s > 0.0))) + 1
        yield f"{record.name}: t_s does not increase at row {row}; sort or repair the time column"


def _find_different_channels(records: Sequence[Record]) -> Iterator[str]:
    channels = {record.channels for record in records}
    if len(channels) > 1:
        listed = "; ".join(sorted({f"{r.name} has {', '.join(r.channels)}" for r in records}))
        yield f"the records do not hold the same channels: {listed}"
