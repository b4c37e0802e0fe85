"""The replay of a log, stretch by stretch: run the tick and compare it with the log."""

from __future__ import annotations

import numpy as np

from hal.calibration import Zero
from pamctl.control.filters import UNPRIMED
from pamctl.control.law_registry import installed_laws
from pamctl.realtime.tick import TickState, freeze_state, keyframe_fields
from pamctl.replay.differences import Differences, Floats, StageField
from pamctl.replay.program_replay import ProgramAnswer, ProgramReplay
from pamctl.replay.replay_source import ReplaySource
from pamctl.replay.stretch import APPLIED_ROW, REPLAYED_FIELDS, replay_stretch
from pamctl.safety import INITIAL_SAFETY_STATE
from pamctl.signals import TICK_FIELDS


def list_compared_fields() -> list[str]:
    """Name every field that a replay compares: zeros, reference, tick and keyframe.

    A keyframe has, beside the tick, the memory of filters, law and safety.
    """
    memories = [law.armed for law in installed_laws().values()]
    return [
        *Zero._fields,
        *_REFERENCE,
        *(field.name for field in REPLAYED_FIELDS),
        *keyframe_fields(UNPRIMED, "filters"),
        *dict.fromkeys(name for one in memories for name in keyframe_fields(one, "law")),
        *keyframe_fields(INITIAL_SAFETY_STATE, "safety"),
    ]


_REFERENCE = [field.name for field in TICK_FIELDS if field.stage == "reference"]
_MEMORIES = ("filters.", "law.", "safety.")


class TickReplay:
    """A replay in progress: its state, and the differences so far."""

    def __init__(
        self, recording: ReplaySource, begin: int, differences: Differences, *, plain: bool
    ) -> None:
        """Begin before the tick `begin`; take all stretches in order from there."""
        self.differences = differences
        self.skipped = 0
        """Number of ticks so far whose state is unknown."""
        self.unasked = 0
        """Number of ticks so far whose reference is unknown."""
        self._recording = recording
        self._program = ProgramReplay(recording, begin, plain=plain)
        self._state = recording.keyframes.get(begin - 1)
        self._plain = plain

    def take(self, begin: int, end: int) -> None:
        """Replay a stretch and compare it with the log."""
        self._state = self._recording.state_at(begin, self._state)
        answer = self._program.ask(begin, end)
        if self._state is None:
            self.skipped += end - begin
            self._state = self._recording.keyframes.get(end - 1)
            return
        if answer is None:
            self.unasked += end - begin
        else:
            self._compare_answer(answer, begin, end)
        self._state, rows = self._replay_stretch(self._state, begin, end)
        for field, row in zip(REPLAYED_FIELDS, rows, strict=True):
            if field.name in self._recording.log.columns:
                logged = self._read_logged(field.name, begin, end)
                self.differences.take(StageField(field.stage, field.name), begin, logged, row)
        self._compare_keyframe(self._state, end - 1)

    def _replay_stretch(self, state: TickState, begin: int, end: int) -> tuple[TickState, Floats]:
        recording = self._recording
        setup = recording.setup_at(begin)
        inputs = recording.inputs(begin, end)
        after, rows = replay_stretch(setup, recording.output, state, inputs, plain=self._plain)
        self._forget_failed_writes(rows, begin, end)
        return after, rows

    def _forget_failed_writes(self, rows: Floats, begin: int, end: int) -> None:
        """Set the output of failed writes to NaN, as in the log: what was applied is unknown."""
        failed = np.isnan(self._read_logged("applied_v", begin, end))
        rows[APPLIED_ROW, failed] = np.nan

    def _compare_answer(self, answer: ProgramAnswer, begin: int, end: int) -> None:
        for name, row in zip(_REFERENCE, answer.references, strict=True):
            logged = self._read_logged(name, begin, end)
            self.differences.take(
                StageField("reference", name), begin, logged, np.ascontiguousarray(row)
            )
        nowhere = Zero(np.nan, np.nan)
        for tick in sorted({begin} & self._recording.zeros.keys() | answer.zeros.keys()):
            logged_zero = self._recording.zeros.get(tick, nowhere)
            found = answer.zeros.get(tick, nowhere)
            for name, logged_v, found_v in zip(Zero._fields, logged_zero, found, strict=True):
                self.differences.take(
                    StageField("zero", name), tick, np.array([logged_v]), np.array([found_v])
                )

    def _compare_keyframe(self, after: TickState, tick: int) -> None:
        keyframe = self._recording.keyframes.get(tick)
        if keyframe is None:
            return
        names = self._list_memory(after)
        rows = zip(names, self._read_memory(keyframe), self._read_memory(after), strict=True)
        for name, logged, ours in rows:
            place = StageField("keyframe", name)
            self.differences.take(place, tick, np.array([logged]), np.array([ours]))

    def _list_memory(self, state: TickState) -> list[str]:
        """Name what the log's keyframes hold beside the tick; an older log may hold less."""
        known = self._recording.keyframe_names
        return [n for n in keyframe_fields(state) if n.startswith(_MEMORIES) and n in known]

    def _read_memory(self, state: TickState) -> Floats:
        numbers = dict(zip(keyframe_fields(state), freeze_state(state), strict=True))
        return np.array([numbers[name] for name in self._list_memory(state)], dtype=np.float64)

    def _read_logged(self, name: str, begin: int, end: int) -> Floats:
        return self._recording.log[name][begin:end].astype(np.float64)
