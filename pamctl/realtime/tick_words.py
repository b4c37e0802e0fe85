"""The tick's numbers as machine code sees them, and the code between the two.

words  setup | state | times | place | wake, raw | given reference | results
row    the row of the ring, up to the outcome
table  the course
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import indent
from typing import Any, NamedTuple

from hal.calibration import Zero
from hal.rig import RawSample
from pamctl.compiled_ahead.layout import Block, construct, store
from pamctl.control.course_table import NO_COURSE, SEGMENT_WORDS, CoursePlace
from pamctl.realtime.clock import Wake
from pamctl.realtime.tick import TickSetup, TickState, first_state
from pamctl.realtime.whole_tick import TickTimes
from pamctl.recording.ring import ROW_HEADER, RowKind, tick_struct
from pamctl.signals import TICK_FIELDS, Decision, Field, Reference, Timing, list_tick_fields


class Sensed(NamedTuple):
    """What is new in every tick."""

    wake: Wake
    raw: RawSample


class Answered(NamedTuple):
    """What the loop needs of a tick at once."""

    is_done: bool
    output_v: float
    timing: Timing
    reference: Reference
    decision: Decision


_REFERENCE = Reference(0, 0.0, 0.0, 0.0, 0.0, 0.0)
_SENSED = Sensed(Wake(0, 0, 0, 0), RawSample(0.0, 0, 0, 0))
_ANSWERED = Answered(False, 0.0, Timing(0, 0.0, 0.0, 0.0, 0), _REFERENCE, Decision(0.0, 0, False))
_KNOWN_LATER = ("outcome", "truth")
OUTCOME_AT = (
    ROW_HEADER.size + tick_struct([f for f in TICK_FIELDS if f.stage not in _KNOWN_LATER]).size
)
"""Where in a row the outcome begins, with the truth after it."""


TABLE_BYTES = 1024 * 8 * SEGMENT_WORDS
"""A longer course is left to Python."""


class TickWords:
    """Where everything lies, for one type of gains."""

    def __init__(self, setup: TickSetup) -> None:
        """Lay out for set-ups like this one. Raises `NotFlat`."""
        self.fields = list_tick_fields(setup.compensation is not None)
        """The columns of a row."""
        self.setup: Block[TickSetup] = Block(setup, 0)
        self.state: Block[TickState] = Block(first_state(setup, Zero(0.0, 0.0)), self.setup.end)
        self.times: Block[TickTimes] = Block(TickTimes(0, 0), self.state.end)
        self.place: Block[CoursePlace] = Block(NO_COURSE, self.times.end)
        self.sensed: Block[Sensed] = Block(_SENSED, self.place.end)
        self.given: Block[Reference] = Block(_REFERENCE, self.sensed.end)
        self.answered: Block[Answered] = Block(_ANSWERED, self.given.end)
        self.words = self.answered.end

    def write_glue(self) -> tuple[str, dict[str, Any]]:
        """Return the source of the function between words and kernel, and the types it names."""
        types: dict[type, str] = {}
        lines = [
            *self.write_arguments(types),
            f"sensed = {construct(self.sensed, types)}",
            "wake, raw = sensed",
            "done = kernel(setup, state, times, place, wake, raw, given, table)",
            f"ints[{self.answered.begin}] = int(done.is_done)",
            "if not done.is_done:",
            "    return",
            *self.write_results(),
            *write_row(self.fields, {"raw": "raw"}),
        ]
        source = "def glue(ints, floats, row, table):\n" + indent("\n".join(lines), "    ") + "\n"
        return source, {name: kind for kind, name in types.items()}

    def write_arguments(self, types: dict[type, str]) -> list[str]:
        """Write the lines that make the kernel's arguments, all but the sample, of the words."""
        names = ("setup", "state", "times", "place", "given")
        return [f"{name} = {construct(getattr(self, name), types)}" for name in names]

    def write_results(self) -> list[str]:
        """Write the lines that put the results of `done` into the words."""
        lines = []
        for name in ("state", "times", "place"):
            lines += store(getattr(self, name), f"done.{name}.")
        return lines + store(self.answered, "done.")


_PUT = {float: ("put_float", 8), int: ("put_int", 8), bool: ("put_bool", 1)}
_STAGES = {
    "timing": "done.timing",
    "measurement": "done.state.measurement",
    "reference": "done.reference",
    "estimate": "done.state.estimate",
    "command": "done.state.command",
    "decision": "done.decision",
    "compensation": "done.state.compensated",
}


def write_row(fields: Sequence[Field], others: Mapping[str, str], base: str = "") -> list[str]:
    """Write the lines that fill a row of the ring, byte for byte as `Ring.put_tick` does.

    `others` names stages that are not in `done`; the others of `fields` are left as they are. The
    row begins at the byte `base`.
    """
    stages = {**_STAGES, **others}
    kind_and_size = RowKind.TICK | tick_struct(fields).size << 32
    lines = [
        f"put_int(row, {base}0, {kind_and_size})",
        f"put_int(row, {base}8, done.timing.tick)",
        f"put_int(row, {base}16, {stages['raw']}.encoder_t_ns)",
    ]
    at = ROW_HEADER.size
    for field in fields:
        put, size = _PUT[field.kind]
        if field.stage in stages:
            lines.append(f"{put}(row, {base}{at}, {stages[field.stage]}.{field.name})")
        at += size
    return lines
