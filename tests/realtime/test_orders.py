"""The slot that orders go through: one at a time, whole, and without a lock."""

from __future__ import annotations

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pamctl.realtime.orders import MARK_SLOT_BYTES, SESSION_SLOT_BYTES, OrderError, Orders


@pytest.fixture
def slot() -> memoryview:
    return memoryview(bytearray(MARK_SLOT_BYTES))


@pytest.fixture
def orders(slot: memoryview) -> Orders:
    return Orders(slot)


def test_an_empty_slot_holds_no_order(orders: Orders) -> None:
    assert orders.take() is None
    assert orders.is_free


def test_an_order_is_taken_once(orders: Orders) -> None:
    orders.send({"do": "mark", "text": "here"})
    assert not orders.is_free
    assert orders.take() == {"do": "mark", "text": "here"}
    assert orders.take() is None
    assert orders.is_free


def test_a_second_order_waits_until_the_first_was_taken(orders: Orders) -> None:
    orders.send({"do": "stop", "reason": "first"})
    with pytest.raises(OrderError, match="not taken"):
        orders.send({"do": "stop", "reason": "second"})
    assert orders.take() == {"do": "stop", "reason": "first"}


def test_what_does_not_fit_is_refused_and_leaves_the_slot_free(orders: Orders) -> None:
    with pytest.raises(OrderError, match="exceed"):
        orders.send({"text": "x" * MARK_SLOT_BYTES})
    assert orders.is_free


def test_an_order_that_nobody_takes_is_reported_in_time(orders: Orders) -> None:
    orders.send({"do": "mark", "text": ""})
    with pytest.raises(OrderError, match="within"):
        orders.wait_until_taken(0.02)
    with pytest.raises(OrderError, match="ended"):
        orders.wait_until_taken(10.0, lambda: False)


def test_the_emergency_stop_needs_no_free_slot(orders: Orders) -> None:
    orders.send({"do": "mark", "text": ""})
    assert not orders.emergency
    orders.stop_now()
    assert orders.emergency


@given(st.lists(st.dictionaries(st.text(), st.floats() | st.integers() | st.text()), max_size=5))
def test_orders_arrive_as_they_were_sent(sent: list[dict[str, object]]) -> None:
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


def test_two_processes_share_it(slot: memoryview, orders: Orders) -> None:
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
