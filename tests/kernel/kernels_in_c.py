"""One small kernel for each thing that a kernel may use, with arguments for it in `ARGUMENTS`."""

# ruff: noqa: RET504, RET505, RUF021, SIM201

from __future__ import annotations

import functools
import math
from math import copysign, exp
from typing import Any, NamedTuple


class Pair(NamedTuple):
    """A struct."""

    first: float
    second: int = 3


class Nested(NamedTuple):
    """A struct of structs, one of which may be missing."""

    pair: Pair
    missing: Pair | None
    register: float
    """C uses this name itself."""


SCALE = 2.5
TABLE = (1.0, 4.0, 9.0)
PAIR = Pair(1.5, 2)


def assign_and_add(x: float, k: int) -> float:
    y = z = x + 1.0
    y: float = y * 2.0
    y -= z / 4.0
    k += 2
    return y + k


def assign_a_tuple(x: float) -> float:
    a, (b) = x, x * 2.0
    a, b = b, a
    _, c = two_numbers(a)
    return a - b + c


def two_numbers(x: float) -> tuple[float, int]:
    return x + 1.0, 7


def branch(x: float, k: int) -> int:
    if x > 0.0 and not k == 3:
        return 1
    elif x != x or k >= 4:
        return 2
    else:
        pass
    return 3


def loop_while(x: float) -> int:
    k = 0
    while x > 1.0:
        x /= 2.0
        k += 1
        if k == 1:
            continue
        if k > 60:
            break
    return k


def loop_range(n: int) -> int:
    total = k = 0
    for k in range(n):
        for j in range(k, n):
            total += k * j
            n = 3
    return total + k if n else total


def change_the_counter(n: int) -> int:
    total = 0
    for k in range(n):
        k += 10
        total += k
    return total


def compare_in_chains(x: float, k: int) -> bool:
    return 0.0 <= x < 2.0 != k


def count_in_ints(a: int, b: int) -> int:
    return (a + b * 3 - a // b) % b ^ (a & b) | (a << 2) >> 1


def count_in_floats(x: float, y: float) -> float:
    return x % y + x // y - x**2 + +x - -y


def raise_to_a_power(x: float, y: float) -> float:
    return math.pow(x, 2.0) + abs(x) ** y


def choose(x: float, k: int) -> float:
    return x if k else 1.0 if x > 2.0 else 0.0


def use_names(x: float) -> float:
    return SCALE * x + TABLE[1] + TABLE[-1] + PAIR.first + PAIR.second + math.pi


def read_a_struct(nested: Nested, missing: Pair | None) -> float:
    first, second = nested.pair
    if nested.missing is None and missing is None:
        return first + second + nested.register
    return missing.first


def make_structs(x: float) -> Nested:
    pair = Pair(second=4, first=x)
    return Nested(pair, None, x + Pair(x).second)


def give_an_int_field_a_float(x: float) -> Pair:
    return Pair(x, x)


def call_math(x: float) -> float:
    low = math.sqrt(math.fabs(x)) + exp(-abs(x)) + math.log1p(abs(x)) + math.tanh(x)
    return low + copysign(1.0, x) + math.atan2(x, 2.0) + math.cos(x) + math.asin(math.sin(x))


def test_numbers(x: float) -> bool:
    return math.isfinite(x) or math.isnan(x) and not math.isinf(x)


def round_numbers(x: float, k: int) -> int:
    return round(x) + int(x) + math.floor(x) + math.ceil(x) + int(k) + bool(k) + int(float(k))


def find_extremes(x: float, k: int) -> float:
    return max(x, 1.0, float(k)) + min(k, 3) + abs(k) + max(1, k, 2)


def fill_array(values: Any, into: Any) -> None:
    """An array is given, and filled."""
    for k in range(len(values)):
        into[k] = values[k] + values[-1] + values.shape[0]


@functools.singledispatch
def serve(kind: Any, x: float) -> float:
    raise TypeError


@serve.register
def _(kind: Pair, x: float) -> float:
    return kind.first * x


def call_by_type(pair: Pair, x: float) -> float:
    return serve(pair, x)


def use_c_words(register: float, failed: float) -> float:
    volatile = register * 2.0
    get = volatile + failed
    return get


def return_nothing(x: float) -> None:
    if x > 0.0:
        return


ARGUMENTS: dict[Any, tuple[Any, ...]] = {
    assign_and_add: (1.5, 3),
    assign_a_tuple: (1.5,),
    branch: (1.5, 2),
    loop_while: (1e30,),
    loop_range: (6,),
    change_the_counter: (4,),
    compare_in_chains: (1.0, 5),
    count_in_ints: (-17, 5),
    count_in_floats: (-7.5, 2.0),
    raise_to_a_power: (-1.5, 0.3),
    choose: (3.0, 0),
    use_names: (0.1,),
    read_a_struct: (Nested(Pair(1.0, 2), None, 0.5), None),
    make_structs: (0.5,),
    give_an_int_field_a_float: (0.5,),
    call_math: (-0.3,),
    test_numbers: (math.inf,),
    round_numbers: (-2.5, -3),
    find_extremes: (0.5, -4),
    call_by_type: (Pair(2.0), 3.0),
    use_c_words: (1.0, 2.0),
    return_nothing: (1.0,),
}
