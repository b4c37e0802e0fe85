"""Which runs are selected: against a plain comparison, and dates as people say them."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pamctl.runs.run_filter import FilterError, RunFilter, select_runs
from pamctl.runs.run_index import RunIndex
from pamctl.runs.run_row import RunRow
from pamctl.runs.spoken_dates import DateError, DateSpan, parse_date

DAY_S = 86400.0
COMPARE: dict[str, Callable[[Any, Any], bool]] = {
    ">": operator.gt, "<": operator.lt, ">=": operator.ge, "<=": operator.le, "=": operator.eq,
}  # fmt: skip
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
def index(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunIndex]:
    with RunIndex(tmp_path_factory.mktemp("filter")) as index:
        index.put(ROWS)
        yield index


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
        ({"law": "SMC"}, lambda r: r.law == "smc"),
        ({"law": "*smc"}, lambda r: r.law.endswith("smc")),
        ({"plant": "leaky[1]"}, lambda r: r.plant == "Leaky[1]"),
        ({"ending": "trip"}, lambda r: r.ending == "trip"),
        ({"ending": "4"}, lambda r: r.exit_code == 4),
        ({"tags": ["good"]}, lambda r: "good" in r.tags),
        ({"tags": ["good", "old"]}, lambda r: {"good", "old"} <= set(r.tags)),
        ({"without_tags": ["good"]}, lambda r: "good" not in r.tags),
        ({"note_text": "HOSE 2 %"}, lambda r: "hose 2 %" in r.note),
        ({"note_text": "load"}, lambda r: r.marks != ""),
        ({"limits": [("max_um", "10..20")]}, lambda r: r.max_um and 10 <= r.max_um <= 20),
        ({"where": ["controller.lambda_per_s=2"]}, lambda r: r.gains["seed"] % 4 == 2),
        ({"where": ["controller.law=x"]}, lambda r: True),
        ({"where": ["plant.k >= 30"]}, lambda r: r.sweep and r.sweep["point"]["plant.k"] >= 30),
        ({"where": ["max_um<5"]}, lambda r: r.max_um and r.max_um < 5),
        ({"since": DateSpan(9 * DAY_S, 10 * DAY_S)}, lambda r: r.when_s >= 9 * DAY_S),
        ({"until": DateSpan(9 * DAY_S, 10 * DAY_S)}, lambda r: r.when_s < 10 * DAY_S),
        ({"until": DateSpan(9 * DAY_S, 9 * DAY_S)}, lambda r: r.when_s <= 9 * DAY_S),
    ],
)
def test_a_condition_selects_what_it_says(
    index: RunIndex, wanted: dict[str, Any], holds: Callable[[RunRow], bool]
) -> None:
    found = expected(lambda row: bool(holds(row)))
    assert found
    assert names(index, **wanted) == found
    assert names(index, **wanted, last=2) == found[-2:]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40)
@given(
    sign=st.sampled_from(list(COMPARE)),
    limit=st.integers(-5, 70),
    law=st.sampled_from([None, "qsmc", "pid"]),
    tag=st.sampled_from([None, "good", "none"]),
)
def test_conditions_hold_together(
    index: RunIndex, sign: str, limit: int, law: str | None, tag: str | None
) -> None:
    tags = [] if tag is None else [tag]
    found = names(index, law=law, tags=tags, limits=[("max_um", f" {sign} {limit}")])
    assert found == expected(
        lambda r: (
            r.max_um is not None
            and COMPARE[sign](r.max_um, limit)
            and law in (None, r.law)
            and set(tags) <= set(r.tags)
        )
    )


@pytest.mark.parametrize(
    "wanted",
    [
        {"limits": [("max_um", "50")]},
        {"limits": [("max_um", ">x")]},
        {"limits": [("max_um", "1..")]},
        {"ending": "well"},
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


NOW = datetime(2026, 11, 18, 15, 30)  # a Wednesday


def day(year: int, month: int, number: int) -> DateSpan:
    begin = datetime(year, month, number)
    return DateSpan(begin.timestamp(), (begin + timedelta(days=1)).timestamp())


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("2026-11-01", day(2026, 11, 1)),
        ("today", day(2026, 11, 18)),
        ("Yesterday", day(2026, 11, 17)),
        ("wednesday", day(2026, 11, 18)),
        ("Monday", day(2026, 11, 16)),
        ("thu", day(2026, 11, 12)),
        ("2026-11-01 14:30", datetime(2026, 11, 1, 14, 30)),
        ("2026-11-01T14:30:05", datetime(2026, 11, 1, 14, 30, 5)),
        ("14:30", datetime(2026, 11, 18, 14, 30)),
        ("2 days ago", NOW - timedelta(days=2)),
        ("an hour ago", NOW - timedelta(hours=1)),
        ("90 min ago", NOW - timedelta(minutes=90)),
        ("2h", NOW - timedelta(hours=2)),
        ("1.5 weeks ago", NOW - timedelta(weeks=1.5)),
        ("now", NOW),
    ],
)
def test_a_date_means_what_people_mean(text: str, meant: DateSpan | datetime) -> None:
    span = meant if isinstance(meant, DateSpan) else DateSpan(meant.timestamp(), meant.timestamp())
    assert parse_date(text, NOW) == span


@pytest.mark.parametrize(
    "text", ["", "noday", "2026-13-01", "25:00", "2 fortnights ago", "9" * 400 + " days ago", "1"]
)
def test_a_date_that_makes_no_sense_is_refused(text: str) -> None:
    with pytest.raises(DateError, match="is no date"):
        parse_date(text, NOW)


def test_a_date_with_a_zone_is_that_instant() -> None:
    assert parse_date("2026-11-01T14:30+00:00", NOW).first_s == 1793543400.0
