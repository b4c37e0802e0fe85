"""Align the zeros that homing gave the pressure sensor, by the vented rests of several records.

Homing takes the zero from noisy readings, and from air that has nearly left. So records of one rig
differ by some tens of pascals, and one offset cannot serve them all. The offset that they share
stays: it may be physical.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from pamctl.diagnose.measured.record import REST_V, Array, Record

HOMED_PA = 250.0
"""Homing leaves the zero within this; records that differ by more differ for another reason."""
PIECE_S = 0.05
"""Length of the pieces of a rest that are compared at the same time after the start."""
FEWEST_PIECES = 4
FEWEST_SAMPLES = 100
SURE = 3.0
"""A rest whose difference from the others drifts by this many sigma is no rest."""


def align_resting_pressure(records: Sequence[Record]) -> list[Record]:
    """Return the records with their sensors' zeros aligned at rest; all others as they are.

    What the records share at the same time after the start, such as a leak that fills the muscle,
    is not changed. Only rests under the same command are compared. A difference counts by how much
    it exceeds its own uncertainty; one beyond `HOMED_PA`, or one that drifts, is left.
    """
    aligned = [*records]
    resting = [k for k, record in enumerate(records) if _rests(record)]
    resting.sort(key=lambda k: records[k]["valve_v"][0])
    ends = [
        i
        for i, (one, other) in enumerate(pairwise(resting), 1)
        if records[other]["valve_v"][0] - records[one]["valve_v"][0] > REST_V
    ]
    for group in np.split(np.array(resting, dtype=int), ends):
        excesses = _measure_excesses([_average_pieces(records[k]) for k in group])
        for k, excess_pa in zip(group, excesses, strict=True):
            if excess_pa:
                aligned[k] = replace(records[k], pressure_pa=records[k]["pressure_pa"] - excess_pa)
    return aligned


def _rests(record: Record) -> bool:
    if record.valve_v is None or record.pressure_pa is None:
        return False
    rest = record.rest_samples
    return rest >= FEWEST_SAMPLES and rest * record.period_s >= FEWEST_PIECES * PIECE_S


def _average_pieces(record: Record) -> Array:
    """Return the mean pressure of each piece of the rest; NaN where it has no sample."""
    rest = slice(0, record.rest_samples)
    piece = ((record.t_s[rest] - record.t_s[0]) / PIECE_S + 1e-6).astype(int)
    counts = np.bincount(piece).astype(float)
    sums = np.bincount(piece, weights=record["pressure_pa"][rest])
    full = np.divide(sums, counts, out=np.full(len(counts), np.nan), where=counts > 0.0)
    return full[:-1] if counts[-1] < 0.5 * counts[0] else full  # the last piece may be a stub


def _measure_excesses(rests: Sequence[Array]) -> Array:
    """Return by how much each rest lies above the others, shrunk by its uncertainty; or 0."""
    length = max(map(len, rests), default=0)
    table = np.full((len(rests), length), np.nan)
    for row, rest in zip(table, rests, strict=True):
        row[: len(rest)] = rest
    shared = np.isfinite(table).sum(axis=0) > 1
    if shared.sum() < FEWEST_PIECES:
        return np.zeros(len(rests))
    table = table[:, shared]
    zeros, course = _separate(table)
    zeros = zeros - np.median(zeros)
    return np.array(
        [_shrink(zero, row - course) for zero, row in zip(zeros, table, strict=True)]
    )


def _separate(table: Array) -> tuple[Array, Array]:
    """Return a zero for each row and the course that all rows share, by least squares."""
    rows, columns = np.nonzero(np.isfinite(table))
    design = np.zeros((len(rows), sum(table.shape)))
    entry = np.arange(len(rows))
    design[entry, rows] = design[entry, len(table) + columns] = 1.0
    found = np.linalg.lstsq(design, table[rows, columns], rcond=None)[0]
    return found[: len(table)], found[len(table) :]


def _shrink(zero_pa: float, difference: Array) -> float:
    """Return the part of a zero that its scatter does not explain; 0 for one that cannot be."""
    difference = difference[np.isfinite(difference)]
    if len(difference) < FEWEST_PIECES or abs(zero_pa) > HOMED_PA or zero_pa == 0.0:
        return 0.0
    # Neighbours show the noise alone, also where the pressure drifts.
    noise_pa = float(np.sqrt(0.5 * np.mean(np.diff(difference) ** 2)))
    uncertain_pa = noise_pa / np.sqrt(len(difference))
    early, late = np.array_split(difference, 2)
    if abs(np.mean(late) - np.mean(early)) > SURE * 2.0 * uncertain_pa:
        return 0.0
    return zero_pa * max(1.0 - (uncertain_pa / zero_pa) ** 2, 0.0)
