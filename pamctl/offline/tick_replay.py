"""The replay of a log, stretch by stretch: run the tick and compare it with the log.

On the machine that made a log, every field must be equal to the bit. Another CPU or C library
may round `tan`, `pow` and `acos` differently in the last bit: IEEE 754 prescribes only the four
operations and the square root. The tick uses these functions here:

    tan   cut-off frequencies of the filters: every estimate, and all results of a law
    pow   lambda^q of a gains file; Psi of the valve in safety's model of the pressure
    acos  angle of the braid in the model within SMC

Zeros, measurements and references use none of them and stay exact; so do phases, verdicts and
flags.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hal.calibration import Zero
from pamctl.control.course import Course, Segment
from pamctl.log import Log
from pamctl.offline.program_replay import ProgramAnswer, ProgramReplay, trace_course
from pamctl.offline.replay_source import (
    APPLIED_ROW,
    REPLAYED_FIELDS,
    NotReplayable,
    ReplaySource,
    read_replay_source,
    replay_stretch,
)
from pamctl.realtime.tick import TickState, first_state, freeze_state, keyframe_fields
from pamctl.signals import TICK_FIELDS

Tolerances = Mapping[str, float]
"""The largest permitted difference by field, in its unit."""

EXACT: Tolerances = {}
"""Every field equal to the bit; NaN equals NaN."""

OTHER_CPU_NAME = "default-for-other-cpu"
"""The name of `OTHER_CPU` on the command line."""

OTHER_CPU: Tolerances = {
    "position_filtered_m": 1e-14,
    "error_m": 1e-14,
    "error_rate_m_per_s": 1e-11,
    "error_acceleration_m_per_s2": 1e-8,
    "surface_m_per_s2": 1e-8,
    "command_v": 1e-9,
    "equivalent_v": 1e-9,
    "robust_v": 1e-9,
    "valve_v": 1e-9,
    # A command between two codes of the output may be rounded to either.
    "applied_v": 20.0 / 65536.0,
    "filters.position.pole": 1e-14,
    "filters.position.pair_rate": 1e-14,
    "filters.position.pair_level": 1e-14,
    "filters.rate.pole": 1e-11,
    "filters.rate.pair_rate": 1e-11,
    "filters.rate.pair_level": 1e-11,
    "filters.acceleration.pole": 1e-8,
    "filters.acceleration.pair_rate": 1e-8,
    "filters.acceleration.pair_level": 1e-8,
    "filters.error_m": 1e-14,
    "filters.error_rate_m_per_s": 1e-11,
    "law.absement_m_s": 1e-15,
    "safety.valve_v": 1e-9,
    "safety.model_pressure_pa": 1e-6,
}
"""About a thousand times the effect of one wrong last bit in each of these functions, in runs of
40 s under every law. For comparison: a hundredth of an encoder count is 3e-8 m.
`tests/offline/test_replay.py` checks the golden logs with such functions.
"""


Floats = NDArray[np.float64]

STAGES = (
    "zero",
    "measurement",
    "reference",
    "estimate",
    "command",
    "decision",
    "outcome",
    "keyframe",
)
"""The stages in the order of a tick: a difference in one stage may cause differences in later ones.

