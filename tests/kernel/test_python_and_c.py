"""What a kernel gives as C is what it gives as Python, or it is refused with its line."""

from __future__ import annotations

import math
import os
import struct
import subprocess
import sys
from array import array
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest

from pamctl.kernel.calls import Machine, machine, prepare
from pamctl.kernel.expressions import NotInC

INF, NAN = math.inf, math.nan


def run(call: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the bits that a call leaves in its first argument, or the error that it raises."""
    out = array("d", [7.0] * 8)
    try:
        call(out, *arguments)
    except Exception as error:
        return (type(error),)
    return tuple(struct.unpack("8q", out.tobytes()))


def agree(kernel: Callable[..., Any], *arguments: Any) -> bool:
    """Tell whether the kernel leaves the same bits as C and as Python, or raises the same."""
    call = machine(kernel)
    given = run(call, arguments)
    assert all(function is not None for _, function in call._variants)
    return given == run(kernel, arguments)


def refuses(kernel: Callable[..., Any], why: str, *arguments: Any) -> None:
    """Check that a kernel is refused, with the file, a line, and the reason."""
    with pytest.raises(NotInC, match=rf"test_python_and_c.py:\d+: .*{why}"):
        Machine(kernel)(array("d", [7.0] * 8), *arguments)


# --- names -----------------------------------------------------------------------------------


def use_names_of_c(out, x):
    all = x + 1.0
    row = all + 1.0
    count_4 = row + 1.0
    end_4 = 3
    for k in range(end_4):
        count_4 = count_4 + 2.0
        end_4 = end_4 + k
    all, row = row, all
    place, place_, get, failed, double = count_4, x, all, row, 4.0
    exp = math.exp(0.5)
    linux, unix, asm, _Bool, NAN, INFINITY, true = x, x, x, x, x, x, x  # noqa: N806
    pam_double_of, Numbers, isnan, done, words, run = x, x, x, x, x, x  # noqa: N806
    out[0] = all + 10.0 * row + 100.0 * count_4 + 1000.0 * end_4
    out[1] = place + 10.0 * place_ + 100.0 * get + 1000.0 * failed + double
    out[2] = exp + linux + unix + asm + _Bool + NAN + INFINITY + true + double_of(x)
    out[3] = pam_double_of + Numbers + isnan + done + words + run


def double_of(given_x):
    given_x = given_x * 1.0
    return given_x * 2.0


def test_names_that_c_uses_itself_are_names_like_others():
    assert agree(use_names_of_c, 0.3)


class Six(NamedTuple):
    all: float = 1.0
    row: float = 2.0
    place: float = 3.0
    place_: float = 4.0
    linux: float = 5.0
    NAN: float = 6.0


class Rows(NamedTuple):  # as C's own type is called
    all: float = 1.0


class numbers(NamedTuple):  # noqa: N801
    all: float = 1.0


def use_fields(out, six, row, rows):
    given_six = six
    six = Six(six.row, six.all, six.place_, six.place, six.NAN, six.linux)
    all, row_, place, place_, linux, _ = six
    out[0] = all + 10.0 * row_ + 100.0 * place + 1000.0 * place_ + 10000.0 * linux
    out[1] = given_six.all + row.all + rows.all


def test_fields_and_named_tuples_may_have_names_that_c_uses():
    assert agree(use_fields, Six(), Rows(2.0), numbers(3.0))


def give_result(all, place):
    return all + 1.0, place + 2.0


class Named(NamedTuple):
    place: float
    failed: float


def give_named(first, second):
    return Named(first + 1.0, second + 2.0)


def test_results_go_to_the_arguments_of_their_names_in_any_order():
    call = prepare(give_result, {"place": 10.0, "all": 20.0}, updates=("all", "place"))
    call.run()
    assert call.is_native
    assert (call.get("all"), call.get("place")) == (21.0, 12.0)
    call = prepare(give_named, {"first": 1.0, "second": 2.0}, updates=("second", "first"))
    call.run()
    assert call.is_native
    assert (call.get("second"), call.get("first")) == (2.0, 4.0)


def give_quotients(all, place):
    return all + 1.0, all / place


def test_a_call_that_fails_raises_as_python_does_and_changes_no_argument():
    call = prepare(give_quotients, {"all": 1.0, "place": 0.0}, updates=("all", "place"))
    assert call.is_native
    with pytest.raises(ZeroDivisionError):
        call.run()
    assert (call.get("all"), call.get("place")) == (1.0, 0.0)


def test_a_result_that_its_argument_cannot_hold_is_refused():
    for value in (1, True):
        with pytest.raises(NotInC, match="give_result: its results"):
            prepare(give_result, {"all": 2.0, "place": value}, updates=("all", "place"))


# --- assignment --------------------------------------------------------------------------------


def exchange(out, x, y):
    x, y = y, x + 1.0
    out[0], out[1] = y, x
    k = 2
    k, out[k] = 3, x
    out[k], k = y, 4
    x = y = 5.0
    out[k] = x + y


def test_pairs_are_assigned_after_all_of_them_are_computed_and_from_left_to_right():
    assert agree(exchange, 1.0, 2.0)


def assign_twice(out, x):
    x = out[0] = y = x + 1.0
    out[1] = x + 10.0 * y


def assign_item_first(out, x):
    out[0] = x = x + 1.0
    out[1] = x


def test_the_value_of_two_targets_is_computed_once():
    assert agree(assign_twice, 1.0)
    refuses(assign_item_first, "its first target is no variable", 1.0)


class Large(NamedTuple):
    a: float = 1.0
    b: float = 2.0
    c: float = 3.0
    d: float = 4.0
    e: float = 5.0


def rotate(large):
    return Large(large.b, large.c, large.d, large.e, large.a)


def pass_by_address(out, large):
    first = large
    large = rotate(large)
    large = rotate(large) if large.a > 1.0 else large
    out[0] = large.a + 10.0 * large.b + 100.0 * large.c + 1000.0 * large.d
    out[1] = rotate(Large(first.b, 9.0)).a + rotate(rotate(first)).a


def test_a_struct_given_by_its_address_may_be_assigned_from_its_own_result():
    assert agree(pass_by_address, Large())


def maybe_unset(out, x):
    if x > 0.0:
        y = x
    out[0] = y


def unset_after_loop(out, n):
    for k in range(n):
        out[k] = 1.0
    out[0] = k * 1.0


def unset_before(out, x):
    out[0] = double_of(x)  # noqa: F823
    double_of = x  # noqa: F841


def set_in_every_way(out, n):
    k = 5
    for k in range(n):
        out[k] = 1.0
        k = k + 2
    if n > 2:
        y = 1.0
    elif n > 1:
        y = 2.0
    else:
        return
    while True:
        z = y
        if z > 0.5:
            break
    out[5] = y + k + z


def test_a_variable_that_may_have_no_value_is_refused():
    refuses(maybe_unset, "may have no value", 1.0)
    refuses(unset_after_loop, "may have no value", 3)
    refuses(unset_before, "may have no value|double_of", 3.0)
    for n in range(4):
        assert agree(set_in_every_way, n)


def end_without_return(x):  # noqa: RET503
    if x > 0.0:
        return x


def call_without_return(out, x):
    out[0] = end_without_return(x)


def search(x):
    while True:
        x = x * 0.5
        if x < 1.0:
            return x


def call_search(out, x):
    out[0] = search(x)


def test_a_function_that_may_end_without_its_result_is_refused():
    refuses(call_without_return, "without its result", 1.0)
    assert agree(call_search, 9.0)


# --- types of variables ------------------------------------------------------------------------


def mix_numbers(out, n, x):
    total = 0
    for k in range(n):
        total = total + k * x
    out[0] = math.copysign(1.0, -total)


def choose_mixed(out, x):
    out[0] = -(x if x > 0.0 else 0)


def give_mixed(x):
    if x > 0.0:
        return x
    return 0


def use_mixed(out, x):
    out[0] = -give_mixed(x)


def largest_mixed(out, x):
    out[0] = -max(0, x)


def fill_mixed(out, x):
    six = Six(0, x)
    out[0] = -six.all


def test_an_int_that_would_become_a_float_is_refused_since_minus_zero_is_no_int():
    refuses(mix_numbers, "int", 0, 1.0)
    refuses(choose_mixed, "int", -1.0)
    refuses(use_mixed, "int", -1.0)
    refuses(largest_mixed, "int", -1.0)
    refuses(fill_mixed, "int", -1.0)


def compare_mixed(out, n, x):
    out[0] = 1.0 if n == x else 2.0
    out[1] = 1.0 if n > x else 2.0
    out[2] = n / 3
    out[3] = 1.0 if n / 3 > x else n / 7
    out[4] = n * x + n


def test_ints_and_floats_are_compared_and_divided_as_python_does():
    for n in (0, 5, -5, 2**53, 2**53 + 1, 2**62 + 1, -(2**53) - 1, 2**63 - 1, -(2**63)):
        for x in (float(n), 0.5, INF, -INF, NAN, -0.0):
            assert agree(compare_mixed, n, x), (n, x)


def chain(out, x, y):
    out[0] = 1.0 if x < y < 3.0 else 2.0
    out[1] = 1.0 if not x <= y != 2.0 else 2.0
    out[2] = 1.0 if not x else 2.0
    out[3] = 1.0 if x else 2.0
    out[4] = 1.0 if bool(x) and not (x == y) else 2.0  # noqa: SIM201
    out[5] = max(x, y, 1.0) + 2.0 * min(y, x)
    flag = x > y
    out[6] = flag + flag + 0.5
    out[7] = -flag + abs(flag) + float(flag) + int(flag) + 0.0


def test_chains_and_truth_of_numbers_hold_for_nan_and_zeros():
    for x in (NAN, 0.0, -0.0, 1.0, 2.0, INF):
        for y in (NAN, 0.0, -0.0, 2.0, -INF):
            assert agree(chain, x, y), (x, y)


def divide(out, x, y):
    out[0] = x % y
    out[1] = x // y
    out[2] = -x


def test_remainders_of_floats_are_those_of_python():
    numbers = (0.0, -0.0, 1.0, -1.0, 0.1, -0.3, 7.5, -7.5, 1e300, INF, -INF, NAN, 5e-324)
    for x in numbers:
        for y in numbers:
            assert agree(divide, x, y), (x, y)


def divide_ints(out, n, m):
    out[0] = n % m * 1.0
    out[1] = n // m * 1.0
    out[2] = (n << 2) * 1.0
    out[3] = (n >> m if m >= 0 else -n) * 1.0
    out[4] = (n & m | n ^ 3) * 1.0
    out[5] = abs(n) * 1.0 + n * m
    out[6] = 1.0 if n == m else n - m + 0.5


def test_ints_are_those_of_python_or_python_computes():
    numbers = (0, 1, -1, 2, -2, 3, -7, 7, 64, 2**31, -(2**31), 2**62, -(2**62), 2**63 - 1, -(2**63))
    for n in numbers:
        for m in numbers:
            assert agree(divide_ints, n, m), (n, m)


def count_far(out, n):
    out[0] = 1.0 if n < 9223372036854775808 else 2.0


def count_near(out, n):
    out[0] = 1.0 if n < -9223372036854775807 else 2.0
    out[1] = 1.0 if n == 9223372036854775807 else 2.0


def test_an_int_of_more_than_64_bits_is_refused():
    refuses(count_far, "64 bits", 1)
    for n in (0, 2**63 - 1, -(2**63)):
        assert agree(count_near, n)


def round_down(out, x):
    out[0] = math.floor(x) * 1.0
    out[1] = math.ceil(x) * 1.0
    out[2] = int(x) * 1.0


def test_rounding_what_is_no_number_raises():
    for x in (0.5, -0.5, -0.0, 1e17, 9.3e18, 1e300, INF, -INF, NAN):
        assert agree(round_down, x), x


def index_from_end(out, k):
    out[k] = out[-1] + out[-8]


def test_indices_count_from_the_end_and_raise_outside():
    for k in (0, 7, 8, -1, -8, -9, 2**62):
        assert agree(index_from_end, k), k


def raise_to(out, x, y):
    out[0] = x**y
    out[1] = math.pow(x, y)
    out[2] = pow(x, 2.0)


def test_powers_are_those_of_python():
    numbers = (0.0, -0.0, 1.0, -1.0, 0.5, 2.0, 3.0, -3.0, 1e200, 1e-200, INF, -INF, NAN)
    for x in numbers:
        for y in numbers:
            if x < 0.0 and x > -INF and math.isfinite(y) and y != math.floor(y):
                continue  # Python gives a complex number, which no array takes
            assert agree(raise_to, x, y), (x, y)


def raise_int(out, n):
    out[0] = pow(n, 2) / 2.0


def log_to_base(out, x):
    out[0] = math.log(x, 2.0)


def pow_with_modulus(out, n):
    out[0] = pow(n, 2, 3)


def test_functions_with_arguments_that_c_does_not_take_are_refused():
    refuses(raise_int, "", 3)
    refuses(log_to_base, "", 8.0)
    refuses(pow_with_modulus, "", 8)


def call_math(out, x):
    out[0] = math.exp(x)
    out[1] = math.log(x)
    out[2] = math.sqrt(x)
    out[3] = math.sin(x) + math.atan2(x, -0.0)
    out[4] = math.tanh(x) + math.cosh(x)
    out[5] = math.log1p(x) + math.expm1(x)
    out[6] = math.copysign(1.0, x)


def test_the_functions_of_math_raise_where_python_raises():
    for x in (0.0, -0.0, 1.0, 0.3, 2.5, 710.0, -746.0, INF, -INF, NAN, -1.0, 5e-324):
        assert agree(call_math, x), x


# --- flow --------------------------------------------------------------------------------------


def find_first(out, x):
    for k in range(len(out)):
        if out[k] > x:
            return k
        if k == 3:
            break
    return -1


def call_find(out, x):
    out[4] = 9.0
    n = 3
    for n in range(find_first(out, 7.5) + n):  # noqa: B020
        if n == 1:
            continue
        out[n] = n + 0.5
    out[5] = n + 0.0
    out[6] = find_first(out, x) + 0.0


def test_loops_end_early_and_leave_their_variable():
    for x in (0.0, 1.0, 2.0, 100.0):
        assert agree(call_find, x)


def count_down(out, steps, n):
    k = 0
    while n > 0:
        n = n - steps[k]
        k = k + 1
    out[0] = k + 0.0


def count_up(out, n):
    k = n
    for k in range(n * n * n * n):
        out[k] = 1.0
    while k < 9:
        k = k - n * n * n * n


def test_a_loop_ends_where_python_would_have_raised():
    for n in (3, 4):
        assert agree(count_down, np.array([1, 1, 1]), n)
    assert agree(count_up, 2**16 - 1)


def shift(x, by=0.5, *, factor=2.0):
    return (x + by) * factor


def add_to(x, by=0.5):
    return x + by


def call_by_keyword(out, x):
    out[0] = add_to(x) + add_to(by=2.0 * x, x=1.0)


def call_keyword_only(out, x):
    out[0] = shift(x, factor=3.0)


def call_double_given(out, x):
    out[0] = add_to(x, x=2.0)  # type: ignore[misc]


def test_arguments_by_name_and_by_default():
    assert agree(call_by_keyword, 0.3)
    refuses(call_keyword_only, "", 0.3)
    refuses(call_double_given, "", 0.3)


def recurse(x):
    return recurse(x - 1.0) if x > 0.0 else x


def call_recursion(out, x):
    out[0] = recurse(x)


def test_a_function_that_calls_itself_is_refused():
    refuses(call_recursion, "calls itself", 1.0)


def decorate(function):
    import functools

    @functools.wraps(function)
    def twice(x):
        return 2.0 * function(x)

    return twice


def make_closure(factor):
    def scale(x):
        return factor * x

    return scale


@decorate
def decorated(x):
    return x


factor = 5.0
closure = make_closure(2.0)


def call_decorated(out, x):
    out[0] = decorated(x)


def call_closure(out, x):
    out[0] = closure(x)


def call_starred(out, x):
    out[0] = max(*(x, 2.0))


def test_functions_that_are_more_than_their_source_are_refused():
    for kernel in (call_decorated, call_closure, call_starred):
        refuses(kernel, "", 1.0)


def test_a_function_without_a_source_file_is_computed_in_python():
    made: dict[str, Any] = {"__name__": "made"}
    exec("def fill(out, x): out[0] = x", made)
    out = array("d", [0.0])
    machine(made["fill"])(out, 1.0)
    assert out[0] == 1.0


def put_and_give(out, k):
    out[k] = out[k] + 1.0
    return out[k]


def call_in_order(out, k):
    out[1] = out[0] + put_and_give(out, k) * out[0]


def call_alone(out, k):
    x = put_and_give(out, k)
    out[1] = x + out[0]


def test_a_call_that_changes_an_array_is_a_statement_of_its_own():
    refuses(call_in_order, "changes an array", 0)
    assert agree(call_alone, 0)


TABLE = (1.0, 2.0, 3.0)
GRID = np.ones((2, 2))


def put_into_constant(out, x):
    TABLE[0] = x  # type: ignore[index]
    out[0] = TABLE[0]


def read_constant(out, x):
    out[0] = TABLE[1] + TABLE[-1] + x


def read_grid(out, x):
    out[0] = GRID[0, 0] + x


def test_a_constant_table_is_read_and_never_written():
    refuses(put_into_constant, "", 1.0)
    assert agree(read_constant, 1.0)
    refuses(read_grid, "", 1.0)


def join_pairs(out, x):
    pair = (1, 2.0)
    if x > 0.0:
        pair = (x > 1.0, 2.0)
    n, y = pair
    out[n] = y


def test_tuples_of_other_types_are_not_one_variable():
    refuses(join_pairs, "elsewhere", 1.0)


# --- calls -------------------------------------------------------------------------------------


def halve(out, n):
    out[0] = n / 2
    out[1] = n // 2 + 0.0


def copy_all(out, values):
    for k in range(len(values)):
        out[k] = values[k]


def test_every_call_gets_the_code_of_its_own_types():
    for n in (3, 2.5, True, 3, -0.0, 2**70):
        assert agree(halve, n), n


def test_an_array_of_another_byte_order_or_width_is_not_read_as_if_it_were_none():
    out = array("d", [7.0] * 8)
    for wrong in (np.arange(3.0).astype(">f8"), np.arange(3.0, dtype=np.float32)):
        with pytest.raises(TypeError, match="array"):
            machine(copy_all)(out, wrong)
    odd = np.frombuffer(b"\0" + np.arange(3.0).tobytes(), offset=1)
    with pytest.raises(TypeError, match="array"):
        machine(copy_all)(out, odd)


RATE = 2.0


def scale_by_rate(x):
    return RATE * x


def test_machine_code_is_that_of_the_numbers_and_the_modules_that_it_uses(monkeypatch, tmp_path):
    for rate in (2.0, 3.0):
        monkeypatch.setitem(scale_by_rate.__globals__, "RATE", rate)
        call = prepare(scale_by_rate, {"x": 5.0}, updates=("x",))
        call.run()
        assert call.get("x") == 5.0 * rate
    program = (
        "from outer import f; from pamctl.kernel.calls import prepare; "
        "c = prepare(f, {'x': 1.0}, ('x',)); c.run(); print(c.get('x'))"
    )
    (tmp_path / "outer.py").write_text("from inner import g\ndef f(x):\n    return g(x)\n")
    for factor in ("2.0", "3.0"):
        (tmp_path / "inner.py").write_text(f"def g(x):\n    return {factor} * x\n")
        done = subprocess.run(
            [sys.executable, "-B", "-c", program],
            env=os.environ | {"PYTHONPATH": str(tmp_path)},
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert done.stdout.strip() == factor
