"""The play operator, which the two effects with a slack share."""

from __future__ import annotations


def follow_with_play(before: float, target: float, width: float) -> float:
    """Follow a target with a total slack of `width`, moving only when pushed; one unit for all."""
    half = 0.5 * width
    return min(max(before, target - half), target + half)
