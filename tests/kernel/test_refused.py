"""What a kernel may not use is refused with its file, its line and the reason."""

import functools
import math  # noqa: F401  the statements below use it
import random  # noqa: F401
from array import array
from typing import Any, NamedTuple

import numpy as np
import pytest
import small_kernels

from pamctl.kernel.calls import Machine, NotKernelData, make_frame, prepare, write_source
from pamctl.kernel.expressions import NotInC


class Pair(NamedTuple):
    first: float
    second: int = 3


def add_to(x, by=0.5):
    return x + by


TABLE = (1.0, 2.0, 3.0)
GRID = np.ones((2, 2))

BODIES = """\
items = [x, x]  # no

return {1: x}[1]  # no

name = "x"  # no

try:  # no
    return 1.0 / x
except ZeroDivisionError:
    return 0.0

if x > 0.0:
    raise ValueError("x")  # no

assert x > 0.0  # no

import cmath  # no

del x  # no

with x:  # no
    return x

def inner():  # no
    return x

return (lambda: x)()  # no

return sum(x for _ in range(3))  # no

for k in range(n, 0, -1):  # no
    x += 1.0

for item in (x, x):  # no
    x += item

while n > 3:  # no
    n -= 1
else:
    n = 0

for k in range(n):  # no
    x += 1.0
else:
    x = 0.0

return random.random() + x  # no

return x.is_integer()  # no

return math.gamma(x)  # no

return math.log(x, 2.0)  # no

return pow(n, 2) / 2.0  # no

return pow(n, 2, 3)  # no

return x + nowhere  # no

y = Pair(x)
y = x  # no

two = (1, 2.0)
if x > 0.0:
    two = (x > 1.0, 2.0)  # no

if x > 0.0:
    return x
return Pair(x)  # no

return x and 1.0  # no

pair.first = 2.0  # no

return pair._replace(first=2.0)  # no

a, b, c = pair  # no

return Pair(second=1)  # no

return Pair(x, third=1)  # no

return Pair(n)  # no

return Pair(*pair)  # no

return max(*(x, 2.0))  # no

return add_to(x, x=2.0)  # no

return (x, x)[:1]  # no

return x << 1  # no

return pair + x  # no

return n**2  # no

return ~n  # no

return n < 9223372036854775808  # no

return x in (1.0, 2.0)  # no

return x is True  # no

yield x  # no

return (y := x) + y  # no

match x:  # no
    case 1.0:
        return 2.0

global COUNT  # no
COUNT = x

return f"{x}"  # no

return divmod(n, 3)[0]  # no

for k in range(n):
    pass
return k  # no

if x > 0.0:
    y = x
return y  # no

y = add_to(x)  # no
add_to = x

total = 0
for k in range(n):
    total = total + k * x  # no

return -(x if x > 0.0 else 0)  # no

if x > 0.0:
    return x
return 0  # no

return -max(0, x)  # no

out[0] = x = x + 1.0  # no

TABLE[0] = x  # no

return GRID[0, 0] + x  # no
"""
GIVEN = {"x": 1.5, "n": 3, "pair": Pair(1.0), "out": array("d", (7.0, 8.0))}


def make_kernel(body: str) -> Any:
    lines = [f"def kernel({', '.join(GIVEN)}):", *(f"    {line}" for line in body.splitlines())]
    source = "\n".join(lines) + "\n"
    scope = {**globals(), "__name__": "typed_in"}
    exec(compile(source, "<typed in>", "exec"), scope)
    scope["kernel"].source = source
    return scope["kernel"]


@pytest.mark.parametrize("body", BODIES.strip().split("\n\n"))
def test_a_statement_is_refused_with_its_line_and_the_reason(body):
    lines = body.splitlines()
    (line,) = (number for number, text in enumerate(lines, start=2) if text.endswith("# no"))
    kernel = make_kernel(body)
    with pytest.raises(NotInC) as refused:
        write_source(kernel, make_frame(kernel)(**GIVEN))
    where, _, why = str(refused.value).partition(": kernel: ")
    assert where == f"<typed in>:{line}"
    quoted, _, reason = why.rpartition("`: ")
    assert quoted.strip("`(").replace("'", '"')[:2].strip() in lines[line - 2]
    assert len(reason) > 10


# --- what other functions bring with them -----------------------------------------------------


def take_any_number(*x):
    return 1.0


def take_only_words(x, *, factor=2.0):
    return x * factor


def end_without_return(x):  # noqa: RET503
    if x > 0.0:
        return x


def recurse(x):
    return recurse(x - 1.0) if x > 0.0 else x


def put_and_give(out, k):
    out[k] = out[k] + 1.0
    return out[k]


@functools.lru_cache
def decorated(x):
    return x


def make_closure(factor):
    def scale(x):
        return factor * x

    return scale


closure = make_closure(2.0)


@pytest.mark.parametrize(
    ("body", "why"),
    [
        ("return take_any_number(x)", "must have names and an order"),
        ("return take_only_words(x, factor=3.0)", "must have names and an order"),
        ("return end_without_return(x)", "without its result"),
        ("return recurse(x)", "calls itself"),
        ("return out[0] + put_and_give(out, n) * out[0]", "changes an array"),
        ("return decorated(x)", ""),
        ("return closure(x)", ""),
    ],
)
def test_a_function_that_is_more_than_its_source_is_refused(body, why):
    kernel = make_kernel(body)
    with pytest.raises(NotInC, match=rf":\d+: .*{why}"):
        Machine(kernel)(*GIVEN.values())


# --- data -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "value", ["text", [1.0], {"a": 1.0}, 1j, object(), np.zeros(3, np.float32), np.zeros((2, 2, 2))]
)
def test_data_that_no_kernel_takes_are_refused_with_their_place(value):
    with pytest.raises(NotKernelData, match=r"^add_to\.x: .* is not a float, int, bool"):
        prepare(add_to, {"x": value, "by": 0.5})


def test_an_array_of_another_byte_order_or_width_is_not_read_as_if_it_were_none():
    odd = np.frombuffer(b"\0" + np.arange(3.0).tobytes(), offset=1)
    for wrong in (np.arange(3.0).astype(">f8"), np.arange(3.0, dtype=np.float32), odd):
        with pytest.raises(TypeError, match="array"):
            Machine(small_kernels.fill_multiples)(wrong, array("d", bytes(24)))
