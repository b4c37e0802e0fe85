"""How the loop is paced, as a rig file says it."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from hal.configured import Configured


class LoopSettings(Configured):
    """How the loop is paced, and how it stops."""

    rate_hz: Annotated[float, Field(ge=10, le=20_000)] = 1000.0
    spin_us: Annotated[
        float, Field(ge=0, le=500, description="busy wait before each deadline, under FIFO only")
    ] = 100.0
    cpu: Annotated[int | None, Field(ge=0, description="CPU of the loop; the last if absent")] = (
        None
    )
    stop_ramp_s: Annotated[
        float, Field(ge=0.001, le=60, description="from the last command to the safe one")
    ] = 0.5
    ring_rows: Annotated[
        int, Field(ge=256, le=1_000_000, description="ticks that fit between loop and recorder")
    ] = 16_384
