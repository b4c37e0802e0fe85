"""The interface every rig implements, and the one page to read before adding one.

A rig knows volts and counts; it knows nothing of muscles. To add one: write a
class with the methods of `Rig`, run `tests/hal/test_rig_contract.py` over it,
and name it in the composition root (`pamctl/processes/backends.py`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import NamedTuple, Protocol


class RawSample(NamedTuple):
    """What the converters said within one tick, and when they said it.

    Times are on the rig's monotonic clock, in ns; each channel has its own,
    because on a multiplexed card they are not taken at the same instant.
    """

    pressure_v: float
    encoder_counts: int
    pressure_t_ns: int
    encoder_t_ns: int


class RigError(Exception):
    """The device failed or is not there. The message says what, where and what to do."""

    def __init__(self, what: str, *, fix: str = "", code: int | None = None) -> None:
        """`fix` is an instruction to the user; `code` is the device's own error number."""
        numbered = f"{what} (device error {code})" if code is not None else what
        super().__init__(f"{numbered}; {fix}" if fix else numbered)
        self.what = what
        self.fix = fix
        self.code = code


class Rig(Protocol):
    """One valve output, one pressure input, one encoder.

    Every method may be called from one thread only. Methods raise `RigError`
    and nothing else when the device fails, except `make_safe` and `close`,
    which never raise.
    """

    def open(self) -> None:
        """Acquire the device and drive the safe voltage before returning."""

    def read(self) -> RawSample:
        """Return one sample taken after this call began. Never return stale data: raise."""

    def write(self, ao_v: float) -> float:
        """Apply `ao_v` (V) before returning; return the volts really applied.

        Where `describe` says `output_delay_ticks: 1` the rig holds it for the next sample's
        instant instead: then, and not before, it is put out. The safe voltage never waits.
        The rig clamps to its output range and quantises to its converter, and
        refuses a value that is not finite.
        """

    def make_safe(self) -> None:
        """Drive the safe voltage. Never raises, idempotent, legal in every state.

        Where the rig is not open it takes the output for a moment: so a process that
        outlives the owner of a rig makes it safe.
        """

    @property
    def safe_failure(self) -> RigError | None:
        """Why the last `make_safe` could not drive the safe voltage; None where it did."""

    def close(self) -> None:
        """Make safe, then release the device. Never raises, idempotent."""

    def describe(self) -> Mapping[str, object]:
        """Name channels, ranges and units. Works before `open`; goes into the log."""


@contextmanager
def open_rig(rig: Rig) -> Iterator[Rig]:
    """Open a rig, and leave it safe and closed on every path out of the block."""
    try:
        rig.open()
        yield rig
    finally:
        rig.make_safe()
        rig.close()
