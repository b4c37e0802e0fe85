"""An NI M Series card, whichever driver serves it: its terminals, its output, its counter."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from hal.configured import Configured
from hal.converter import Converter, Output, make_output


class MSeriesWiring(Configured):
    """Which terminals of which card, and in what ranges."""

    device: str
    """Name of the card, as its driver knows it."""
    pressure_channel: Annotated[str, Field(pattern="^ai([0-9]|[1-7][0-9])$")] = "ai0"
    terminal: Annotated[
        Literal["rse", "nrse", "diff"],
        Field(description="rse for a sensor fed by the card, nrse for one grounded elsewhere"),
    ] = "rse"
    input_low_v: Annotated[float, Field(ge=-10, le=10)] = -5.0
    input_high_v: Annotated[
        float, Field(ge=-10, le=10, description="the card takes its narrowest range that fits")
    ] = 5.0
    encoder_counter: Literal["ctr0", "ctr1"] = "ctr0"
    encoder_filter_ns: Annotated[
        Literal[0, 125, 6425],
        Field(description="shortest pulse that counts; 6425 loses counts above 0.99 m/s, 0 is off"),
    ] = 125
    valve_channel: Literal["ao0", "ao1"] = "ao0"
    output_low_v: Annotated[float, Field(ge=-10, le=10)] = 0.0
    output_high_v: Annotated[
        float, Field(ge=-10, le=10, description="no voltage outside these two leaves the rig")
    ] = 10.0

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if self.input_low_v >= self.input_high_v:
            raise ValueError("input_low_v must be below input_high_v")
        if self.output_low_v >= self.output_high_v:
            raise ValueError("output_low_v must be below output_high_v")
        return self


_CONVERTER = Converter(10.0)
"""An M Series output is always +-10 V, whatever range its channel is given."""


def card_output(wiring: MSeriesWiring) -> Output:
    """Return the valve's output as the card realises it."""
    return make_output(_CONVERTER, wiring.output_low_v, wiring.output_high_v)


def unwrap_count(last: int, reading: int, span: int = 1 << 32) -> int:
    """Return the count nearest to `last` that a counter of `span` values shows as `reading`.

    It makes no difference whether the counter shows -1 as -1 or as `span - 1`.
    """
    half = span // 2
    return last + (reading - last + half) % span - half
