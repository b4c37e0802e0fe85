"""Gains that change while the loop runs: on a ramp, and within one law only."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pamctl.realtime.gain_ramp import SHORTEST_RAMP_S, GainRamp, GainRampError, blend_gains
from pamctl.realtime.tick import TickSetup
from pamctl.settings.build import build_tick_setup
from pamctl.settings.resolve import resolve

SETTINGS = resolve()


def controller(*overrides: str, name: str = "qsmc") -> Any:
    return resolve(controller=name, overrides=overrides).controller


def poles(tuning: GainRamp, times_s: list[float]) -> list[float]:
    return [tuning.at(t).gains.sliding.pole_per_s for t in times_s]


def tuning() -> GainRamp:
    return GainRamp(build_tick_setup(SETTINGS), SETTINGS.controller)


def test_without_a_change_the_setup_is_the_same_object_in_every_tick() -> None:
    setup = build_tick_setup(SETTINGS)
    assert all(GainRamp(setup, SETTINGS.controller).at(t) is setup for t in (0.0, 1.0, 1e6))


def test_a_gain_goes_from_old_to_new_in_equal_steps_and_stays_there() -> None:
    tuned = tuning()
    new = controller("controller.lambda_per_s=40")
    (old_pole,) = poles(tuned, [1.0])
    tuned.change(new, 1.0, 0.5)
    found = poles(tuned, [1.0, 1.125, 1.25, 1.5, 9.0])
    new_pole = 40.0**1.75
    quarter = 0.25 * (new_pole - old_pole)
    assert found[:3] == pytest.approx([old_pole, old_pole + quarter, old_pole + 2 * quarter])
    assert found[3:] == [new_pole, new_pole]


def test_after_the_ramp_the_setup_is_that_of_a_run_with_the_new_gains() -> None:
    tuned = tuning()
    new = controller("controller.lambda_per_s=40", "controller.lpf2_hz=90")
    tuned.change(new, 1.0, 0.5)
    assert tuned.at(1.6) == build_tick_setup(SETTINGS.model_copy(update={"controller": new}))


def test_no_ramp_is_shorter_than_fifty_ticks() -> None:
    tuned = tuning()
    (old,) = poles(tuned, [1.0])
    tuned.change(controller("controller.lambda_per_s=40"), 1.0, 0.0)
    (first,) = poles(tuned, [1.001])
    assert first - old == pytest.approx((40.0**1.75 - old) * 1e-3 / SHORTEST_RAMP_S)


def test_a_change_on_the_way_goes_on_from_the_gains_of_the_moment() -> None:
    tuned = tuning()
    tuned.change(controller("controller.lambda_per_s=40"), 1.0, 1.0)
    (halfway,) = poles(tuned, [1.5])
    tuned.change(controller("controller.lambda_per_s=30"), 1.5, 1.0)
    found = poles(tuned, [1.5, 2.0, 2.5])
    assert found[0] == halfway
    assert found[1] == pytest.approx(0.5 * (halfway + 30.0**1.75))
    assert found[2] == 30.0**1.75


@pytest.mark.parametrize(
    ("other", "said"),
    [
        (("pid", []), "another law"),
        (("smc", []), "another law"),
        (("qsmc", ["controller.length_unit=inch"]), "length_unit"),
        (("qsmc", ["controller.reaching_law=eta"]), "reaching_law"),
    ],
)
def test_what_is_another_law_is_refused_and_changes_nothing(
    other: tuple[str, list[str]], said: str
) -> None:
    tuned = tuning()
    before = tuned.at(1.0)
    with pytest.raises(GainRampError, match=said):
        tuned.change(controller(*other[1], name=other[0]), 1.0, 0.5)
    assert tuned.at(2.0) is before


def test_between_runs_another_law_is_taken_at_once() -> None:
    tuned = tuning()
    pid = controller(name="pid")
    tuned.replace(pid)
    assert tuned.at(0.0) == build_tick_setup(SETTINGS.model_copy(update={"controller": pid}))


@given(share=st.floats(0, 1), low=st.floats(1, 60), high=st.floats(1, 60))
def test_gains_on_the_way_lie_between_the_two_ends(share: float, low: float, high: float) -> None:
    ends: list[TickSetup] = [
        build_tick_setup(resolve(overrides=[f"controller.lambda_per_s={value!r}"]))
        for value in (low, high)
    ]
    pole = blend_gains(ends[0], ends[1], share).gains.sliding.pole_per_s
    bounds = sorted(end.gains.sliding.pole_per_s for end in ends)
    assert bounds[0] * (1 - 1e-12) <= pole <= bounds[1] * (1 + 1e-12)
