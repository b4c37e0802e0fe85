"""How the rig is wired to a card behind comedi: the section `comedi` of a rig file."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from hal.m_series import MSeriesWiring

UNCALIBRATED = "none"
"""The `calibration_file` of a rig whose owner accepts the nominal ranges of the card."""


class ComediSettings(MSeriesWiring):
    """Which terminals of which card, in what ranges, and where its calibration lies.

    There is no timeout: the kernel's driver itself gives up on a converter that is silent, and
    a program cannot change how long it waits.
    """

    device: Annotated[
        str, Field(pattern="^/dev/comedi[0-9]+$", description="the card's device file")
    ] = "/dev/comedi0"
    encoder_a_pfi: Annotated[
        int, Field(ge=0, le=15, description="PFI line of the encoder's A; the 37-pin card has 0-7")
    ] = 8
    encoder_b_pfi: Annotated[
        int, Field(ge=0, le=15, description="PFI line of the encoder's B; the 37-pin card has 0-7")
    ] = 10
    calibration_file: Annotated[
        str,
        Field(
            description="made by `comedi_soft_calibrate`; empty: where comedi keeps it; none: "
            "nominal ranges, wrong by some 5 %"
        ),
    ] = ""

    @model_validator(mode="after")
    def _check_lines(self) -> Self:
        if self.encoder_a_pfi == self.encoder_b_pfi:
            raise ValueError("encoder_a_pfi and encoder_b_pfi must be two lines")
        return self
