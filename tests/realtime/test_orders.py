"""Orders to a loop that runs: stops, changed gains, and a run that only reads."""

import threading
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pamctl.realtime.gain_ramp import SHORTEST_RAMP_S, GainRamp, GainRampError, blend_gains
from pamctl.realtime.orders import MARK_SLOT_BYTES, SESSION_SLOT_BYTES, OrderError, Orders
from pamctl.realtime.tick import TickSetup
from pamctl.settings.build import build_tick_setup
from pamctl.settings.resolve import resolve


@pytest.fixture
def slot() -> memoryview:
    return memoryview(bytearray(MARK_SLOT_BYTES))


@pytest.fixture
def orders(slot: memoryview) -> Orders:
    return Orders(slot)


def test_an_order_is_taken_once(orders):
    orders.send({"do": "mark", "text": "here"})
    assert not orders.is_free
    assert orders.take() == {"do": "mark", "text": "here"}
    assert orders.take() is None
    assert orders.is_free


def test_a_second_order_waits_until_the_first_was_taken(orders):
    orders.send({"do": "stop", "reason": "first"})
    with pytest.raises(OrderError, match="not taken"):
        orders.send({"do": "stop", "reason": "second"})
    assert orders.take() == {"do": "stop", "reason": "first"}


def test_what_does_not_fit_is_refused_and_leaves_the_slot_free(orders):
    with pytest.raises(OrderError, match="exceed"):
        orders.send({"text": "x" * MARK_SLOT_BYTES})
    assert orders.is_free


def test_an_order_that_nobody_takes_is_reported_in_time(orders):
    orders.send({"do": "mark", "text": ""})
    with pytest.raises(OrderError, match="within"):
        orders.wait_until_taken(0.02)
    with pytest.raises(OrderError, match="ended"):
        orders.wait_until_taken(10.0, lambda: False)


def test_the_emergency_stop_needs_no_free_slot(orders):
    orders.send({"do": "mark", "text": ""})
    assert not orders.emergency
    orders.stop_now()
    assert orders.emergency


@given(st.lists(st.dictionaries(st.text(), st.floats() | st.integers() | st.text()), max_size=5))
def test_orders_arrive_as_they_were_sent(sent):
    orders = Orders(memoryview(bytearray(SESSION_SLOT_BYTES)))
    for order in sent:
        orders.send(order)
        taken = orders.take()
        assert taken is not None
        assert repr(sorted(taken.items())) == repr(sorted(expected(order).items()))


def expected(order: dict[str, object]) -> dict[str, object]:
    """The log's JSON reads three texts as floats: orders are the daemon's own, and hold none."""
    spelled = {"nan": float("nan"), "inf": float("inf"), "-inf": float("-inf")}
    return {k: spelled.get(v, v) if isinstance(v, str) else v for k, v in order.items()}


def test_two_processes_share_it(slot, orders):
    """A thread stands for the loop: the slot knows processes only by their memory."""
    other = Orders(slot)
    taken = []

    def loop() -> None:
        while len(taken) < 200:
            order = other.take()
            if order is not None:
                taken.append(order["n"])

    thread = threading.Thread(target=loop)
    thread.start()
    for n in range(200):
        orders.send({"n": n})
        orders.wait_until_taken(10.0)
    thread.join()
    other.close()
    assert taken == list(range(200))


# --- gains ramp ----------------------------------------------------------------------------------

SETTINGS = resolve()


def controller(*overrides: str, name: str = "qsmc") -> Any:
    return resolve(controller=name, overrides=overrides).controller


def poles(tuning: GainRamp, times_s: list[float]) -> list[float]:
    return [tuning.at(t).gains.sliding.pole_per_s for t in times_s]


def tuning() -> GainRamp:
    return GainRamp(build_tick_setup(SETTINGS), SETTINGS.controller)


def test_a_gain_goes_from_old_to_new_in_equal_steps_and_stays_there():
    tuned = tuning()
    new = controller("controller.lambda_per_s=40")
    (old_pole,) = poles(tuned, [1.0])
    tuned.change(new, 1.0, 0.5)
    found = poles(tuned, [1.0, 1.125, 1.25, 1.5, 9.0])
    new_pole = 40.0**1.75
    quarter = 0.25 * (new_pole - old_pole)
    assert found[:3] == pytest.approx([old_pole, old_pole + quarter, old_pole + 2 * quarter])
    assert found[3:] == [new_pole, new_pole]


def test_no_ramp_is_shorter_than_fifty_ticks():
    tuned = tuning()
    (old,) = poles(tuned, [1.0])
    tuned.change(controller("controller.lambda_per_s=40"), 1.0, 0.0)
    (first,) = poles(tuned, [1.001])
    assert first - old == pytest.approx((40.0**1.75 - old) * 1e-3 / SHORTEST_RAMP_S)


def test_a_change_on_the_way_goes_on_from_the_gains_of_the_moment():
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
def test_what_is_another_law_is_refused_and_changes_nothing(other, said):
    tuned = tuning()
    before = tuned.at(1.0)
    with pytest.raises(GainRampError, match=said):
        tuned.change(controller(*other[1], name=other[0]), 1.0, 0.5)
    assert tuned.at(2.0) is before


def test_between_runs_another_law_is_taken_at_once():
    tuned = tuning()
    pid = controller(name="pid")
    tuned.replace(pid)
    assert tuned.at(0.0) == build_tick_setup(SETTINGS.model_copy(update={"controller": pid}))


@given(share=st.floats(0, 1), low=st.floats(1, 60), high=st.floats(1, 60))
def test_gains_on_the_way_lie_between_the_two_ends(share, low, high):
    ends: list[TickSetup] = [
        build_tick_setup(resolve(overrides=[f"controller.lambda_per_s={value!r}"]))
        for value in (low, high)
    ]
    pole = blend_gains(ends[0], ends[1], share).gains.sliding.pole_per_s
    bounds = sorted(end.gains.sliding.pole_per_s for end in ends)
    assert bounds[0] * (1 - 1e-12) <= pole <= bounds[1] * (1 + 1e-12)
