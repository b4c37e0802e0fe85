"""What front, loop, guardian and recorder of a run promise each other, as a small state model.

A state is pure data. Time goes in steps. In each step every running process moves once, in any
order, and up to `Rules.most_faults` times a process is killed or frozen before any move. `explore`
visits every state that can be reached in this way and checks the promises in it:

- As long as front, loop or guardian lives: `Rules.safe_within` steps after the last fault the
  valve is safe, or a loop drives it that has a guardian and a front.
- A row is written by one process at a time, and never into a log that is finished. The ring is
  removed only when all its rows are in the finished log.
- Nobody waits for ever, except for a frozen front, which can be continued or killed.
- If front, loop or guardian survives the last fault, the log is finished without a next start.

Steps stand for the times of the code in their order, not in their proportion: a guardian's
patience is shorter than a front's, a front's head start shorter than its patience for a report.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from enum import IntEnum
from typing import NamedTuple


class Life(IntEnum):
    """What has become of a process."""

    RUNS = 0
    FROZEN = 1
    DEAD = 2
    """Killed."""
    LEFT = 3
    """Ended by itself."""


class Phase(IntEnum):
    """What front and guardian are doing, each in its own order."""

    WATCHING = 0
    JUDGING = 1
    """Front: waits for the guardian's report. Guardian: makes the valve safe."""
    WRITING = 2
    """Puts the last events for a dead loop."""
    CLOSING = 3
    """Front: waits for the recorder. Guardian: waits for the front's end."""
    DISMISSING = 4
    """Front: waits for the guardian's end."""


class Rules(NamedTuple):
    """Patience in steps, and which of the mechanisms work: a mutated model lacks one."""

    guardian_patience: int = 2
    front_patience: int = 3
    leaving_patience: int = 4
    loop_patience: int = 2
    head_start: int = 1
    report_patience: int = 2
    recorder_patience: int = 3
    stalled_after: int = 5
    safe_within: int = 8
    end_within: int = 30
    most_faults: int = 3
    front_listens: bool = True
    """The front looks at the loop's heartbeat."""
    guardian_listens: bool = True
    loop_hears_guardian: bool = True
    """The loop looks at the guardian's heartbeat."""
    loop_sees_front: bool = True
    """The loop looks at the front's end of the pipe."""
    front_kills_first: bool = True
    """The front kills a guardian that does not report before it writes in its place."""
    guardian_stays: bool = True
    """The guardian stays until the front has finished the log."""
    finisher_kills: bool = True
    """A frozen recorder whose front is dead is killed."""
    ring_waits: bool = True
    """The front keeps the ring until the log is finished."""


RULES = Rules()

FRONT, LOOP, GUARDIAN, RECORDER = range(4)
NAMES = ("front", "loop", "guardian", "recorder")
_R = Life.RUNS


class State(NamedTuple):
    """All that can be observed; ages are steps since the last beat."""

    life: tuple[Life, ...] = (_R, _R, _R, _R)
    moved: tuple[bool, ...] = (False, False, False, False)
    """Who has moved in this step."""
    loop_age: int = 0
    guardian_age: int = 0
    recorder_age: int = 0
    front_phase: Phase = Phase.WATCHING
    front_waited: int = 0
    guardian_phase: Phase = Phase.WATCHING
    is_leaving: bool = False
    """The loop has made the valve safe and puts no tick any more."""
    loop_done: bool = False
    guardian_lost: bool = False
    recorder_failed: bool = False
    has_reported: bool = False
    is_safe: bool = False
    is_finished: bool = False
    """The log is finished."""
    has_ring: bool = True
    has_finisher: bool = False
    faults: int = 0
    since_fault: int = 0


class BrokenPromiseError(Exception):
    """A state breaks a promise; `path` tells how it was reached."""

    def __init__(self, promise: str, path: list[str]) -> None:
        super().__init__(f"{promise}: {'; '.join(path)}")
        self.promise, self.path = promise, path


