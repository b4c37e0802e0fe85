"""The contract of every rig: the one page to read before adding one.

A rig knows volts and counts; it knows nothing of muscles. To add one, write a class with the
methods of `Rig` and a record for it (`hal/backend.py`), and run the cases of
`hal/rig_contract.py` over it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Literal, NamedTuple, Protocol


class RawSample(NamedTuple):
    """What the converters read within one tick, and when.

    Times are on the rig's monotonic clock, in ns. Each channel has its own time, because a
    multiplexed card does not sample them at the same instant.
    """

    pressure_v: float
    """Voltage of the pressure sensor."""
    encoder_counts: int
    """Count of the encoder, four for each of its lines."""
    pressure_t_ns: int
    """When the pressure was sampled."""
    encoder_t_ns: int
    """When the encoder was sampled."""


class Edge(NamedTuple):
    """One edge of a device's own sample clock, as a blocking read met it."""

    t_ns: int
    """When the sample was taken, on the computer's clock."""
    now_ns: int
    """When the read returned: not before `t_ns`."""
    elapsed: int
    """Edges since the previous one; 1 where none was missed."""


class RigIdentity(NamedTuple):
    """What a rig says of itself: known before it is opened, and kept in the log."""

    backend: str
    """Name of the backend's record."""
    safe_output_v: float
    """Analog output voltage at which the rig is safe, as the rig file gives it."""
    output_delay_ticks: Literal[0, 1] = 0
    """1: what a tick writes is put out at the next sample."""
    sample_clock: str = ""
    """Name of the device's clock that paces the loop; empty where the computer paces it."""
    extra: Mapping[str, object] = {}
    """Channels, ranges, versions: whatever a reader of the log may want, as JSON values."""

    def as_metadata(self) -> dict[str, object]:
        """Return one flat mapping, as it stands in the log."""
        fields = self._asdict()
        extra = fields.pop("extra")
        if not self.sample_clock:
            del fields["sample_clock"]
        return {**fields, **extra}


class RigError(Exception):
    """The device failed or is missing. The message says what, where, and what to do."""

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

        The rig clamps to its output range, rounds to a code of its converter, and refuses a
        value that is not finite. With `output_delay_ticks` of 1 the rig keeps the value until
        the next sample and puts it out then. The safe voltage never waits.
        """

    def make_safe(self) -> None:
        """Drive the safe voltage. Never raises, idempotent, legal in every state.

        A rig that is not open takes the output for a moment. This is how another process
        makes the rig safe when its owner has died.
        """

    @property
    def safe_failure(self) -> RigError | None:
        """Why the last `make_safe` could not drive the safe voltage; None where it could."""

    def close(self) -> None:
        """Make safe, then release the device. Never raises, idempotent."""

    def describe(self) -> RigIdentity:
        """Say what this rig is. Works before `open`; `open` may add to `extra`."""


@contextmanager
def open_rig(rig: Rig) -> Iterator[Rig]:
    """Open a rig; leave it safe and closed on every path out of the block."""
    try:
        rig.open()
        yield rig
    finally:
        rig.make_safe()
        rig.close()
