"""The source of machine code, run in plain Python in the place of a library."""

from __future__ import annotations

import struct
from typing import Any


class PlainLibrary:
    """Runs the source of machine code in plain Python."""

    def __init__(self, source: str, names: dict[str, Any], kernel: Any) -> None:
        def put(code: str) -> Any:
            return lambda row, at, value: struct.pack_into(code, row, at, value)

        scope = {**names, "kernel": kernel}
        scope |= {"put_float": put("<d"), "put_int": put("<q"), "put_bool": put("<?")}
        exec(source, scope)
        self._glue = scope["glue"]

    def bind(self, words: bytearray, _: bytearray, *others: bytearray) -> Any:
        """Bind words, the same words, and where there are any a row and tables."""
        floats = [memoryview(table).cast("d") for table in others[1:]]
        arguments = [memoryview(words).cast("q"), memoryview(words).cast("d"), *others[:1], *floats]

        def call(*arguments: Any) -> int:
            try:
                self._glue(*arguments)
            except (ArithmeticError, ValueError):
                return 1
            return 0

        return call, arguments
