"""How the rig is wired to an NI M Series card: the section `nidaq` of a rig file."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

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
    encoder_a_pfi: Annotated[
        int | None,
        Field(
            ge=0,
            le=15,
            description="PFI line of the encoder's A; empty: the card's own for this counter, "
            "PFI 8 for ctr0 of the 68-pin card, PFI 0 of the 37-pin card, which has PFI 0-7 only",
        ),
    ] = None
    encoder_b_pfi: Annotated[
        int | None,
        Field(
            ge=0,
            le=15,
            description="PFI line of the encoder's B; empty: PFI 10, on the 37-pin card PFI 2",
        ),
    ] = None
    loopback_channel: Annotated[
        str | None,
        Field(
            pattern="^ai([0-9]|[1-7][0-9])$",
            description="an input that is wired to the valve's output, for the doctor to see what "
            "the output does when its task starts; empty: no such wire",
        ),
    ] = None
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

    @model_validator(mode="after")
    def _check_lines(self) -> Self:
        a, b = self.encoder_a_pfi, self.encoder_b_pfi
        if (a is None) != (b is None):
            raise ValueError("encoder_a_pfi and encoder_b_pfi must be given both or not at all")
        if a is not None and a == b:
            raise ValueError("encoder_a_pfi and encoder_b_pfi must be two lines")
        return self
