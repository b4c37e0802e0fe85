"""What a kernel gives as C is what it gives as Python, or it is refused with its line."""

import functools
import itertools
import linecache
import math
import os
import struct
import sys
from array import array
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from support.command_line import run_process

from pamctl.kernel.calls import machine, prepare
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


def assign_twice(out, x):
    x = out[0] = y = x + 1.0
    out[1] = x + 10.0 * y


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


def search(x):
    while True:
        x = x * 0.5
        if x < 1.0:
            return x


def call_search(out, x):
    out[0] = search(x)


# --- types of variables ------------------------------------------------------------------------


def compare_mixed(out, n, x):
    out[0] = 1.0 if n == x else 2.0
    out[1] = 1.0 if n > x else 2.0


def divide_mixed(out, n, x):
    out[0] = n / 3
    out[1] = 1.0 if n / 3 > x else n / 7
    out[2] = n * x + n


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


def divide(out, x, y):
    out[0] = x % y
    out[1] = x // y
    out[2] = -x


def divide_ints(out, n, m):
    out[0] = n % m * 1.0
    out[1] = n // m * 1.0
    out[2] = (n << 2) * 1.0
    out[3] = (n >> m if m >= 0 else -n) * 1.0
    out[4] = (n & m | n ^ 3) * 1.0
    out[5] = abs(n) * 1.0 + n * m
    out[6] = 1.0 if n == m else n - m + 0.5


def count_near(out, n):
    out[0] = 1.0 if n < -9223372036854775807 else 2.0
    out[1] = 1.0 if n == 9223372036854775807 else 2.0


def round_down(out, x):
    out[0] = math.floor(x) * 1.0
    out[1] = math.ceil(x) * 1.0
    out[2] = int(x) * 1.0


def index_from_end(out, k):
    out[k] = out[-1] + out[-8]


def raise_to(out, x, y):
    out[0] = x**y
    out[1] = math.pow(x, y)
    out[2] = pow(x, 2.0)


def call_math(out, x):
    out[0] = math.exp(x)
    out[1] = math.log(x)
    out[2] = math.sqrt(x)
    out[3] = math.sin(x) + math.atan2(x, -0.0)
    out[4] = math.tanh(x) + math.cosh(x)
    out[5] = math.log1p(x) + math.expm1(x)
    out[6] = math.copysign(1.0, x)


# --- flow --------------------------------------------------------------------------------------


def assign_in_every_way(out, x, k):
    y = z = x + 1.0
    y: float = y * 2.0
    y -= z / 4.0
    k += 2
    if y > 4.0 and not k == 3:  # noqa: SIM201
        out[0] = 1.0
    elif y != y or k >= 4:
        pass
    while x > 1.0:
        x /= 2.0
        if k == 5:
            k = 6
            continue
        out[1] += x
    for k in range(4):
        k += 10
        out[2] += k + 0.0
    out[3] = y + 1.0 * k


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


def add_to(x, by=0.5):
    return x + by


def call_by_keyword(out, x):
    out[0] = add_to(x) + add_to(by=2.0 * x, x=1.0)


def put_and_give(out, k):
    out[k] = out[k] + 1.0
    return out[k]


def call_alone(out, k):
    x = put_and_give(out, k)
    out[1] = x + out[0]


class Pair(NamedTuple):
    first: float
    second: int = 3


class Nested(NamedTuple):
    pair: Pair
    missing: Pair | None
    register: float


TABLE = (1.0, 2.0, 3.0)
PAIR = Pair(1.5, 2)


def read_constant(out, x):
    out[0] = TABLE[1] + TABLE[-1] + x + PAIR.first + PAIR.second + math.pi


def read_structs(out, nested, missing):
    first, second = nested.pair
    if nested.missing is None and missing is None:
        out[0] = first + second + nested.register
    else:
        out[0] = missing.first
    made = Nested(Pair(second=4, first=out[0]), None, out[0] + Pair(first).second)
    out[1] = made.pair.first + 10.0 * made.pair.second + made.register


@functools.singledispatch
def serve(kind: Any, x: float) -> float:
    raise TypeError


@serve.register
def _(kind: Pair, x: float) -> float:
    return kind.first * x


def call_by_type(out, pair, x):
    out[0] = serve(pair, x)


# --- calls -------------------------------------------------------------------------------------


def halve(out, n):
    out[0] = n / 2
    out[1] = n // 2 + 0.0


WHOLE = (0, 1, -1, 2, -2, 3, -7, 7, 64, 2**31, -(2**31), 2**62, -(2**62), 2**63 - 1, -(2**63))
NEAR = (0, 5, -5, 2**53, 2**53 + 1, 2**62 + 1, -(2**53) - 1, 2**63 - 1, -(2**63))
MIXED = [(n, x) for n in NEAR for x in (float(n), 0.5, INF, -INF, NAN, -0.0)]
FLOATS = (0.0, -0.0, 1.0, -1.0, 0.1, -0.3, 7.5, -7.5, 1e300, INF, -INF, NAN, 5e-324)
BASES = (0.0, -0.0, 1.0, -1.0, 0.5, 2.0, 3.0, -3.0, 1e200, 1e-200, INF, -INF, NAN)


