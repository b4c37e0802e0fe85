"""Values of options that need no check: typer would load pydantic to read any value."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any


def read_without_pydantic(command: Any) -> None:
    """Let all parameters of a verb, and of the verbs in it, read plain values themselves."""
    command.get_params = partial(_list_readers, command.get_params)
    for inner in getattr(command, "commands", {}).values():
        read_without_pydantic(inner)


def _list_readers(list_parameters: Callable[[Any], list[Any]], ctx: Any) -> list[Any]:
    parameters = list_parameters(ctx)
    for parameter in parameters:
        if not isinstance(parameter.get_runtime_param, _Reader):
            parameter.get_runtime_param = _Reader(parameter.get_runtime_param)
    return parameters


class _Reader:
    """Reads what is given for one parameter."""

    def __init__(self, build: Callable[[], Any]) -> None:
        """`build` makes the reader of typer."""
        self._build = build

    def __call__(self) -> _Reader:
        """Return what typer asks for a value."""
        return self

    def coerce(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the value of an option that was not given, of a text or a path.

        Typer reads all others, and a path that it will refuse.
        """
        kind = param.type_descriptor.annotation
        if value is None and not param.multiple and param.nargs == 1:
            return None
        if isinstance(value, str) and kind is str:
            return value
        if isinstance(value, str) and kind is Path and _can_be_read(value):
            return Path(value)
        return self._build().coerce(value, param=param, ctx=ctx)


def _can_be_read(path: str) -> bool:
    return not os.path.exists(path) or os.access(path, os.R_OK)
