"""Prepare the process for real time, step by step; each step that is refused says how to allow it.

Call `prepare` in the loop process, after everything slow is imported and allocated, and after
every child was started: a child inherits the CPU and the timer slack (not SCHED_FIFO).
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Literal, NamedTuple

Mode = Literal["auto", "require", "off"]
"""auto: take what is permitted. require: SCHED_FIFO and locked memory, or fail. off: only gc."""

PRIORITY = 80
"""Above ordinary real-time tasks, below the kernel's own watchdogs and migration threads (99)."""

GUARDIAN_PRIORITY = PRIORITY + 1
"""Above the loop. The guardian has a CPU of its own where there are two; where there is one, a
loop that spins for ever under SCHED_FIFO would otherwise never let it run. What it does takes
tens of microseconds every 5 ms."""

FRONT_PRIORITY = 1
"""Below all others of a run, above whatever else keeps the PC busy."""

FOREIGN_THREAD_PRIORITY = 1
"""For the threads that a driver starts in the loop's process: they preempt ordinary processes only.
A killed process is dead when its last thread is, and only then does the device become free."""

_INDISPENSABLE = frozenset({"fifo", "mlock"})
_DMA_LATENCY = "/dev/cpu_dma_latency"
_SCHED_RESET_ON_FORK = 0x40000000
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_PR_SET_TIMERSLACK, _PR_GET_TIMERSLACK = 29, 30


class PreparationStep(NamedTuple):
    """One step of the preparation."""

    name: str
    done: bool
    detail: str
    """What was done; or why it was not, and what would allow it."""

    def __str__(self) -> str:
        """One line for the user."""
        return f"{self.name}: {'' if self.done else 'not '}done: {self.detail}"


class SchedulingError(RuntimeError):
    """Mode `require`, and the system does not permit SCHED_FIFO or locked memory."""

    def __init__(self, refused: tuple[PreparationStep, ...]) -> None:
        """Every refused step with its fix, a line each."""
        lines = "\n".join(f"  {step.name}: {step.detail}" for step in refused)
        super().__init__(f"real-time scheduling is required, but was refused:\n{lines}")
        self.refused = refused


class Preparation:
    """What was done to this process, and the way back. A context manager: leaving it releases."""

    def __init__(
        self,
        mode: Mode,
        steps: tuple[PreparationStep, ...],
        undo: ExitStack,
        cpus: frozenset[int] = frozenset(),
    ) -> None:
        """Take over `undo`, which holds one call for each step that was done.

        `cpus` are those that the process was allowed before it was pinned.
        """
        self.mode = mode
        self.steps = steps
        self._undo = undo
        self._cpus = cpus

    @property
    def fifo(self) -> bool:
        """The process runs under SCHED_FIFO."""
        return any(step.done for step in self.steps if step.name == "fifo")

    @property
    def may_spin(self) -> bool:
        """Spinning onto the deadline helps: nobody preempts it, and it leaves others a CPU."""
        return self.fifo and len(self._cpus) > 1

    @contextlib.contextmanager
    def defer_page_faults(self) -> Iterator[None]:
        """Lock what is mapped within the block page by page, as it is touched, not all at once.

        A loop that ticks can then map megabytes, and touch them a piece at a time.
        """
        if not any(step.done for step in self.steps if step.name == "mlock"):
            yield
            return
        libc = ctypes.CDLL(None, use_errno=True)
        libc.mlockall(_MCL_FUTURE | _MCL_ONFAULT)
        try:
            yield
        finally:
            libc.mlockall(_MCL_FUTURE)

    def free_foreign_threads(self) -> tuple[PreparationStep, ...]:
        """Raise and unpin the threads that a driver has started; return a step where there are any.

        Call it in the loop's thread, right after the rig is open. A thread inherits the loop's CPU
        and not its priority. When the process is killed, it waits there behind all that is busy.
        """
        if self.mode == "off" or sys.platform != "linux":
            return ()
        return _free_foreign_threads(self._cpus)

    @property
    def refused(self) -> tuple[PreparationStep, ...]:
        """The steps that were not done."""
        return tuple(step for step in self.steps if not step.done)

    def as_metadata(self) -> dict[str, str]:
        """The state of each step, for the log."""
        return {"mode": self.mode} | {
            step.name: f"{'done' if step.done else 'not done'}: {step.detail}"
            for step in self.steps
        }

    def release(self) -> None:
        """Undo the steps, last first, as far as the system permits. Idempotent."""
        self._undo.close()

    def __enter__(self) -> Preparation:
        """Nothing more to do: `prepare` has done it."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Release."""
        self.release()


