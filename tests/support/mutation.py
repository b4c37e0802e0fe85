"""A function with one small error in its source: what a careless edit would have left behind."""

from __future__ import annotations

import inspect
import textwrap
from collections.abc import Callable
from typing import Any


def mutated(function: Callable[..., Any], old: str, new: str) -> Callable[..., Any]:
    """Return the function compiled anew from its source, with `old` replaced by `new`."""
    source = textwrap.dedent(inspect.getsource(function))
    assert source.count(old) == 1, f"{old!r} stands {source.count(old)} times in {function}"
    namespace: dict[str, Any] = {}
    code = compile(source.replace(old, new), inspect.getfile(function), "exec", dont_inherit=True)
    exec(code, function.__globals__, namespace)
    return namespace[function.__name__]
