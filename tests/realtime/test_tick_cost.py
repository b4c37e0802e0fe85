"""A rate that this PC cannot hold is named before the valve moves."""

from __future__ import annotations

import math
from itertools import count
from typing import Any

import pytest
from support.runs import run_settings

from pamctl.kernel.calls import PlainCall
from pamctl.processes import compose_loop
from pamctl.realtime import run_ticks
from pamctl.realtime.tick import step
from pamctl.realtime.tick_runner import (
    BUSY_SHARE,
    LIVE_FACTOR,
    TickCost,
    TickRunner,
    rehearse_tick_s,
)
from pamctl.settings.build import build_tick_setup
from pamctl.settings.resolve import resolve

SETUP = build_tick_setup(run_settings())


def test_a_rehearsal_takes_the_median_of_the_times_that_its_clock_shows() -> None:
    clock = count(0, 20_000)
    assert rehearse_tick_s(SETUP, 1e-3, lambda: next(clock)) == pytest.approx(20e-6)


@pytest.mark.parametrize("law", ["qsmc", "smc", "pid"])
def test_a_rehearsed_tick_computes_the_law_and_is_admitted(
    law: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A tripped tick is shorter: the estimate would promise too much."""
    seen = []

    def watch(*arguments: Any) -> Any:
        seen.append(step(*arguments))
        return seen[-1]

    monkeypatch.setattr(run_ticks, "step", watch)
    setup = build_tick_setup(resolve(controller=law))
    rehearse_tick_s(setup, 1e-4, tick=TickRunner(setup, PlainCall))
    assert len(seen) == 100
    assert not any(decision.tripped for _, decision in seen)
    assert all(math.isfinite(state.command.command_v) for state, _ in seen[1:])


def test_a_rate_is_held_up_to_half_of_the_period_and_named_beyond() -> None:
    cost = TickCost.estimate(10e-6)
    assert cost.live_s == pytest.approx(LIVE_FACTOR * 10e-6)
    assert cost.held_hz == pytest.approx(BUSY_SHARE / cost.live_s)
    assert cost.find_warning(cost.held_hz) == ""
    warning = cost.find_warning(10_000.0)
    assert warning.startswith("rate_hz 10000 leaves 100 us for a tick that takes about 60 us")
    assert "About 8333 Hz can be held" in warning


def test_the_calls_of_a_slow_card_lower_the_rate() -> None:
    assert TickCost.estimate(10e-6, calls_s=190e-6).held_hz == pytest.approx(2000.0)


def test_a_run_that_cannot_hold_its_rate_says_so_in_one_line_and_in_its_log(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = run_settings()
    monkeypatch.setattr(compose_loop, "rehearse_tick_s", lambda *_, **__: 1e-3)
    (event,) = compose_loop.check_rate(settings, SETUP)
    said = capsys.readouterr().err
    assert event["event"] == "rate_warning"
    assert said == f"warning: {event['detail']}\n"
    assert said.count("\n") == 1
    assert "takes about 6000 us" in said

    monkeypatch.setattr(compose_loop, "rehearse_tick_s", lambda *_, **__: 1e-6)
    assert compose_loop.check_rate(settings, SETUP) == []
    assert capsys.readouterr().err == ""
