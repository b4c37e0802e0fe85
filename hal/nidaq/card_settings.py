"""The section `nidaq` of a rig file, and the driver's error numbers that a user can act on.

Numbers rather than the package's names: names differ between versions of the package, and
between a warning and its error.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from hal.card import MSeriesWiring


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
        str | None, Field(exclude=True, description="without effect; old rig files have it")
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


INSTALL = (
    "install NI-DAQmx for Linux (package ni-daqmx from NI's repository), reboot, "
    "and check that `nilsdev` lists the card; or run with --backend sim"
)

PACKAGE_BROKEN = "move a broken .env or settings.ini out of this directory, or reinstall pamctl"

ON_DEMAND = "set nidaq.timing: on_demand in the rig file"
_NOT_TIMED = f"this card cannot do this: {ON_DEMAND}"

_NOT_POLLED = (
    "hardware-timed single points need programmed I/O: set nidaq.data_transfer: polled in the rig "
    f"file; where it is so already, {ON_DEMAND}"
)

NOT_OFFERED = frozenset({-200077, -200197, -200452})
"""The driver does not know a property here, or does not offer a value of it."""

LATE = frozenset({-209800, -209801, -209802, -209803})
"""A read or a write was not done before the next edge of the sample clock."""

BUSY_CODES = frozenset({-50103, -200022})
"""Another program holds a part of the card."""

_BUSY = "another program holds this part of the card: end it (a run of pamctl? a test panel?)"
_ABSENT = (
    "check that the card is seated and powered and that `nilsdev` lists it under the name "
    "in nidaq.device of the rig file"
)
_TIMEOUT = "the card did not answer in time: is the PC overloaded, or the card failing?"
_OUTPUT_RANGE = "check nidaq.output_low_v and nidaq.output_high_v of the rig file"

FIXES: Mapping[int, str] = {
    **dict.fromkeys(BUSY_CODES, _BUSY),
    -50152: "the driver cannot talk to the card: reboot. Where only hardware timing fails, the "
    "IOMMU may block the card's interrupts and transfers: look for DMAR, AMD-Vi or IO_PAGE_FAULT "
    f"in `sudo dmesg` and start the PC with iommu=pt, or {ON_DEMAND}",
    -200077: "the card does not offer a value of section nidaq of the rig file (its timing?): "
    "the message names the property and what can be selected",
    -200170: "the card has no such channel: check the channels in section nidaq of the rig file",
    -200220: _ABSENT,
    -200284: _TIMEOUT,
    -200303: _NOT_TIMED,
    -200452: _NOT_TIMED,
    -200474: _TIMEOUT,
    -200561: _OUTPUT_RANGE,
    **dict.fromkeys((-200769, -200842, -200996), _NOT_POLLED),
    -200820: _NOT_TIMED,
    -200821: _NOT_TIMED,
    -201003: _ABSENT,
    **dict.fromkeys(LATE, "the PC is too slow for rig.loop.rate_hz, or was stopped for long"),
}


def fix_of(code: int) -> str:
    """Return what to do about an error of NI-DAQmx."""
    return FIXES.get(code, "look the number up at ni.com, and see whether a reboot helps")