def keep_single_threaded() -> None:
    """Keep numpy's algebra, which a driver's package may load, from starting threads of its own.

    Call it before anything is imported that might. A process that is killed is dead when its last
    thread is, and an idle one at normal priority dies when a busy CPU gets round to it: 120 ms
    were seen until a killed loop let go of the output, 5 ms without.
    """
    for library in ("OPENBLAS", "OMP", "MKL"):
        os.environ[f"{library}_NUM_THREADS"] = "1"


def prepare(mode: Mode = "auto", cpu: int | None = None) -> Preparation:
    """Prepare this process, whose calling thread is the loop, for real time.

    Args:
        mode: see `Mode`.
        cpu: the CPU to run on; by default the last one of those allowed, since the first serves
            most interrupts.

    Raises:
        SchedulingError: mode is `require`, and SCHED_FIFO or mlockall was refused; whatever
            had been done is undone again.
    """
    cpus = frozenset(os.sched_getaffinity(0)) if sys.platform == "linux" else frozenset()
    with ExitStack() as undo:
        steps = [_collect_garbage_once(undo)]
        if mode != "off":
            steps += _real_time_steps(cpu, undo)
        refused = tuple(step for step in steps if not step.done)
        if mode == "require" and any(step.name in _INDISPENSABLE for step in refused):
            raise SchedulingError(refused)
        return Preparation(mode, tuple(steps), undo.pop_all(), cpus)


def _real_time_steps(cpu: int | None, undo: ExitStack) -> list[PreparationStep]:
    """Memory before the scheduler: as SCHED_FIFO, locking it would hold up all else on this CPU."""
    steps = [
        _attempt("mlock", _lock_memory, _how_to_lock_memory, undo),
        _attempt("dma_latency", _keep_cpu_awake, _how_to_keep_cpu_awake, undo),
        _attempt("affinity", lambda undo: _pin(cpu, undo), _how_to_pin, undo),
        _attempt("fifo", _run_as_fifo, _how_to_run_as_fifo, undo),
    ]
    if not steps[-1].done:  # under SCHED_FIFO the kernel allows timers no slack anyway
        steps.append(_attempt("timer_slack", _take_timer_slack, lambda: "", undo))
    return steps


def prepare_guardian(mode: Mode, loop_cpu: int | None) -> None:
    """Prepare the guardian's process: awake in time even where the loop's CPU is lost.

    Nothing of it is indispensable: the loop says already what is not permitted.

    Args:
        mode: see `Mode`.
        loop_cpu: as the loop's process was told.
    """
    undo = ExitStack()  # for good: this process does nothing else
    _collect_garbage_once(undo)
    if mode != "off":
        cpus = frozenset(os.sched_getaffinity(0))
        _attempt("mlock", _lock_memory, _how_to_lock_memory, undo)
        _attempt("affinity", lambda undo: _keep_off(loop_cpu, undo), _how_to_pin, undo)
        _attempt(
            "fifo", lambda undo: _run_as_fifo(undo, GUARDIAN_PRIORITY), _how_to_run_as_fifo, undo
        )
        _free_foreign_threads(cpus)  # the rehearsal has loaded the driver


@contextlib.contextmanager
def raise_front_priority(mode: Mode) -> Iterator[None]:
    """Let the front preempt ordinary processes within the block, where that is permitted.

    Not for what it does, which is little and has time, but for its end: a process that was
    killed needs the CPU for some milliseconds to die, and only then can the others see it.
    On a busy PC it waits its turn for these, with the valve open. No child may be started
    within the block: it would inherit the priority.
    """
    with ExitStack() as undo:
        if mode != "off":
            # Without the reset on fork: only root may take that back, and the front has more to do.
            _attempt(
                "fifo",
                lambda undo: _schedule(os.SCHED_FIFO, FRONT_PRIORITY, undo),
                _how_to_run_as_fifo,
                undo,
            )
            _free_foreign_threads(frozenset(os.sched_getaffinity(0)))
        yield


