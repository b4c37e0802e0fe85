"""The measured signals of a log: the valve's command and the muscle's answer.

Offline tools that use `signals` work on runs of pamctl and on imported measurements. When each
command acts at the valve follows from the log's own columns; who paces the loop decides it:

    no clock               at the sample: the plant stands still while the tick computes
    the computer, sim      when the tick has read and computed; the write itself acts first
    the computer, a card   when the driver's write call is done
    a card's sample clock  at the first edge after the write
    delayed by a tick      at the next sample
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from hal.calibration import CalibrationSettings, calibration, valve_v
from pamctl.log.framing import LogError
from pamctl.log.reader import Log
from pamctl.log.record_problems import find_record_problems, measured_columns
from pamctl.log.row_problems import FIRST_TICKS, RecordProblem, judge_first_tick
from pamctl.signals import Phase

NO_PHASE = -1
"""Phase of the ticks of an imported log: what its loop was doing is unknown."""

Floats = NDArray[np.float64]

SIGNAL_FIELDS = (
    *("tick", "t_s", "dt_s", "missed", "phase"),
    *("late_s", "read_s", "compute_s", "write_s", "true_pressure_pa"),
    *("applied_v", "valve_v", "pressure_pa", "position_m", "force_n"),
)
"""The columns of a log that `signals` needs, of those that it has."""


@dataclass(frozen=True)
class Signals:
    """The measured signals of a log: arrays of shape (n,), None if not measured.

    `valve_v[i]` is written at the end of tick i, after the samples of tick i. It drives the muscle
    from `t_s[i] + acts_after_s[i]` until the next command acts. A slice, `measured[1000:]`, is the
    same signals over those ticks.
    """

    t_s: Floats
    """Time of the encoder's samples, as taken and not as planned; strictly rising, from zero."""
    dt_s: Floats
    """Time since the previous tick, by the clock; the nominal period for the first tick."""
    valve_v: Floats | None
    """Valve command as really applied, -5..5 V, positive fills; NaN if the write failed."""
    pressure_pa: Floats | None
    """Absolute pressure in the muscle."""
    position_m: Floats | None
    """Displacement, positive in contraction."""
    force_n: Floats | None
    """Pulling force at the muscle's end; only imported logs may have it."""
    missed: NDArray[np.int64]
    """Periods skipped between the previous tick and this one."""
    phase: NDArray[np.int64]
    """`pamctl.signals.Phase` of each tick; always `NO_PHASE` in an imported log.

    During homing, position and pressure refer to the nominal zeros; they jump at its end.
    """
    acts_after_s: Floats | None = None
    """Time from sample i to the instant from which `valve_v[i]` acts; None: all act at the sample.

    Negative for a command that acted before its sample, at an edge of a card's clock that the loop
    missed.
    """
    held_v: float | None = None
    """The command before the first one here, which acts until that one does; None: unknown."""

    def __len__(self) -> int:
        """Return the number of ticks."""
        return len(self.t_s)

    def __getitem__(self, ticks: slice) -> Signals:
        """Return the signals over some of the ticks."""
        parts: dict[str, Any] = {}
        for field in fields(self):
            whole = getattr(self, field.name)
            parts[field.name] = whole[ticks] if isinstance(whole, np.ndarray) else whole
        first = ticks.indices(len(self))[0]
        if first and self.valve_v is not None:
            held_v = float(self.valve_v[first - 1])
            parts["held_v"] = held_v if np.isfinite(held_v) else None  # else that write failed
        return Signals(**parts)


def signals(log: Log) -> Signals:
    """Return the measured signals of a log of pamctl or of an imported log.

    In a log of pamctl the valve command is the output that the converter really applied, at the
    tick at which it applied it: one tick later if a sample clock paces the card. The calibration in
    the log turns it back into a command; raise LogError if there is none. Of an axis whose plant
    file states its drive, the force at a sample is the mean of those before and after it.
    """
    count, held_v = len(log), None
    force_n = log.columns.get("force_n")
    if log.is_imported:
        valve = log.columns.get("valve_v")
        stated_s = float(log.metadata.get("import", {}).get("acts_after_s", 0.0))
        acts_after_s = np.full(count, stated_s) if stated_s else None
    else:
        output = find_output_steps(log)
        valve, acts_after_s = _compute_valve_v(log, output.output_v), output.acts_after_s
        if output.held_v is not None:
            held_v = float(_compute_valve_v(log, np.array(output.held_v)))
        if drive_n_per_v := log.config.get("plant", {}).get("drive_n_per_v"):
            before_v = np.concatenate((valve[:1] if held_v is None else [held_v], valve[:-1]))
            force_n = 0.5 * drive_n_per_v * (before_v + valve)
    t_s = find_sample_times(log)
    return Signals(
        t_s=t_s,
        dt_s=log["dt_s"] + np.diff(t_s - log["t_s"], prepend=0.0),
        valve_v=valve,
        pressure_pa=log.columns.get("pressure_pa"),
        position_m=log.columns.get("position_m"),
        force_n=force_n,
        missed=log["missed"],
        phase=np.full(count, NO_PHASE) if log.is_imported else log["phase"],
        acts_after_s=acts_after_s,
        held_v=held_v,
    )