# --- decisions: the code's transitions are compared with these -----------------------------


def loop_aborts(
    rules: Rules, *, recorder_failed: bool, guardian_lost: bool, guardian_age: int, front_gone: bool
) -> bool:
    """`LoopSupervisor.wants_abort`."""
    is_silent = rules.loop_hears_guardian and guardian_age >= rules.loop_patience
    return recorder_failed or guardian_lost or is_silent or (rules.loop_sees_front and front_gone)


def loop_stops(rules: Rules, *, recorder_age: int) -> bool:
    """`LoopSupervisor.find_stop`, which leaves time for a ramp."""
    return recorder_age > rules.recorder_patience


def is_too_silent(rules: Rules, *, loop_age: int, is_leaving: bool, listens_from: int) -> bool:
    """`Silence.find_fault`; `listens_from` is the listener's patience with a loop that ticks."""
    lead = listens_from - rules.guardian_patience
    return loop_age > (rules.leaving_patience + lead if is_leaving else listens_from)


def judge(rules: Rules, *, has_reported: bool, guardian: Life, waited: int) -> str:
    """`Guardianship.judge_ending`, once the loop has ended."""
    if has_reported:
        return "believe"
    if guardian != Life.RUNS or waited > rules.report_patience:
        return "take over"
    return "make safe" if waited > rules.head_start else "wait"


# --- moves ----------------------------------------------------------------------------------


def is_gone(life: Life) -> bool:
    """Tell whether a process has ended, which is what its pipe and its handle show."""
    return life in (Life.DEAD, Life.LEFT)


def with_life(state: State, who: int, life: Life) -> State:
    """Return the state with the life of one process changed."""
    lives = list(state.life)
    lives[who] = life
    return state._replace(life=tuple(lives))


def kill(state: State, who: int) -> State:
    """Kill a process; nothing happens to one that has ended."""
    return state if is_gone(state.life[who]) else with_life(state, who, Life.DEAD)


def write(state: State, who: int) -> State:
    """Put rows; raise where another process may be putting rows, or where they are lost."""
    is_writing = {
        FRONT: state.front_phase == Phase.WRITING,
        LOOP: not state.loop_done,
        GUARDIAN: state.guardian_phase == Phase.WRITING,
    }
    for other, may_write in is_writing.items():
        if other != who and may_write and not is_gone(state.life[other]):
            raise BrokenPromiseError(f"two writers: {NAMES[who]} beside the {NAMES[other]}", [])
    if state.is_finished or not state.has_ring:
        raise BrokenPromiseError("a row is lost: it comes after the end of the log", [])
    return state


def remove_ring(state: State) -> State:
    """Remove the ring; raise where it holds rows that are in no log."""
    if not state.is_finished:
        raise BrokenPromiseError("rows are lost: the ring is removed before the log is whole", [])
    return state._replace(has_ring=False)


def move_loop(rules: Rules, state: State) -> State:
    if state.is_leaving:
        if is_gone(state.life[FRONT]):
            state = state._replace(has_finisher=True)
        return with_life(state, LOOP, Life.LEFT)
    state = write(state, LOOP)._replace(loop_age=0)
    if loop_aborts(
        rules,
        recorder_failed=state.recorder_failed,
        guardian_lost=state.guardian_lost,
        guardian_age=state.guardian_age,
        front_gone=is_gone(state.life[FRONT]),
    ) or loop_stops(rules, recorder_age=state.recorder_age):
        return state._replace(is_safe=True, is_leaving=True, loop_done=True)
    return state


