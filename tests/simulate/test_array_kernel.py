"""A kernel of arrays as a library: plain Python's numbers and errors, without numba."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from pamctl.compiled_ahead.array_kernel import ArrayKernel

Array = Any


class Pair(NamedTuple):
    """Two arrays, of which one may be missing."""

    weights: Array
    missing: Array | None


def fill_running_mean(values: Array, given: Pair, rows: Array) -> None:
    """Kernel: fill the weighted means up to each value, and the values themselves."""
    total = weight = 0.0
    for k in range(len(values)):
        total += values[k] * given.weights[k]
        weight += given.weights[k]
        rows[0, k] = total / weight
        rows[1, k] = values[k]


def _make_arguments(size: int) -> tuple[Array, Pair, Array]:
    random = np.random.default_rng(3)
    strided = random.normal(size=(size, 2))[:, 0]
    return strided, Pair(random.integers(1, 9, size=size), None), np.empty((2, size))


@pytest.fixture
def fresh_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "pamctl" / "ahead"


def test_a_library_gives_the_numbers_and_errors_of_plain_python(
    fresh_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PAMCTL_NO_BUILD")
    ArrayKernel(fill_running_mean, None)(*_make_arguments(3))
    (library,) = fresh_cache.glob("*.so")

    again = ArrayKernel(fill_running_mean, None)  # loads what the first has built
    values, given, rows = _make_arguments(1000)
    again(values, given, rows)
    weights = np.cumsum(given.weights)
    np.testing.assert_allclose(rows[0], np.cumsum(values * given.weights) / weights, rtol=1e-11)
    plain = np.empty_like(rows)
    fill_running_mean(values, given, plain)
    assert rows.tobytes() == plain.tobytes()
    nothing = Pair(np.zeros(1000, dtype=np.int64), None)
    with pytest.raises(ZeroDivisionError):
        again(values, nothing, rows)
    again(values.astype(np.float32), given, rows)  # of another type: by numba
    np.testing.assert_allclose(rows, plain, atol=1e-6)
    assert [*fresh_cache.glob("*.so")] == [library]


def test_nothing_is_built_where_that_is_forbidden(fresh_cache: Path) -> None:
    values, given, rows = _make_arguments(50)
    ArrayKernel(fill_running_mean, None)(values, given, rows)
    assert not fresh_cache.exists()
    np.testing.assert_array_equal(rows[1], values)


def test_a_drive_needs_no_numba_once_its_library_is_built(
    fresh_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Numba costs most of a second in every process."""
    monkeypatch.delenv("PAMCTL_NO_BUILD")
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); import test_array_kernel as t\n"
        "t.ArrayKernel(t.fill_running_mean, None)(*t._make_arguments(3))\n"
        "print('numba' in sys.modules)"
    )
    command = [sys.executable, "-c", code, str(Path(__file__).parent)]
    said = [
        subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
        for _ in range(2)
    ]
    assert said == ["True", "False"]
