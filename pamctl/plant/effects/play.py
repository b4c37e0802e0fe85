"""The play operator: what two effects of slack have in common."""

from __future__ import annotations


def follow_with_play(before: float, target: float, width: float) -> float:
    """Follow a target with a slack of `width` in all, moving only when pushed; one unit for all."""
    half = 0.5 * width
    return min(max(before, target - half), target + half)