def _attempt(
    name: str,
    take: Callable[[ExitStack], str],
    fix: Callable[[], str],
    undo: ExitStack,
) -> PreparationStep:
    if sys.platform != "linux":
        return PreparationStep(name, False, "only Linux offers this")
    try:
        return PreparationStep(name, True, take(undo))
    except OSError as error:
        return PreparationStep(name, False, "; ".join(filter(None, (error.strerror, fix()))))


def _collect_garbage_once(undo: ExitStack) -> PreparationStep:
    """Collect now and never again: a collection would stop the loop for milliseconds.

    What exists now lives as long as the process; the tick itself makes no reference cycles.
    """
    if gc.isenabled():
        undo.callback(gc.enable)
    undo.callback(gc.unfreeze)
    gc.collect()
    gc.freeze()
    gc.disable()
    return PreparationStep("gc", True, f"{gc.get_freeze_count()} objects frozen, collector off")


def _lock_memory(undo: ExitStack) -> str:
    """Fault every page in, now and on every later allocation, and keep it in memory."""
    limit_bytes = _raise_limit("RLIMIT_MEMLOCK")
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE):
        raise _make_errno_error()
    undo.callback(libc.munlockall)
    if limit_bytes < 0 or os.geteuid() == 0:
        return "all memory, present and future"
    # Worth a word: what would be allocated beyond the limit is not left unlocked, it fails.
    return f"all memory, present and future; {limit_bytes // 1024} KiB at most (RLIMIT_MEMLOCK)"


def _how_to_lock_memory() -> str:
    limit_bytes = _raise_limit("RLIMIT_MEMLOCK")
    return (
        f"RLIMIT_MEMLOCK is {'unlimited' if limit_bytes < 0 else f'{limit_bytes // 1024} KiB'}: "
        f"put '{_user()} - memlock unlimited' into /etc/security/limits.conf and log in again, "
        "or LimitMEMLOCK=infinity into the service unit"
    )


def _keep_cpu_awake(undo: ExitStack) -> str:
    """Forbid deep idle states, whose exit takes longer than a wake-up, while the file is open."""
    latency = os.open(_DMA_LATENCY, os.O_WRONLY)
    undo.callback(os.close, latency)
    os.write(latency, (0).to_bytes(4, sys.byteorder))
    return f"{_DMA_LATENCY} held at 0 us"


def _how_to_keep_cpu_awake() -> str:
    return (
        f"{_DMA_LATENCY} must be writable: put "
        """'KERNEL=="cpu_dma_latency", GROUP="realtime", MODE="0660"' """
        f"into /etc/udev/rules.d/99-realtime.rules and {_user()} into the group realtime"
    )


def _pin(cpu: int | None, undo: ExitStack) -> str:
    """Keep the loop's caches warm, and the recorder and the guardian out of its way."""
    allowed = os.sched_getaffinity(0)
    if len(allowed) < 2:
        raise OSError(0, "only one CPU to run on")
    return _run_on({max(allowed) if cpu is None else cpu}, undo)


def _keep_off(loop_cpu: int | None, undo: ExitStack) -> str:
    """Leave the loop's CPU to the loop, and do not depend on it."""
    allowed = os.sched_getaffinity(0)
    others = allowed - {max(allowed) if loop_cpu is None else loop_cpu}
    if not others:
        raise OSError(0, "only one CPU to run on")
    return _run_on(others, undo)


def _run_on(cpus: set[int], undo: ExitStack) -> str:
    undo.callback(_undo_quietly, os.sched_setaffinity, 0, os.sched_getaffinity(0))
    os.sched_setaffinity(0, cpus)
    return f"pinned to CPU {', '.join(map(str, sorted(cpus)))}"


def _how_to_pin() -> str:
    allowed = sorted(os.sched_getaffinity(0))
    return f"allowed are the CPUs {', '.join(map(str, allowed))} (see taskset, CPUAffinity=)"


