"""How the rig is wired to an NI M Series card: the section `nidaq` of a rig file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from hal.m_series import MSeriesWiring


class NidaqSettings(MSeriesWiring):
    """Which terminals of which card, in what ranges, and what paces the loop."""

    device: Annotated[
        str,
        Field(pattern="^[A-Za-z][A-Za-z0-9_-]*$", description="as `nilsdev` lists it"),
    ] = "Dev1"
    timing: Annotated[
        Literal["on_demand", "hardware_timed"],
        Field(
            description="on_demand: the loop's clock asks for each sample; hardware_timed: the "
            "card's own clock paces the loop, and puts out what is written one tick later"
        ),
    ] = "on_demand"
    data_transfer: Annotated[
        Literal["polled", "driver"],
        Field(
            description="of hardware_timed: polled asks the driver for programmed I/O, which it "
            "needs for single points; driver leaves the choice to it"
        ),
    ] = "polled"
    timeout_s: Annotated[
        float, Field(gt=0, le=1, description="of a single read or write in the driver")
    ] = 0.02
