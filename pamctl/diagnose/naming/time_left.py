"""How long a diagnosis will take, before its first fit has ended."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

from pamctl.diagnose.fitting.drives import stack_residuals
from pamctl.diagnose.fitting.evidence import Evidence

SIMULATIONS = (1_500, 10_000)
"""Simulations of all fitted records that a diagnosis takes: one that names an effect at once, and
one that names none. Counted on two runs of 13 s of the experiment `diagnosis`."""


def guess_time_left(evidence: Evidence) -> str:
    """Say how long the diagnosis will take on this computer as busy as it is now."""
    drives = evidence.training_drives(evidence.blocks)
    anew = [replace(drive, is_remembered=False) for drive in drives]
    took_s = []
    for _ in range(2):  # the first may load machine code
        began_s = perf_counter()
        stack_residuals(anew, evidence.nominal)
        took_s.append(perf_counter() - began_s)
    low_s, high_s = (max(1.0, count * min(took_s)) for count in SIMULATIONS)
    return f"usually {low_s:.0f} to {max(high_s, low_s + 1.0):.0f} s in all"