def is_complex(x: float, y: float) -> bool:
    """Tell whether a power is a complex number, which no array takes."""
    return x < 0.0 and x > -INF and math.isfinite(y) and y != math.floor(y)


CALLS: list[tuple[Callable[..., Any], list[tuple[Any, ...]]]] = [
    (use_names_of_c, [(0.3,)]),
    (use_fields, [(Six(), Rows(2.0), numbers(3.0))]),
    (exchange, [(1.0, 2.0)]),
    (assign_twice, [(1.0,)]),
    (pass_by_address, [(Large(),)]),
    (set_in_every_way, [(n,) for n in range(4)]),
    (call_search, [(9.0,)]),
    (compare_mixed, MIXED),
    (divide_mixed, MIXED),
    (chain, [*itertools.product((NAN, 0.0, -0.0, 1.0, 2.0, INF), (NAN, 0.0, -0.0, 2.0, -INF))]),
    (divide, [*itertools.product(FLOATS, repeat=2)]),
    (divide_ints, [*itertools.product(WHOLE, repeat=2)]),
    (count_near, [(0,), (2**63 - 1,), (-(2**63),)]),
    (round_down, [(x,) for x in (0.5, -0.5, -0.0, 1e17, 9.3e18, 1e300, INF, -INF, NAN)]),
    (index_from_end, [(k,) for k in (0, 7, 8, -1, -8, -9, 2**62)]),
    (raise_to, [(x, y) for x in BASES for y in BASES if not is_complex(x, y)]),
    (call_math, [(x,) for x in (*FLOATS, 0.3, 2.5, 710.0, -746.0)]),
    (assign_in_every_way, [(1.5, 3), (1e9, 1), (NAN, 2), (-3.0, 4)]),
    (call_find, [(0.0,), (1.0,), (2.0,), (100.0,)]),
    # A loop ends where Python would have raised.
    (count_down, [(np.array([1, 1, 1]), n) for n in (3, 4)]),
    (count_up, [(2**16 - 1,)]),
    (call_by_keyword, [(0.3,)]),
    (call_alone, [(0,)]),
    (read_constant, [(1.0,)]),
    (read_structs, [(Nested(Pair(1.0, 2), None, 0.5), last) for last in (None, Pair(7.0))]),
    (call_by_type, [(Pair(2.0), 3.0)]),
    # Every call gets the code of its own types.
    (halve, [(n,) for n in (3, 2.5, True, 3, -0.0, 2**70)]),
]


@pytest.mark.parametrize(("kernel", "calls"), CALLS, ids=lambda its: getattr(its, "__name__", ""))
def test_a_kernel_leaves_the_same_bits_as_c_and_as_python_or_raises_the_same(kernel, calls):
    assert [given for given in calls if not agree(kernel, *given)] == []


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
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner/__init__.py").write_text(
        "from inner.gains import Gains\ndef g(x):\n    return Gains(x).factor * x\n"
    )
    head = "from typing import NamedTuple\nclass Gains(NamedTuple):\n    x: float\n"
    for factor in ("2.0", "3.0"):
        (tmp_path / "inner/gains.py").write_text(f"{head}    factor: float = {factor}\n")
        done = run_process(
            [sys.executable, "-B", "-c", program],
            env=os.environ | {"PYTHONPATH": str(tmp_path)},
            check=True,
        )
        assert done.stdout.strip() == factor


def fill_array(values, into):
    for k in range(len(values)):
        into[k] = values[k] + values[-1] + values.shape[0]


def test_arrays_of_python_and_of_numpy_are_filled():
    for make in (lambda n: array("d", range(n)), lambda n: np.arange(float(n))):
        values, into, expected = make(5), make(5), array("d", bytes(40))
        call = prepare(fill_array, {"values": values, "into": into})
        assert call.is_native
        call.run()
        fill_array(np.arange(5.0), expected)
        assert [*into] == [*expected]


def test_a_kernel_without_a_source_runs_in_python(capfd, monkeypatch):
    monkeypatch.setattr(os, "environ", {**os.environ})
    for name in ("PAMCTL_PLAIN_PYTHON", "PAMCTL_TOLD_PLAIN_PYTHON"):
        os.environ.pop(name, None)
    scope: dict[str, Any] = {"__name__": "typed_in"}
    exec("def kernel(x):\n    return 2.0 * x\n", scope)
    for _ in range(2):
        call = prepare(scope["kernel"], {"x": 1.5}, updates=("x",))
        assert not call.is_native
        call.run()
        assert call.get("x") == 3.0
    (line,) = capfd.readouterr().err.splitlines()
    assert line.endswith(": typed_in.kernel: its source cannot be read")


def test_a_kernel_of_a_notebook_is_built_again_when_it_changes():
    for factor in (2.0, 5.0):
        text = f"def kernel(x):\n    return {factor} * x\n"
        scope: dict[str, Any] = {"__name__": "notebook"}
        exec(compile(text, "<cell>", "exec"), scope)
        linecache.cache["<cell>"] = len(text), None, text.splitlines(True), "<cell>"
        call = prepare(scope["kernel"], {"x": 1.5}, updates=("x",))
        assert call.is_native
        call.run()
        assert call.get("x") == factor * 1.5
