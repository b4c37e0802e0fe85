"""The trigger by itself, against a walk over the samples."""

from __future__ import annotations

import numpy as np
import pytest

from pamctl.live.scope import find_crossing


@pytest.mark.parametrize("slope", ["rising", "falling", "either"])
def test_a_search_in_pieces_finds_what_a_walk_over_the_samples_finds(slope: str) -> None:
    generator = np.random.default_rng(7)
    for _ in range(200):
        values = np.cumsum(generator.normal(size=60))
        values[generator.random(60) < 0.1] = np.nan
        level, hysteresis = generator.normal(), abs(generator.normal()) * 0.5
        wanted = walk(values, level, slope, hysteresis)
        armed, found, start = None, None, 0
        for piece in np.array_split(values, generator.integers(1, 8)):
            crossing = find_crossing(piece, level, slope, hysteresis, armed)
            armed = crossing.armed
            if crossing.at is not None:
                found = start + crossing.at
                break
            start += len(piece)
        assert found == wanted


def walk(values: np.ndarray, level: float, slope: str, hysteresis: float) -> int | None:
    was_below = was_above = False
    for index, value in enumerate(values):
        if was_below and value >= level and slope != "falling":
            return index
        if was_above and value <= level and slope != "rising":
            return index
        was_below = was_below or value < level - hysteresis
        was_above = was_above or value > level + hysteresis
    return None