def _run_as_fifo(undo: ExitStack, wanted: int = PRIORITY) -> str:
    """Preempt every ordinary process. Children fall back to SCHED_OTHER."""
    return _schedule(os.SCHED_FIFO | _SCHED_RESET_ON_FORK, _highest_permitted(wanted), undo)


def _schedule(policy: int, priority: int, undo: ExitStack) -> str:
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    os.sched_setscheduler(0, policy, os.sched_param(priority))
    undo.callback(_undo_quietly, os.sched_setscheduler, 0, *before)
    return f"SCHED_FIFO, priority {priority}"


def _highest_permitted(priority: int) -> int:
    """Root may take any priority, others what RLIMIT_RTPRIO grants, where it grants any."""
    granted = _raise_limit("RLIMIT_RTPRIO")
    return priority if os.geteuid() == 0 or granted <= 0 else min(priority, granted)


def _how_to_run_as_fifo() -> str:
    if os.geteuid() == 0:
        return (
            "root is refused only where the control group or the container forbids it: "
            "raise cpu.rt_runtime_us of the group, or start the container with CAP_SYS_NICE"
        )
    granted = _raise_limit("RLIMIT_RTPRIO")
    return (
        f"RLIMIT_RTPRIO is {granted}: put '{_user()} - rtprio {PRIORITY}' into "
        "/etc/security/limits.conf and log in again, "
        f"or LimitRTPRIO={PRIORITY} into the service unit"
    )


def _take_timer_slack(undo: ExitStack) -> str:
    """Without it the kernel may delay an ordinary process's timers by 50 us, to save wake-ups."""
    prctl = ctypes.CDLL(None, use_errno=True).prctl
    prctl.argtypes = (ctypes.c_int, *[ctypes.c_ulong] * 4)
    before_ns = prctl(_PR_GET_TIMERSLACK, 0, 0, 0, 0)
    if prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0):
        raise _make_errno_error()
    if before_ns > 0:
        undo.callback(prctl, _PR_SET_TIMERSLACK, before_ns, 0, 0, 0)
    return "timer slack 1 ns"


def _free_foreign_threads(cpus: frozenset[int]) -> tuple[PreparationStep, ...]:
    """Raise and unpin all threads but the calling one; return a step where there are any."""
    tasks = {int(entry.name) for entry in Path("/proc/self/task").iterdir()}
    foreign = sorted(tasks - {threading.get_native_id()})
    if not foreign:
        return ()
    refused = "; ".join(sorted({_free_thread(thread, cpus) for thread in foreign} - {""}))
    taken = f"SCHED_FIFO, priority {FOREIGN_THREAD_PRIORITY}, all CPUs"
    if refused:
        taken = f"{refused}; a killed loop frees the device late; see fifo"
    detail = f"{len(foreign)} of the driver's threads: {taken}"
    return (PreparationStep("foreign_threads", not refused, detail),)


def _free_thread(thread: int, cpus: frozenset[int]) -> str:
    """Raise and unpin one thread; return why not, empty where it was done or the thread ended."""
    param = os.sched_param(FOREIGN_THREAD_PRIORITY)
    try:
        os.sched_setaffinity(thread, cpus)
        os.sched_setscheduler(thread, os.SCHED_FIFO | _SCHED_RESET_ON_FORK, param)
    except ProcessLookupError:
        return ""
    except OSError as error:
        return error.strerror or str(error)
    return ""


def _raise_limit(name: str) -> int:
    """The hard limit, to which the soft one, which the kernel asks, is raised; -1: unlimited."""
    import resource

    limit: int = getattr(resource, name)
    _, hard = resource.getrlimit(limit)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(limit, (hard, hard))
    return hard


def _make_errno_error() -> OSError:
    number = ctypes.get_errno()
    return OSError(number, os.strerror(number))


def _undo_quietly(call: Callable[..., object], *arguments: object) -> None:
    """Undo one step; that the system forbids the way back must not keep the others from it."""
    with contextlib.suppress(OSError):
        call(*arguments)


def _user() -> str:
    import pwd

    try:
        return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:  # a container may run under a number without a name
        return str(os.getuid())
