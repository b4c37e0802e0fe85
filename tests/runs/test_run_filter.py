"""Which runs are selected: against a plain comparison."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from typing import Any

import pytest

from pamctl.runs.run_index import RunIndex
from pamctl.runs.run_list import FilterError, RunFilter, read_date, select_runs
from pamctl.runs.run_row import RunRow

DAY_S = 86400.0
ROWS = [
    RunRow(
        f"{n:03}.mcap", 1, n,
        when_s=n * DAY_S,
        law=("qsmc", "smc", "pid")[n % 3],
        plant="paper" if n % 2 else "Leaky[1]",
        ending=("ok", "trip", "unfinished")[n % 5 % 3],
        exit_code=(0, 4, None)[n % 5 % 3],
        max_um=None if n % 7 == 0 else float(n),
        tags=("good",) * (n % 2) + ("old", "good2")[: n % 3],
        note=f"hose {n % 4} % _",
        marks="load on" if n % 10 == 0 else "",
        gains={"controller.lambda_per_s": float(n % 4), "controller.law": "x", "seed": n},
        sweep={"name": "s", "point": {"plant.k": n}, "repeat": 0} if n % 6 == 0 else {},
    )
    for n in range(60)
]  # fmt: skip


@pytest.fixture(scope="module")
def index(tmp_path_factory: pytest.TempPathFactory) -> RunIndex:
    index = RunIndex(tmp_path_factory.mktemp("filter"))
    index.put(ROWS)
    return index


def names(index: RunIndex, **wanted: Any) -> list[str]:
    return [row.path for row in select_runs(index, RunFilter(**wanted))]


def expected(holds: Callable[[RunRow], bool]) -> list[str]:
    return [row.path for row in ROWS if holds(row)]


def test_rows_come_back_as_they_were_put(index: RunIndex) -> None:
    assert index.select() == ROWS


@pytest.mark.parametrize(
    ("wanted", "holds"),
    [
        ({}, lambda r: True),
        ({"where": ["law=SMC"]}, lambda r: r.law == "smc"),
        ({"where": ["law = *smc"]}, lambda r: r.law.endswith("smc")),
        ({"where": ["law!=*smc"]}, lambda r: not r.law.endswith("smc")),
        ({"where": ["plant=leaky[1]"]}, lambda r: r.plant == "Leaky[1]"),
        ({"where": ["ending=trip"]}, lambda r: r.ending == "trip"),
        ({"where": ["exit_code=4"]}, lambda r: r.exit_code == 4),
        ({"tags": ["good"]}, lambda r: "good" in r.tags),
        ({"tags": ["good", "old"]}, lambda r: {"good", "old"} <= set(r.tags)),
        ({"where": ["note=*HOSE 2 %*"]}, lambda r: "hose 2 %" in r.note),
        ({"where": ["marks=*load*"]}, lambda r: r.marks != ""),
        ({"where": ["max_um>=10", "max_um<=20"]}, lambda r: r.max_um and 10 <= r.max_um <= 20),
        ({"where": ["controller.lambda_per_s=2"]}, lambda r: r.gains["seed"] % 4 == 2),
        ({"where": ["controller.law=x"]}, lambda r: True),
        ({"where": ["plant.k >= 30"]}, lambda r: r.sweep and r.sweep["point"]["plant.k"] >= 30),
        ({"where": ["max_um<5"]}, lambda r: r.max_um and r.max_um < 5),
        ({"since_s": 9 * DAY_S}, lambda r: r.when_s >= 9 * DAY_S),
    ],
)
def test_a_condition_selects_what_it_says(
    index: RunIndex, wanted: dict[str, Any], holds: Callable[[RunRow], bool]
) -> None:
    found = expected(lambda row: bool(holds(row)))
    assert found
    assert names(index, **wanted) == found
    assert names(index, **wanted, last=2) == found[-2:]


@pytest.mark.parametrize(
    "wanted",
    [
        {"where": ["max_um>x"]},
        {"where": ["ending=well"]},
        {"where": ["law>pid"]},
        {"where": ["controller.lambda_per_s"]},
        {"where": ["controller.lambda_per_s>fast"]},
        {"where": ["controller.lamda_per_s>1"]},
        {"where": ["max_um>'; DROP TABLE runs; --"]},
    ],
)
def test_a_condition_that_makes_no_sense_is_refused(
    index: RunIndex, wanted: dict[str, Any]
) -> None:
    with pytest.raises(FilterError):
        names(index, **wanted)


def test_an_unknown_setting_is_named_with_the_nearest(index: RunIndex) -> None:
    with pytest.raises(FilterError, match=r"did you mean controller\.lambda_per_s\?"):
        names(index, where=["controller.lamda_per_s>1"])


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("2026-11-01", datetime(2026, 11, 1)),
        ("2026-11-01 14:30", datetime(2026, 11, 1, 14, 30)),
        ("2026-11-01T14:30:05", datetime(2026, 11, 1, 14, 30, 5)),
    ],
)
def test_a_date_is_that_of_this_pc(text: str, meant: datetime) -> None:
    assert read_date(text) == meant.timestamp()


def test_a_date_with_a_zone_is_that_instant() -> None:
    assert read_date("2026-11-01T14:30+00:00") == 1793543400.0


@pytest.mark.parametrize("text", ["", "monday", "2026-13-01", "25:00", "9" * 400])
def test_a_date_that_makes_no_sense_is_refused(text: str) -> None:
    with pytest.raises(FilterError, match="write 2026-11-20"):
        read_date(text)
