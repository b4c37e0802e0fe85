"""A rig that fails on purpose, for tests and for rehearsals.

It wraps any rig. Each fault begins at a given read after opening.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Annotated, Literal

from pydantic import Field, model_validator

from hal.calibration import Configured
from hal.rig import RawSample, Rig, RigError, RigIdentity

FaultKind = Literal[
    "stuck_encoder",
    "encoder_jump",
    "reversed_encoder",
    "pressure_nan",
    "broken_wire",
    "stale_sample",
    "slow_read",
    "read_error",
    "write_error",
    "device_lost",
    "stuck_valve",
]


class FaultSettings(Configured):
    """One fault: from which tick on, for how many ticks, and how large."""

    kind: FaultKind
    from_tick: Annotated[int, Field(ge=0)]
    ticks: Annotated[int, Field(ge=1)] = 1_000_000_000
    size: Annotated[
        float,
        Field(
            ge=-1e9,
            le=1e9,
            description="counts of an encoder_jump, s of a slow_read, output V of a stuck_valve",
        ),
    ] = 0.0

    @model_validator(mode="after")
    def _check_size(self) -> FaultSettings:
        if self.kind == "slow_read" and not 0.0 <= self.size <= 60.0:
            raise ValueError(f"the size of a slow_read is 0 to 60 s (got {self.size:g})")
        if self.kind == "stuck_valve" and not -10.0 <= self.size <= 10.0:
            raise ValueError(f"the size of a stuck_valve is -10 to 10 V (got {self.size:g})")
        return self


class FaultyRig:
    """Passes every call to `inner`, and changes what its faults spoil."""

    def __init__(
        self,
        inner: Rig,
        faults: Sequence[FaultSettings],
        *,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """`sleep` is how a slow read passes time."""
        self._inner = inner
        self._faults = tuple(faults)
        self._sleep = sleep
        self._reads = -1
        self._first: dict[int, RawSample] = {}

    def open(self) -> None:
        """Open the inner rig; ticks are counted from here."""
        self._inner.open()
        self._reads = -1
        self._first.clear()

    def read(self) -> RawSample:
        """Sample the inner rig and apply the faults that are due."""
        self._reads += 1
        self._fail_if_due("read_error", "device_lost")
        sample = self._inner.read()
        for index, fault in enumerate(self._faults):
            if self._is_due(fault):
                sample = self._spoil(fault, self._first.setdefault(index, sample), sample)
        return sample

    def write(self, ao_v: float) -> float:
        """Write to the inner rig unless the device is lost.

        The voltage returned is the one asked for even where the valve is stuck: a real output
        cannot see its valve.
        """
        self._fail_if_due("write_error", "device_lost")
        for fault in self._faults:
            if fault.kind == "stuck_valve" and self._is_due(fault):
                self._inner.write(fault.size)
                return ao_v
        return self._inner.write(ao_v)

    def make_safe(self) -> None:
        """Make the inner rig safe, even where the fault says that the device is lost."""
        self._inner.make_safe()

    @property
    def safe_failure(self) -> RigError | None:
        """Why the inner rig could not drive its safe voltage; None where it did."""
        return self._inner.safe_failure

    def close(self) -> None:
        """Close the inner rig."""
        self._inner.close()

    def describe(self) -> RigIdentity:
        """Describe the inner rig, and add the faults."""
        identity = self._inner.describe()
        faults = [fault.model_dump() for fault in self._faults]
        return identity._replace(extra={**identity.extra, "faults": faults})

    def _is_due(self, fault: FaultSettings) -> bool:
        return fault.from_tick <= self._reads < fault.from_tick + fault.ticks

    def _fail_if_due(self, *kinds: FaultKind) -> None:
        for fault in self._faults:
            if fault.kind in kinds and self._is_due(fault):
                raise RigError(
                    f"{fault.kind} injected at tick {self._reads}", fix="remove the fault"
                )

    def _spoil(self, fault: FaultSettings, first: RawSample, sample: RawSample) -> RawSample:
        match fault.kind:
            case "stuck_encoder":
                return sample._replace(encoder_counts=first.encoder_counts)
            case "encoder_jump":
                return sample._replace(encoder_counts=sample.encoder_counts + round(fault.size))
            case "reversed_encoder":
                return sample._replace(
                    encoder_counts=2 * first.encoder_counts - sample.encoder_counts
                )
            case "pressure_nan":
                return sample._replace(pressure_v=float("nan"))
            case "broken_wire":
                return sample._replace(pressure_v=0.0)
            case "stale_sample":
                return first
            case "slow_read":
                self._sleep(fault.size)
        return sample