def _compute_valve_v(log: Log, output: Floats) -> Floats:
    written: Any = log.config.get("rig", {}).get("calibration")
    try:
        settings = CalibrationSettings.model_validate(written)
    except ValidationError as error:
        raise LogError(
            f"{log.path} carries no calibration of the valve's driver: "
            f"the voltage at the valve is unknown (problems: {error.error_count()})"
        ) from error
    # Plain arithmetic works on arrays as on numbers.
    return valve_v(calibration(settings), output)  # type: ignore[arg-type,return-value]


# --- what is wrong with them --------------------------------------------------------------------


def find_signal_problems(columns: Mapping[str, NDArray[Any]]) -> list[RecordProblem]:
    """Return what is wrong with the measured columns of a log.

    A log counts the ticks that its loop missed: gaps and uneven steps are none.
    """
    found = find_record_problems(columns["t_s"], measured_columns(columns))
    return [problem for problem in found if problem.kind not in ("gap", "jitter")]


def judge_ticks(log: Log, *, may_lack: bool = False) -> list[str]:
    """Return what is doubtful in the ticks of a log, each with its rows and seconds.

    Raise LogError where nothing right can be computed from them. `may_lack`: a column may hold no
    number, as a page leaves it out.
    """
    see = f"`pamctl log check {log.path}` lists all that is wrong"
    log["t_s"]  # or there is nothing to look at
    phase = log.columns.get("phase", np.empty(0, np.int64))
    unknown = find_unknown_phase(phase)
    if unknown is not None:
        row = int((phase == unknown).argmax())
        what = f"from row {row} on, {describe_unknown_phase(unknown)}"
        raise LogError(f"{log.path} cannot be used: {what}; {see}")
    problems = find_signal_problems(log.columns)
    for problem in problems:
        if problem.is_fatal and not (may_lack and problem.kind == "empty"):
            fix = f"; cut a sound part out with `pamctl log cut {log.path} --out PART.mcap`"
            way_on = see + (fix if problem.share < 1.0 else "")
            raise LogError(f"{log.path} cannot be used: {problem.describe()}; {way_on}")
    doubts = [problem.describe() for problem in problems if problem.kind != "constant"]
    return judge_description(log) + doubts


def judge_description(log: Log) -> list[str]:
    """Return what is doubtful in what a log says of its ticks, in memory or in the file."""
    problems = list(log.schema_problems)
    if "tick" in log.columns and len(log):
        first = slice(0, FIRST_TICKS)
        problems += judge_first_tick(log.columns["tick"][first], log.columns["t_s"][first])
    return [problem.describe() for problem in problems]


def find_unknown_phase(phase: NDArray[Any]) -> int | None:
    """Return the first phase that no loop has; None if there is none."""
    known = np.isin(phase, [NO_PHASE, *Phase])
    return None if known.all() else int(phase[known.argmin()])


def describe_unknown_phase(number: int) -> str:
    """Say what is wrong with a phase."""
    names = ", ".join(f"{phase.value} {phase.name.lower()}" for phase in Phase)
    return f"the phase is {number}; there are {names}"


# --- when commands act --------------------------------------------------------------------------

_DURATIONS = ("late_s", "read_s", "compute_s", "write_s")
_SLOWER = 2e-4
"""The card's crystal may be slower than the computer's by this share: twice what is usual."""
_WAKE_S = 50e-6
"""The loop places an edge at the promptest return of a read, and the edge itself was earlier by
the time of a wake-up: some 20 us in real time, 70 us otherwise."""


class OutputSteps(NamedTuple):
    """The output's voltages and when they act, each of shape (n,)."""

    output_v: Floats
    acts_after_s: Floats | None
    """Time from sample k to the instant from which `output_v[k]` acts; None: all at once.

    Negative where it acted already before sample k: the loop missed edges of a card's clock.
    """
    held_v: float | None
    """The voltage before the first tick: the safe one; None where the log does not tell it."""


