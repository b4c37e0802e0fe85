"""When each command of a log acts at the valve, from the log's own columns.

Who paces the loop decides it:

    no clock               at the sample: the plant stands still while the tick computes
    the computer, sim      when the tick has read and computed; the write itself acts first
    the computer, a card   when the driver's write call is done
    a card's sample clock  at the first edge after the write
    delayed by a tick      at the next sample
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pamctl.log.reader import Log

Floats = NDArray[np.float64]

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
    times = _read_durations(log)
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


def _read_durations(log: Log) -> Mapping[str, Floats]:
    """Return the durations within each tick; zeros for those that an old log does not have."""
    none = np.zeros(len(log))
    return {name: log.columns.get(name, none) for name in _DURATIONS}


def _find_write_instants(log: Log, times: Mapping[str, Floats]) -> Floats:
    """Return the time from the encoder's sample to the output's change, shape (n,).

    `read_s` begins at the wake-up, a little before the sample; a loop that loses the CPU in
    between samples late, and the command is not late for that.
    """
    acts_s = times["read_s"] - _find_wait_for_sample(log, times) + times["compute_s"]
    # A simulated rig changes its output first; the write's duration is the plant catching up. A
    # driver's call returns when the converter has its code.
    if _is_simulated(log):
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


def _is_simulated(log: Log) -> bool:
    truth = log.columns.get("true_pressure_pa")
    return truth is not None and bool(np.isfinite(truth).any())
