"""The verbs that read some columns get the same results as from the whole log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pamctl.log import read, signals
from pamctl.log.measured_signals import SIGNAL_FIELDS, Signals
from pamctl.log.reader import read_some
from pamctl.report.run_figures import FIGURE_FIELDS, summarise_run

GOLDEN = Path(__file__).parents[1] / "golden"


@pytest.mark.parametrize("name", ["qsmc", "missed", "card", "card-clocked"])
def test_some_columns_suffice_for_figures_and_signals(name: str) -> None:
    path = GOLDEN / f"{name}.mcap"
    whole = read(path)
    figures = read_some(path, FIGURE_FIELDS)
    assert len(figures.columns) < len(whole.columns)
    np.testing.assert_equal(
        summarise_run(figures, "tracking-1"), summarise_run(whole, "tracking-1")
    )
    some = signals(read_some(path, SIGNAL_FIELDS))
    for field in Signals.__dataclass_fields__:
        np.testing.assert_equal(getattr(some, field), getattr(signals(whole), field))


def test_a_column_that_the_log_lacks_is_left_out() -> None:
    log = read_some(GOLDEN / "qsmc.mcap", ("t_s", "force_n"))
    assert list(log.columns) == ["t_s"]