def move_guardian(rules: Rules, state: State) -> State:
    match state.guardian_phase:
        case Phase.WATCHING:
            state = state._replace(guardian_age=0)
            silent = rules.guardian_listens and is_too_silent(
                rules,
                loop_age=state.loop_age,
                is_leaving=state.is_leaving,
                listens_from=rules.guardian_patience,
            )
            if silent:
                state = kill(state, LOOP)
            return state._replace(guardian_phase=Phase.JUDGING) if loop_ended(state) else state
        case Phase.JUDGING:
            state = state._replace(is_safe=True)
            if state.loop_done:
                return state._replace(guardian_phase=Phase.CLOSING, has_reported=True)
            return state._replace(guardian_phase=Phase.WRITING)
        case Phase.WRITING:
            state = write(state, GUARDIAN)
            return state._replace(guardian_phase=Phase.CLOSING, has_reported=True)
    if not rules.guardian_stays:
        return with_life(state, GUARDIAN, Life.LEFT)
    if not is_gone(state.life[FRONT]):
        return state
    if state.has_ring:
        if not state.loop_done:
            state = write(state, GUARDIAN)
        state = state._replace(loop_done=True, has_finisher=True)
    return with_life(state, GUARDIAN, Life.LEFT)


def loop_ended(state: State) -> bool:
    """Tell whether the loop has ended."""
    return is_gone(state.life[LOOP])


def move_front(rules: Rules, state: State) -> State:
    match state.front_phase:
        case Phase.WATCHING:
            return _watch(rules, state)
        case Phase.JUDGING:
            return _judge(rules, state)
        case Phase.WRITING:
            if not state.loop_done:
                state = write(state, FRONT)
            state = state._replace(is_safe=True, loop_done=True)
            return state._replace(front_phase=Phase.CLOSING, front_waited=0)
        case Phase.CLOSING:
            return _close(rules, state)
    if is_gone(state.life[GUARDIAN]):
        return with_life(state, FRONT, Life.LEFT)
    waited = state.front_waited + 1
    state = state._replace(front_waited=waited)
    return kill(state, GUARDIAN) if waited > rules.report_patience else state


def _watch(rules: Rules, state: State) -> State:
    if is_gone(state.life[RECORDER]):
        state = state._replace(recorder_failed=True)
    if is_gone(state.life[GUARDIAN]):
        state = state._replace(guardian_lost=True)
    silent = rules.front_listens and is_too_silent(
        rules,
        loop_age=state.loop_age,
        is_leaving=state.is_leaving,
        listens_from=rules.front_patience,
    )
    if silent:
        state = kill(state, LOOP)
    return state._replace(front_phase=Phase.JUDGING) if loop_ended(state) else state


def _judge(rules: Rules, state: State) -> State:
    verdict = judge(
        rules,
        has_reported=state.has_reported,
        guardian=state.life[GUARDIAN],
        waited=state.front_waited,
    )
    match verdict:
        case "believe":
            return state._replace(front_phase=Phase.WRITING)
        case "take over":
            if rules.front_kills_first:
                state = kill(state, GUARDIAN)
            return state._replace(front_phase=Phase.WRITING)
        case "make safe":
            state = state._replace(is_safe=True)
    return state._replace(front_waited=state.front_waited + 1)


def _close(rules: Rules, state: State) -> State:
    if not is_gone(state.life[RECORDER]):
        is_silent = state.recorder_age > rules.recorder_patience
        state = kill(state, RECORDER) if is_silent else state
        if rules.ring_waits:
            return state
    else:
        state = state._replace(is_finished=True)  # by the recorder, or by the next one
    return remove_ring(state)._replace(front_phase=Phase.DISMISSING, front_waited=0)


def move_recorder(rules: Rules, state: State) -> State:
    state = state._replace(recorder_age=0)
    is_owner_gone = is_gone(state.life[FRONT])
    if not (state.loop_done or (is_owner_gone and state.loop_age > rules.stalled_after)):
        return state
    state = with_life(state._replace(is_finished=True), RECORDER, Life.LEFT)
    return remove_ring(state) if is_owner_gone else state


def move_finisher(rules: Rules, state: State) -> State:
    """Move the recorder that a guardian or a loop has started, which is hit by no fault."""
    if not state.has_ring:
        return state._replace(has_finisher=False)
    if is_gone(state.life[RECORDER]):
        return remove_ring(state._replace(is_finished=True, has_finisher=False))
    if rules.finisher_kills and state.recorder_age > rules.recorder_patience:
        return kill(state, RECORDER)
    return state


