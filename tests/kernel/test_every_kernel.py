"""Every kernel of pamctl gives the same bits in C as in Python, or fails where Python raises."""

import gc
import itertools
import math
import random
import signal
from typing import Any, NamedTuple

import every_kernel
import pytest
from every_kernel import ARRAYS, Row, Variant
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pamctl.control.law_registry import installed_laws
from pamctl.kernel.build import find_compiler
from pamctl.kernel.c_source import BOOL, FLOAT, INT, CType
from pamctl.plant import catalogue
from pamctl.plant.catalogue import CATALOGUE
from pamctl.realtime.tick import step
from pamctl.safety import admit

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler"),
]

RAISED = (ArithmeticError, ValueError, IndexError)
"""What a kernel may raise."""
PATIENCE_S = 0.03
SPECIAL = (
    math.nan, math.inf, -math.inf, 0.0, -0.0, 5e-324, -5e-324, 2.3e-308, 1e-300, 1e-9, 0.5, 1.0,
    -1.0, 2.0**31, 2.0**53, -(2.0**63), 1e19, 1e300,
    1.7976931348623157e308, -1.7976931348623157e308,
)  # fmt: skip
WHOLE = (0, 1, -1, 2, 255, 2**31 - 1, -(2**31), 2**53 + 1, 2**62, 2**63 - 1, -(2**63))


@pytest.fixture(scope="module")
def variants(tmp_path_factory: pytest.TempPathFactory) -> list[Variant]:
    source, found = every_kernel.find_variants(random.Random(20))
    every_kernel.compile_variants(source, found, tmp_path_factory.mktemp("every-kernel"))
    return found


def test_the_kernels_of_all_rooms_are_found(variants):
    found = {variant.kernel for variant in variants}
    entries = [entry for effect in CATALOGUE.values() for entry in effect.entries]
    # Those of the place `numbers` change a plant before it runs, in Python.
    assert {entry.kernel for entry in entries if entry.place != "numbers"} <= found
    assert {entry.memory.follow for entry in entries if entry.memory} <= found
    assert {law.kernel for law in installed_laws().values()} <= found
    composed = {its for its in vars(catalogue).values() if getattr(its, "source", None)}
    assert composed
    assert composed <= found
    assert {step, admit} <= found


class Change(NamedTuple):
    """How a number of a call is changed."""

    at: int
    how: str
    by: Any


def list_changes(size: int) -> st.SearchStrategy[list[Change]]:
    at = st.integers(0, size - 1)
    change = st.one_of(
        st.builds(Change, at, st.just("set"), st.sampled_from(SPECIAL) | st.floats()),
        st.builds(Change, at, st.just("set"), st.sampled_from(WHOLE)),
        st.builds(Change, at, st.just("times"), st.sampled_from((-1.0, 0.5, 3.0, 1e3, 1 + 1e-15))),
        st.builds(Change, at, st.just("as"), at),
        st.builds(Change, at, st.just("beside"), at),
        st.builds(Change, at, st.just("shorten"), st.integers(0, 3)),
    )
    return st.lists(change, max_size=6)


def apply_change(leaves: list[Any], kinds: list[CType], change: Change) -> None:
    """Change a number; of an array one number, or its length."""
    at, how, by = change
    if kinds[at] in ARRAYS:
        if how == "shorten" and kinds[at] is not every_kernel.GRID:
            del leaves[at][by:]
        elif leaves[at] and how in ("set", "times"):
            kind = INT if kinds[at] is every_kernel.INTEGERS else FLOAT
            place = at % len(leaves[at])
            leaves[at][place] = find_new(leaves[at][place], kind, how, by)
    elif how in ("as", "beside") and kinds[by] not in ARRAYS:
        leaves[at] = find_new(leaves[at], kinds[at], how, leaves[by])
    elif how in ("set", "times"):
        leaves[at] = find_new(leaves[at], kinds[at], how, by)


