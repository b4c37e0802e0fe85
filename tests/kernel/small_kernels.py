"""Kernels for processes that tests of this room start, and what such a process says."""

from __future__ import annotations

import sys
from array import array
from typing import Any

FACTOR = 2.0


def fill_multiples(values: Any, multiples: Any) -> None:
    """Kernel: fill the multiples of values."""
    for k in range(len(values)):
        multiples[k] = FACTOR * values[k]


def main() -> None:
    """Call the kernel; print its results, what computed them, and what was imported for it."""
    from pamctl.kernel.calls import machine

    multiples = array("d", bytes(24))
    machine(fill_multiples)(array("d", (1.0, 2.0, 3.0)), multiples)
    function = machine(fill_multiples)._variants[0][1]
    print(*multiples, "plain" if function is None else "native")
    print(*(name for name in ("ast", "inspect", "subprocess", "numpy") if name in sys.modules))


if __name__ == "__main__":
    from small_kernels import main as named_main  # a kernel of __main__ has another name

    named_main()