_MOVES = {FRONT: move_front, LOOP: move_loop, GUARDIAN: move_guardian, RECORDER: move_recorder}
_KEEPERS = (FRONT, LOOP, GUARDIAN)


# --- exploration ----------------------------------------------------------------------------


def list_next(rules: Rules, state: State) -> Iterator[tuple[str, State]]:
    """Yield every event that may come next, with the state after it."""
    if state.faults < rules.most_faults:
        for who, life in enumerate(state.life):
            for fault in (Life.FROZEN, Life.DEAD):
                if not is_gone(life) and life < fault:
                    hit = with_life(state, who, fault)
                    done = hit._replace(faults=state.faults + 1, since_fault=0)
                    yield f"{NAMES[who]} {fault.name.lower()}", done
    still = [n for n, life in enumerate(state.life) if life == Life.RUNS and not state.moved[n]]
    for who in still:
        moved = tuple(has or n == who for n, has in enumerate(state.moved))
        yield NAMES[who], _MOVES[who](rules, state._replace(moved=moved))
    if not still:
        yield "time", _pass_time(rules, state)


def _pass_time(rules: Rules, state: State) -> State:
    state = move_finisher(rules, state) if state.has_finisher else state
    # Ages beyond every patience make no difference any more.
    most = max(rules.stalled_after, rules.front_patience + rules.leaving_patience) + 1
    return state._replace(
        moved=(False, False, False, False),
        loop_age=min(most, state.loop_age + 1),
        guardian_age=min(rules.loop_patience, state.guardian_age + 1),
        recorder_age=min(rules.recorder_patience + 1, state.recorder_age + 1),
        since_fault=min(rules.end_within + 1, state.since_fault + 1) if state.faults else 0,
    )


def find_broken_promise(rules: Rules, state: State) -> str:
    """Say which promise a state breaks, if it breaks one."""
    lives = [NAMES[who] for who in _KEEPERS if state.life[who] == Life.RUNS]
    is_driven = state.life[LOOP] == state.life[GUARDIAN] == Life.RUNS and not is_gone(
        state.life[FRONT]
    )
    if lives and not (state.is_safe or is_driven) and state.since_fault > rules.safe_within:
        return f"the valve is open {state.since_fault} steps after the last fault; alive: {lives}"
    if state.since_fault <= rules.end_within or state.life[FRONT] == Life.FROZEN:
        return ""
    waiting = [name for name, life in zip(NAMES, state.life, strict=True) if life == Life.RUNS]
    if waiting or state.has_finisher:
        return f"waits for ever: {waiting or 'finisher'}"
    has_survivor = Life.LEFT in (state.life[FRONT], state.life[GUARDIAN])
    if has_survivor and not state.is_finished:
        return "the log waits for the next start although front or guardian lived on"
    return ""


def explore(rules: Rules = RULES) -> set[State]:
    """Visit every state that can be reached; raise `BrokenPromiseError` with the shortest way."""
    start = State()
    before: dict[State, tuple[State, str] | None] = {start: None}
    waiting = deque([start])
    while waiting:
        state = waiting.popleft()
        event = ""
        try:
            for event, after in list_next(rules, state):
                if after in before:
                    continue
                before[after] = (state, event)
                if broken := find_broken_promise(rules, after):
                    raise BrokenPromiseError(broken, [])
                waiting.append(after)
        except BrokenPromiseError as error:
            raise BrokenPromiseError(error.promise, [*_trace(before, state), event]) from None
    return set(before)


def _trace(before: dict[State, tuple[State, str] | None], state: State) -> list[str]:
    path: list[str] = []
    step = before[state]
    while step is not None:
        state, event = step
        path.append(event)
        step = before[state]
    return path[::-1]
