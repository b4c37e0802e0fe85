"""The output register of a simulated card.

A card holds its last voltage when the process that wrote it dies; this is why there is a
guardian. `SharedRegister` behaves in the same way: it is a double in a file in shared memory,
and another process can take it over only after its owner has died. `PrivateRegister` is for
runs without a clock, which have no guardian.
"""

from __future__ import annotations

import mmap
import os
from pathlib import Path
from typing import Protocol

from hal.reservation import open_shared, reserve

_PID_AT = 8
_SIZE = 64


class Register(Protocol):
    """Holds the volts on the simulated analog output."""

    volts: float

    def reserve(self) -> None:
        """Take the output for this process; raise `RigError` if another holds it. Idempotent."""

    def release(self) -> None:
        """Release the output; the voltage stays. Idempotent."""


class PrivateRegister:
    """An output that no other process can see."""

    def __init__(self, volts: float = 0.0) -> None:
        """Power up at `volts`."""
        self.volts = volts

    def reserve(self) -> None:
        """Do nothing: no other process can hold it."""

    def release(self) -> None:
        """Do nothing."""


class SharedRegister:
    """An output in shared memory. Powers up at 0 V, as an M series card does."""

    def __init__(self, path: Path, device: str) -> None:
        """`reserve` creates the file where it is missing; `device` is for messages."""
        self._path = path
        self._device = device
        self._fd: int | None = None
        # Until `reserve` maps the file, the voltage lies in private memory.
        self._volts = memoryview(bytearray(_SIZE)).cast("d")

    @property
    def volts(self) -> float:
        """The voltage now on the output, from any process."""
        return self._volts[0]

    @volts.setter
    def volts(self, value: float) -> None:
        self._volts[0] = value

    def reserve(self) -> None:
        """Take the output until `release` or death; raise `RigError` naming the holder."""
        if self._fd is not None:
            return
        fd = open_shared(self._path, _SIZE)
        try:
            reserve(fd, f"the output of {self._device}", _PID_AT)
            # The mapping duplicates its descriptor, and a duplicate would keep the lock.
            self._volts = memoryview(_map_file(self._path)).cast("d")
        except BaseException:
            os.close(fd)
            raise
        self._fd = fd

    def release(self) -> None:
        """Release the output; it keeps its voltage."""
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None


def peek_v(path: Path) -> float:
    """Read a register as a voltmeter would: without reserving it."""
    return memoryview(_map_file(path)).cast("d")[0]


def _map_file(path: Path) -> mmap.mmap:
    fd = open_shared(path, _SIZE)
    try:
        return mmap.mmap(fd, _SIZE)
    finally:
        os.close(fd)