`zero` is what the sensors read at the vented muscle, `keyframe` the frozen state after a tick.
"""

_AROUND = 3


class StageField(NamedTuple):
    """A field of a stage."""

    stage: str
    name: str


class Pair(NamedTuple):
    """A logged value and the replayed one."""

    tick: int
    """Place of the tick in the log, from 0."""
    logged: float
    replayed: float


class Difference(NamedTuple):
    """The summary of a field that differs."""

    place: StageField
    first: Pair
    around: tuple[Pair, ...]
    """The compared ticks around the first difference."""
    ticks: int
    """Number of ticks that differ."""
    largest: float
    """The largest difference; infinite if only one of the two values is a number."""


class Differences:
    """Collects the differences of a replay, stretch by stretch."""

    def __init__(self, tolerances: Tolerances) -> None:
        """A field without a tolerance must be equal to the bit; NaN equals NaN."""
        self._tolerances = tolerances
        self._found: dict[StageField, Difference] = {}
        self._last: dict[StageField, tuple[Pair, ...]] = {}
        self.compared: dict[StageField, None] = {}
        """Every compared field, in the order of comparison."""

    def take(self, place: StageField, tick: int, logged: Floats, replayed: Floats) -> None:
        """Compare a field from tick `tick` on; both arrays have shape (n,)."""
        self.compared[place] = None
        wrong = find_differing(logged, replayed, self._tolerances.get(place.name, 0.0))
        if wrong is not None:
            self._note(place, tick, logged, replayed, wrong)
        else:
            self._last[place] = _make_pairs(
                tick, logged, replayed, len(logged) - _AROUND, len(logged)
            )

    def _note(
        self,
        place: StageField,
        tick: int,
        logged: Floats,
        replayed: Floats,
        wrong: NDArray[np.bool_],
    ) -> None:
        with np.errstate(invalid="ignore"):
            apart = np.abs(logged[wrong] - replayed[wrong])
        ticks, largest = int(wrong.sum()), float(np.where(np.isnan(apart), np.inf, apart).max())
        before = self._found.get(place)
        if before is not None:
            self._found[place] = before._replace(
                ticks=before.ticks + ticks, largest=max(before.largest, largest)
            )
            return
        at = int(wrong.argmax())
        first = Pair(tick + at, float(logged[at]), float(replayed[at]))
        near = _make_pairs(tick, logged, replayed, at - _AROUND, at + _AROUND + 1)
        earlier = self._last.get(place, ())
        around = tuple(pair for pair in (*earlier, *near) if abs(pair.tick - first.tick) <= _AROUND)
        self._found[place] = Difference(place, first, around, ticks, largest)

    def all(self) -> tuple[Difference, ...]:
        """Return the differences in the order of their first tick, within a tick by stage."""
        places = list(self.compared)

        def order(difference: Difference) -> tuple[int, int, int]:
            place = difference.place
            return difference.first.tick, STAGES.index(place.stage), places.index(place)

        return tuple(sorted(self._found.values(), key=order))


def find_differing(
    logged: Floats, replayed: Floats, tolerance: float = 0.0
) -> NDArray[np.bool_] | None:
    """Tell for each of n values whether the two are too far apart; None if none are."""
    same_bits = logged.view(np.int64) == replayed.view(np.int64)
    if same_bits.all():
        return None
    both_nan = np.isnan(logged) & np.isnan(replayed)
    wrong = ~(same_bits | both_nan)
    if tolerance:
        with np.errstate(invalid="ignore"):
            wrong &= ~(np.abs(logged - replayed) <= tolerance)
    return wrong if wrong.any() else None


def _make_pairs(
    tick: int, logged: Floats, replayed: Floats, begin: int, end: int
) -> tuple[Pair, ...]:
    near = slice(max(0, begin), end)
    values = zip(logged[near].tolist(), replayed[near].tolist(), strict=True)
    return tuple(Pair(tick + near.start + i, *pair) for i, pair in enumerate(values))


def are_within_tolerance(tolerances: Tolerances, differences: Iterable[Difference]) -> bool:
    """Tell whether these tolerances would accept all of the differences."""
    return all(
        difference.largest <= tolerances.get(difference.place.name, 0.0)
        for difference in differences
    )


_REFERENCE = [field.name for field in TICK_FIELDS if field.stage == "reference"]
_MEMORIES = ("filters.", "law.", "safety.")


class Replay:
    """A replay, stretch by stretch, and its result. A tick's number is its place in the log."""

    def __init__(
        self, recording: ReplaySource, begin: int, tolerances: Tolerances, *, plain: bool
    ) -> None:
        """Begin before the tick `begin`; take all stretches in order from there."""
        self.recording = recording
        self.begin = begin
        """The first replayed tick."""
        self.skipped = 0
        """Ticks after a loss, up to the next frozen state: the state before them is unknown."""
        self.unasked = 0
        """Replayed ticks whose reference could not be computed again, for the same reason."""
        self.took_s = 0.0
        self._found = Differences(tolerances)
        self._program = ProgramReplay(recording, begin, plain=plain)

    @property
    def ticks(self) -> int:
        """Number of replayed ticks."""
        return len(self.recording) - self.begin - self.skipped

    @property
    def fields(self) -> tuple[StageField, ...]:
        """The compared fields."""
        return tuple(self._found.compared)

    @property
    def absent(self) -> list[str]:
        """Fields that this version computes and the log of another version lacks."""
        columns = self.recording.log.columns
        replayed = (field for field in REPLAYED_FIELDS if field.stage != "compensation")
        return [field.name for field in replayed if field.name not in columns]

    @cached_property
    def differences(self) -> tuple[Difference, ...]:
        """Fields that differ, in the order of their first difference."""
        return self._found.all()

    @property
    def is_equal(self) -> bool:
        """Whether every tick was replayed, and equals the log.

        The ticks that a run missed are none of the log's: nothing else may be left out.
        """
        return self.is_whole and not self.differences

    @property
    def is_whole(self) -> bool:
        """Whether every tick could be replayed, with its reference."""
        return not self.skipped and not self.unasked

    @property
    def speed(self) -> float:
        """Replayed time divided by the time that the replay took."""
        t_s = self.recording.log.t
        return float(t_s[-1] - t_s[self.begin]) / self.took_s

    def take(self, begin: int, end: int, after: TickState | None, rows: Floats) -> None:
        """Compare a stretch as `ReplaySource.run_stretches` yields it with the log."""
        answer = self._program.ask(begin, end)
        if after is None:
            self.skipped += end - begin
            return
        if answer is None:
            self.unasked += end - begin
        else:
            self._compare_answer(answer, begin, end)
        # The output of a failed write is NaN in the log: what was applied is unknown.
        rows[APPLIED_ROW, np.isnan(self._read_logged("applied_v", begin, end))] = np.nan
        for field, row in zip(REPLAYED_FIELDS, rows, strict=True):
            if field.name in self.recording.log.columns:
                logged = self._read_logged(field.name, begin, end)
                self._found.take(StageField(field.stage, field.name), begin, logged, row)
        self._compare_keyframe(after, end - 1)

    def _compare_answer(self, answer: ProgramAnswer, begin: int, end: int) -> None:
        for name, row in zip(_REFERENCE, answer.references, strict=True):
            logged = self._read_logged(name, begin, end)
            self._found.take(
                StageField("reference", name), begin, logged, np.ascontiguousarray(row)
            )
        nowhere = Zero(np.nan, np.nan)
        for tick in sorted({begin} & self.recording.zeros.keys() | answer.zeros.keys()):
            logged_zero = self.recording.zeros.get(tick, nowhere)
            found = answer.zeros.get(tick, nowhere)
            for name, logged_v, found_v in zip(Zero._fields, logged_zero, found, strict=True):
                self._found.take(
                    StageField("zero", name), tick, np.array([logged_v]), np.array([found_v])
                )

    def _compare_keyframe(self, after: TickState, tick: int) -> None:
        """Compare what a keyframe holds beside the tick; in an older log it may hold less."""
        keyframe = self.recording.keyframes.get(tick)
        if keyframe is None:
            return
        logged, ours = (
            dict(zip(keyframe_fields(state), freeze_state(state), strict=True))
            for state in (keyframe, after)
        )
        for name in ours:
            if name.startswith(_MEMORIES) and name in self.recording.keyframe_names:
                pair = (np.array([numbers[name]], np.float64) for numbers in (logged, ours))
                self._found.take(StageField("keyframe", name), tick, *pair)

    def _read_logged(self, name: str, begin: int, end: int) -> Floats:
        return self.recording.log[name][begin:end].astype(np.float64)


