"""What the ring asks of the processor: another process sees the rows before it sees the head.

x86 makes stores visible in the order of the program, and reads in that order: nothing is to be
done. Other processors may reorder both. There the side that reads asks the kernel for a full
barrier on every CPU on which a process with a ring runs (`membarrier`), so that the side that
writes, which is the loop, pays nothing. Header words are eight aligned bytes: no processor of
64 bits tears them.
"""

from __future__ import annotations

import ctypes
import os
import platform
import sys
from collections.abc import Callable

_IN_ORDER = frozenset({"x86_64", "amd64", "i686", "i386"})
_MEMBARRIER = {"aarch64": 283, "riscv64": 283, "loongarch64": 283, "x86_64": 324, "ppc64le": 365}
"""Number of the system call."""
_GLOBAL_EXPEDITED, _REGISTER_GLOBAL_EXPEDITED = 2, 4


class MemoryOrderError(OSError):
    """No order can be promised of what another process sees of a ring."""


def choose_barrier(machine: str, byte_order: str = sys.byteorder) -> Callable[[], None]:
    """Return what a reader calls between two accesses that must stay in their order.

    On a machine that needs barriers this process takes part in them from now on. Raises
    `MemoryOrderError` where the machine is big-endian, or the kernel offers no barrier.
    """
    if byte_order != "little":
        raise MemoryOrderError(f"rings are little-endian, {machine} is not")
    if machine.lower() in _IN_ORDER:
        return _do_nothing
    return _make_kernel_barrier(machine)


def _do_nothing() -> None:
    """The processor keeps the order."""


def _make_kernel_barrier(machine: str) -> Callable[[], None]:
    number = _MEMBARRIER.get(machine)
    if number is None:
        raise MemoryOrderError(f"no barrier between processes is known for {machine}")
    call = ctypes.CDLL(None, use_errno=True).syscall

    def membarrier(command: int) -> None:
        arguments = (number, command, 0, 0)
        if call(*map(ctypes.c_long, arguments)):
            error = os.strerror(ctypes.get_errno())
            raise MemoryOrderError(f"{machine} reorders stores, and membarrier failed: {error}")

    membarrier(_REGISTER_GLOBAL_EXPEDITED)
    return lambda: membarrier(_GLOBAL_EXPEDITED)


def barrier_of_this_machine() -> Callable[[], None]:
    """Return the barrier of the machine that this process runs on."""
    return choose_barrier(platform.machine())
