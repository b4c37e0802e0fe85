"""The noise that a user states, by channel: `position_m=2e-6`."""

from __future__ import annotations

from collections.abc import Iterable
from math import isfinite

from pamctl.diagnose.measured.record import CHANNELS

SENSORS = {channel: unit for channel, unit in CHANNELS.items() if channel != "valve_v"}


def parse_noise(texts: Iterable[str]) -> dict[str, float]:
    """Return standard deviations in SI by channel; raise ValueError with what is wrong."""
    stated: dict[str, float] = {}
    for text in texts:
        channel, equals, number = text.partition("=")
        channel = channel.strip()
        if channel not in SENSORS or not equals:
            listed = ", ".join(f"{name}=... ({unit})" for name, unit in SENSORS.items())
            raise ValueError(f"{text!r} states no channel's noise; give {listed}")
        if channel in stated:
            raise ValueError(f"{channel} is stated twice")
        try:
            deviation = float(number)
        except ValueError:
            deviation = float("nan")
        if not isfinite(deviation) or deviation < 0.0:
            raise ValueError(
                f"{channel} is {number.strip()!r}, but must be a number of {SENSORS[channel]} that "
                "is 0 or more: the standard deviation of a reading"
            )
        stated[channel] = deviation
    return stated