def replay_log(
    log: Log, *, from_s: float | None = None, plain: bool = False, tolerances: Tolerances = EXACT
) -> Replay:
    """Replay a log from its first tick, or from the last frozen state before `from_s` (s).

    `plain` runs the tick as the loop process does, not compiled. Raises NotReplayable.
    """
    recording = read_replay_source(log)
    begin = recording.find_begin() if from_s is None else recording.find_tick_before(from_s) + 1
    if not plain:
        _load_kernels(recording)
    began_s = time.perf_counter()
    found = Replay(recording, begin, tolerances, plain=plain)
    for stretch in recording.run_stretches(begin, plain=plain):
        found.take(*stretch)
    found.took_s = time.perf_counter() - began_s
    if not found.ticks:
        raise NotReplayable(
            f"{log.path} has lost its first ticks and has no frozen state after them: "
            "the state to start from is unknown"
        )
    return found


def _load_kernels(recording: ReplaySource) -> None:
    """Run on zero ticks: compiling, or loading compiled code, does not count for the speed."""
    setup = recording.setup_at(0)
    nowhere = first_state(setup, Zero(0.0, 0.0))
    replay_stretch(setup, recording.output, nowhere, recording.inputs(0, 0))
    trace_course(Course([Segment(0, 1.0, 0.0, 0.0, 0.0)]), 0.0, np.empty(0))
