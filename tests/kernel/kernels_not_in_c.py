"""One small kernel for each thing that a kernel may not use; the line it is in ends with `# no`."""

# ruff: noqa
from __future__ import annotations

import math
import random
from typing import NamedTuple


class Pair(NamedTuple):
    first: float
    second: int = 3


def use_a_list(x: float) -> float:
    items = [x, x]  # no
    return items[0]


def use_a_dict(x: float) -> float:
    return {1: x}[1]  # no


def use_text(x: float) -> float:
    name = "x"  # no
    return x


def try_something(x: float) -> float:
    try:  # no
        return 1.0 / x
    except ZeroDivisionError:
        return 0.0


def raise_an_error(x: float) -> float:
    if x > 0.0:
        raise ValueError("x")  # no
    return x


def check_by_assert(x: float) -> float:
    assert x > 0.0  # no
    return x


def import_inside(x: float) -> float:
    import cmath  # no

    return x


def delete_a_name(x: float) -> float:
    del x  # no
    return 0.0


def use_with(x: float) -> float:
    with x:  # no
        return x


def define_inside(x: float) -> float:
    def inner():  # no
        return x

    return x


def use_lambda(x: float) -> float:
    return (lambda: x)()  # no


def comprehend(x: float) -> float:
    return sum(x for _ in range(3))  # no


def count_down(n: int) -> int:
    total = 0
    for k in range(n, 0, -1):  # no
        total += k
    return total


def loop_over_items(x: float) -> float:
    for item in (x, x):  # no
        x += item
    return x


def loop_with_else(n: int) -> int:
    while n > 3:  # no
        n -= 1
    else:
        n = 0
    return n


def call_another_library(x: float) -> float:
    return random.random() + x  # no


def call_a_method(x: float) -> bool:
    return x.is_integer()  # no


def use_unknown_math(x: float) -> float:
    return math.gamma(x)  # no


def use_an_unknown_name(x: float) -> float:
    return x + nowhere  # no


def change_the_type(x: float) -> float:
    y = Pair(x)
    y = x  # no
    return y


def return_two_types(x: float) -> float:
    if x > 0.0:
        return x
    return Pair(x)  # no


def mix_and_with_numbers(x: float) -> float:
    return x and 1.0  # no


def assign_an_attribute(pair: Pair) -> Pair:
    pair.first = 2.0  # no
    return pair


def replace_a_field(pair: Pair) -> Pair:
    return pair._replace(first=2.0)  # no


def unpack_the_wrong_number(pair: Pair) -> float:
    a, b, c = pair  # no
    return a


def give_too_few(x: float) -> Pair:
    return Pair(second=1)  # no


def give_unknown_words(x: float) -> Pair:
    return Pair(x, third=1)  # no


def give_a_float_field_an_int(n: int) -> Pair:
    return Pair(n)  # no


def star_arguments(pair: Pair) -> Pair:
    return Pair(*pair)  # no


def use_a_slice(x: float) -> float:
    return (x, x)[:1]  # no


def shift_a_float(x: float) -> float:
    return x << 1  # no


def complement(n: int) -> int:
    return ~n  # no


def compare_by_in(x: float) -> bool:
    return x in (1.0, 2.0)  # no


def compare_by_is(x: float) -> bool:
    return x is True  # no


def yield_numbers(x: float):
    yield x  # no


def use_the_walrus(x: float) -> float:
    return (y := x) + y  # no


def use_match(x: float) -> float:
    match x:  # no
        case 1.0:
            return 2.0
    return x


def use_a_global(x: float) -> float:
    global COUNT  # no
    COUNT = x
    return x


def format_text(x: float) -> str:
    return f"{x}"  # no


def divide_ints_by_divmod(n: int) -> int:
    return divmod(n, 3)[0]  # no


def read_a_counter_after_its_loop(n: int) -> int:
    for k in range(n):
        pass
    return k  # no


def take_any_number(*x: float) -> float:  # no
    return 1.0


def take_only_words(*, x: float) -> float:  # no
    return x


def power_of_ints(a: int) -> int:
    return a**2  # no


ARGUMENTS = {"pair": Pair(1.0), "n": 3, "a": 3}
"""Others are floats."""
KERNELS = [its for its in dict(globals()).values() if getattr(its, "__module__", "") == __name__]
KERNELS.remove(Pair)
