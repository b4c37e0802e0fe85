"""The section `loop` of a rig file: pace and stop."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from hal.rig import Configured


class LoopSettings(Configured):
    """How the loop is paced, and how it stops."""

    rate_hz: Annotated[
        float,
        Field(
            ge=100,
            le=10_000,
            description="ticks a second; a run warns where this PC cannot hold the rate",
        ),
    ] = 1000.0
    spin_us: Annotated[
        float, Field(ge=0, le=500, description="busy wait before each deadline, under FIFO only")
    ] = 100.0
    cpu: Annotated[int | None, Field(ge=0, description="CPU of the loop; the last if absent")] = (
        None
    )
    heartbeat_ms: Annotated[
        float,
        Field(ge=20, le=10_000, description="a loop silent for longer is killed by the guardian"),
    ] = 50.0
    starved_ms: Annotated[
        float,
        Field(
            ge=0,
            le=60_000,
            description="a silent loop that gets no CPU is killed after this time, "
            "or after heartbeat_ms if that is longer",
        ),
    ] = 0.0
    stop_ramp_s: Annotated[
        float, Field(ge=0.001, le=5, description="from the last command to the safe one")
    ] = 0.5
    ring_rows: Annotated[
        int, Field(ge=256, le=1_000_000, description="ticks that fit between loop and recorder")
    ] = 16_384

    @model_validator(mode="after")
    def _check_period(self) -> LoopSettings:
        if self.spin_us * self.rate_hz > 0.5e6:
            raise ValueError(
                f"spin_us {self.spin_us:g} is more than half of the period of "
                f"{1e6 / self.rate_hz:g} us at rate_hz {self.rate_hz:g}"
            )
        if self.heartbeat_ms * self.rate_hz < 3e3:
            raise ValueError(
                f"heartbeat_ms {self.heartbeat_ms:g} is less than three periods of "
                f"{1e3 / self.rate_hz:g} ms at rate_hz {self.rate_hz:g}"
            )
        if self.ring_rows < 2 * self.stop_rows:
            raise ValueError(
                f"ring_rows {self.ring_rows} is too few: the {self.stop_rows} ticks of a stop of "
                f"{self.stop_ramp_s:g} s at rate_hz {self.rate_hz:g} may fill half of them"
            )
        return self

    @property
    def stop_rows(self) -> int:
        """Rows that the ticks and events of a smooth stop need, and a little more."""
        return round(self.rate_hz * (self.stop_ramp_s + 0.1)) + 16
