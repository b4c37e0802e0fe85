"""The subset of Python that kernels may use works, and all else is refused with its line."""

from __future__ import annotations

import inspect
import linecache
import os
import subprocess
import sys
from array import array
from collections.abc import Callable
from pathlib import Path
from types import FunctionType
from typing import Any

import every_kernel
import kernels_in_c
import kernels_not_in_c
import numpy as np
import pytest
import small_kernels
from every_kernel import Variant, bits, flatten, leaf_types, pack
from support.patience import PATIENCE_S

from pamctl.kernel.build import find_compiler
from pamctl.kernel.c_source import CSource
from pamctl.kernel.calls import NotKernelData, make_frame, prepare, write_source
from pamctl.kernel.expressions import NotInC

Kernel = Callable[..., Any]
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")


# --- what a kernel may use ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def variants(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Variant]:
    source, found = CSource(), []
    for kernel, arguments in kernels_in_c.ARGUMENTS.items():
        frame = source.type_of(make_frame(kernel)(*arguments))
        types = tuple(part for _, part in frame.fields)
        found.append(Variant(kernel, types, result=source.add_kernel(kernel, types)[1]))
    every_kernel.compile_variants(source, found, tmp_path_factory.mktemp("translate"))
    return {variant.kernel.__name__: variant for variant in found}


def test_each_kernel_of_the_table_has_arguments() -> None:
    module = vars(kernels_in_c).values()
    own = {its for its in module if isinstance(its, FunctionType)} & {*kernels_in_c.ARGUMENTS}
    assert len(own) == len(kernels_in_c.ARGUMENTS) > 20


@needs_compiler
@pytest.mark.parametrize("kernel", kernels_in_c.ARGUMENTS, ids=lambda kernel: kernel.__name__)
def test_what_a_kernel_may_use_gives_the_same_numbers(
    variants: dict[str, Variant], kernel: Kernel
) -> None:
    variant, arguments = variants[kernel.__name__], kernels_in_c.ARGUMENTS[kernel]
    kinds = [kind for its in variant.types for kind in leaf_types(its)]
    pairs = zip(arguments, variant.types, strict=True)
    words, _ = pack([leaf for pair in pairs for leaf in flatten(*pair)], kinds)
    given = every_kernel.run(variant, words)
    assert given is not None, "C failed"
    types = [*leaf_types(variant.result)]
    expected = [*flatten(kernel(*arguments), variant.result)]
    assert [*map(bits, given, types)] == [*map(bits, expected, types)]


@needs_compiler
def test_arrays_are_filled() -> None:
    for make in (lambda n: array("d", range(n)), lambda n: np.arange(float(n))):
        values, into, expected = make(5), make(5), array("d", bytes(40))
        call = prepare(kernels_in_c.fill_array, {"values": values, "into": into})
        assert call.is_native
        call.run()
        kernels_in_c.fill_array(np.arange(5.0), expected)
        assert [*into] == [*expected]


# --- what it may not ---------------------------------------------------------------------------


@pytest.mark.parametrize("kernel", kernels_not_in_c.KERNELS, ids=lambda kernel: kernel.__name__)
def test_all_else_is_refused_with_its_line_and_the_reason(kernel: Kernel) -> None:
    path = Path(str(inspect.getsourcefile(kernel)))
    first = kernel.__code__.co_firstlineno
    lines = path.read_text().splitlines()
    (line,) = (
        number
        for number in range(first, first + len(inspect.getsourcelines(kernel)[0]))
        if lines[number - 1].endswith("# no")
    )
    frame = make_frame(kernel)
    values = (kernels_not_in_c.ARGUMENTS.get(name, 1.5) for name in frame._fields)
    with pytest.raises(NotInC) as refused:
        write_source(kernel, frame(*values))
    where, _, why = str(refused.value).partition(f": {kernel.__qualname__}: ")
    assert where == f"{path}:{line}"
    quoted, _, reason = why.rpartition("`: ")
    assert quoted.strip("`(").replace("'", '"')[:2].strip() in lines[line - 1]
    assert len(reason) > 10


@pytest.mark.parametrize(
    "value",
    ["text", [1.0], {"a": 1.0}, 1j, object(), np.zeros(3, np.float32), np.zeros((2, 2, 2))],
)
def test_data_that_no_kernel_takes_are_refused_with_their_place(value: Any) -> None:
    with pytest.raises(NotKernelData, match=r"^use_names\.x: .* is not a float, int, bool"):
        prepare(kernels_in_c.use_names, {"x": value})


# --- what goes wrong while it runs -------------------------------------------------------------


@needs_compiler
@pytest.mark.parametrize(
    ("kernel", "first", "error"),
    [
        (small_kernels.loop_on_an_error, 0.0, ZeroDivisionError),
        (small_kernels.count_on_an_error, array("d", (0.0,)), IndexError),
    ],
)
def test_a_loop_that_an_error_ends_in_python_ends_in_c(
    kernel: Kernel, first: Any, error: type[Exception]
) -> None:
    """Python leaves the loop by the error; C must not go on with a wrong number for ever."""
    code = (
        "from array import array\n"
        f"from small_kernels import {kernel.__name__} as kernel\n"
        "from pamctl.kernel.calls import machine\n"
        f"machine(kernel)({first!r}, array('d', (0.0,)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=Path(__file__).parent,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.stderr.splitlines()[-1].startswith(error.__name__)


# --- kernels and their sources -----------------------------------------------------------------


def test_a_kernel_without_a_source_runs_in_python(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
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


@needs_compiler
def test_a_kernel_of_a_notebook_is_built_again_when_it_changes() -> None:
    for factor in (2.0, 5.0):
        text = f"def kernel(x):\n    return {factor} * x\n"
        scope: dict[str, Any] = {"__name__": "notebook"}
        exec(compile(text, "<cell>", "exec"), scope)
        linecache.cache["<cell>"] = len(text), None, text.splitlines(True), "<cell>"
        call = prepare(scope["kernel"], {"x": 1.5}, updates=("x",))
        assert call.is_native
        call.run()
        assert call.get("x") == factor * 1.5