def find_new(old: Any, kind: CType, how: str, by: Any) -> Any:
    new = old * by if how == "times" else math.nextafter(by, math.inf) if how == "beside" else by
    if kind is FLOAT:
        return float(new)
    if kind is BOOL:
        return bool(new)
    return int(new) if math.isfinite(new) and -(2**63) <= int(new) < 2**63 else old


class TooLongError(BaseException):
    """Plain Python runs for longer than a test can wait."""


def give_up(*_: object) -> None:
    raise TooLongError


def run_python(variant: Variant, leaves: list[Any]) -> Any:
    """Return the result, or the error that is raised."""
    rest = iter(leaves)
    arguments = [every_kernel.gather(kind, rest) for kind in variant.types]
    before = signal.signal(signal.SIGVTALRM, give_up)
    gc.disable()  # no callback of the collector may get the alarm
    try:
        try:
            signal.setitimer(signal.ITIMER_VIRTUAL, PATIENCE_S)
            return variant.kernel(*arguments)
        finally:
            signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
    except (*RAISED, TooLongError) as error:
        return error
    finally:
        gc.enable()
        signal.signal(signal.SIGVTALRM, before)


def compare(variant: Variant, leaves: list[Any]) -> None:
    """Hold C against Python."""
    kinds = [kind for its in variant.types for kind in every_kernel.leaf_types(its)]
    words, arrays = every_kernel.pack(leaves, kinds)
    expected = run_python(variant, leaves)
    if isinstance(expected, TooLongError):
        return
    given = every_kernel.run(variant, words)
    types = [*every_kernel.leaf_types(variant.result)]
    if isinstance(expected, Exception):
        assert given is None, f"{variant}: Python raises {expected!r}, C does not fail"
        return
    numbers = [*every_kernel.flatten(expected, variant.result)]
    if any(isinstance(number, int) and not -(2**63) <= number < 2**63 for number in numbers):
        assert given is None, f"{variant}: C has no such number"
        return
    if given is None and is_extreme(leaves):  # Python's ints have no end: the call is run in Python
        return
    assert given is not None, f"{variant}: C fails, where Python gives {expected}"
    same = [*map(every_kernel.bits, given, types)] == [*map(every_kernel.bits, numbers, types)]
    assert same, f"{variant}: C gives {given}, Python {expected}"
    after = [leaf for leaf in leaves if isinstance(leaf, Row)]
    for ours, theirs in zip(arrays, after, strict=True):
        assert [*map(every_kernel.bits, ours)] == [*map(every_kernel.bits, theirs)], str(variant)


def is_extreme(leaves: list[Any]) -> bool:
    """Tell whether an int of more than 64 bits may come of these numbers."""
    numbers = itertools.chain.from_iterable(x if isinstance(x, Row) else (x,) for x in leaves)
    return any(not 1e-12 < abs(number) < 1e12 for number in numbers if number != 0.0)


def test_any_numbers_give_the_same_bits_or_fail_in_both(variants):
    wrong = []
    for variant in variants:
        try:
            find_difference(variant)
        except AssertionError as error:
            wrong.append(str(error).partition("\n")[0])
    assert not wrong, "\n".join(wrong)


def find_difference(variant: Variant) -> None:
    calls = variant.calls or [every_kernel.make_call(variant)]
    kinds = [kind for its in variant.types for kind in every_kernel.leaf_types(its)]

    def make_leaves(call: tuple[Any, ...]) -> list[Any]:
        pairs = zip(call, variant.types, strict=True)
        flat = itertools.chain.from_iterable(every_kernel.flatten(*pair) for pair in pairs)
        return [
            find_new(leaf, kind, "set", leaf) if kind not in ARRAYS else leaf
            for leaf, kind in zip(flat, kinds, strict=True)
        ]

    for call in calls:
        compare(variant, make_leaves(call))
    if not kinds:
        return

    @settings(max_examples=6, suppress_health_check=[*HealthCheck], database=None)
    @given(call=st.sampled_from(calls), changes=list_changes(len(kinds)))
    def search(call: tuple[Any, ...], changes: list[Change]) -> None:
        leaves = make_leaves(call)
        for change in changes:
            apply_change(leaves, kinds, change)
        compare(variant, leaves)

    search()