def find_output_steps(log: Log) -> OutputSteps:
    """Return the voltages on the output of a log of pamctl, with the instants at which they act."""
    applied_v: Floats = log["applied_v"]
    rig = log.metadata.get("rig", {})
    # Zeros for those that an old log does not have.
    none = np.zeros(len(log))
    times = {name: log.columns.get(name, none) for name in _DURATIONS}
    held_v = float(rig["safe_output_v"]) if "safe_output_v" in rig else None
    if not len(log):
        return OutputSteps(applied_v, None, held_v)
    if rig.get("output_delay_ticks", "0") == "0":
        has_clock = any(time.any() for time in times.values())
        acts_s = _find_write_instants(log, times) if has_clock else None
        return OutputSteps(applied_v, acts_s, held_v)
    before_v = np.concatenate(([float(rig["safe_output_v"])], applied_v[:-1]))
    # Without a sample clock the rig puts it out when the loop reads next, missed ticks or not.
    if "sample_clock" not in rig or len(log) < 2:
        return OutputSteps(before_v, None, held_v)
    return OutputSteps(before_v, _find_edge_instants(log, times), held_v)


def _find_write_instants(log: Log, times: Mapping[str, Floats]) -> Floats:
    """Return the time from the encoder's sample to the output's change, shape (n,).

    `read_s` begins at the wake-up, a little before the sample; a loop that loses the CPU in
    between samples late, and the command is not late for that.
    """
    acts_s = times["read_s"] - _find_wait_for_sample(log, times) + times["compute_s"]
    # A simulated rig changes its output first; the write's duration is the plant catching up. A
    # driver's call returns when the converter has its code.
    truth = log.columns.get("true_pressure_pa")
    if truth is not None and np.isfinite(truth).any():
        return acts_s
    return np.asarray(acts_s + times["write_s"])


def _find_wait_for_sample(log: Log, times: Mapping[str, Floats]) -> Floats:
    """Return the time from each wake-up to the encoder's sample; zeros if the rate is not known.

    The grid's phase is not in the log. It follows from the promptest tick, which samples within
    a microsecond or two.
    """
    period_s = _read_period_s(log)
    if period_s is None:
        return np.zeros(len(log))
    waited_s: Floats = log["t_s"] - (log["tick"] * period_s + times["late_s"])
    return np.asarray(np.clip(waited_s - waited_s.min(), 0.0, times["read_s"]))


def find_sample_times(log: Log) -> Floats:
    """Return when the samples were taken, shape (n,): as logged, but for a card's own clock.

    The loop places such a sample by the return of its read. A read that returned almost a period
    late was taken for the next edge; the next sample, too soon after it, shows the mistake. Two
    samples are at least a period apart.
    """
    t_s: Floats = log["t_s"]
    if "sample_clock" not in log.metadata.get("rig", {}) or len(log) < 2:
        return t_s
    least_s = _find_edge_period_s(log) * (1.0 - _SLOWER) * np.arange(len(log))
    latest_s = np.minimum.accumulate((t_s - least_s)[::-1])[::-1] + least_s
    return np.asarray(np.where(t_s - latest_s > 1e-9, latest_s, t_s))


def _find_edge_instants(log: Log, times: Mapping[str, Floats]) -> Floats | None:
    """Return when the command of the tick before acted, from each sample on; None: all at it.

    The card puts a voltage out at the first edge after its write, also at an edge that the loop
    missed. A write that came too late for the next edge waits for the one after it.
    """
    period_s = _find_edge_period_s(log)
    written_s = np.sum([times[name] for name in _DURATIONS], axis=0)
    edges = np.floor((written_s[:-1] + min(_WAKE_S, 0.05 * period_s)) / period_s) + 1.0
    passed = np.maximum(1.0, np.rint(np.diff(find_sample_times(log)) / period_s))
    acts_s = np.concatenate(([0.0], (edges - passed) * period_s))
    return acts_s if acts_s.any() else None


def _find_edge_period_s(log: Log) -> float:
    """Return the distance of two edges: as configured, otherwise as most ticks show it."""
    return _read_period_s(log) or float(np.median(np.diff(log["t_s"]) / np.diff(log["tick"])))


def _read_period_s(log: Log) -> float | None:
    """Return the loop's period as configured."""
    rate_hz = log.config.get("rig", {}).get("loop", {}).get("rate_hz")
    return None if rate_hz is None else round(1e9 / float(rate_hz)) * 1e-9
