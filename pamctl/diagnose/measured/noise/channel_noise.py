"""What is known of each channel's noise, in one place: its size, its source, and its faults."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pamctl.diagnose.measured.noise.filtering import find_filtering
from pamctl.diagnose.measured.noise.mend import SensorFault
from pamctl.diagnose.measured.noise.sensor_noise import Noise
from pamctl.diagnose.measured.record import CHANNELS, Record

SOURCES = {
    "stated": "as stated",
    "rest": "from the rests",
    "spectrum": "from the end of the spectrum",
}


@dataclass(frozen=True)
class ChannelNoise:
    """One channel; the time stamps, `t_s`, and channels that are not used have faults only."""

    noise: Noise | None
    faults: tuple[SensorFault, ...] = ()

    def as_dict(self, channel: str) -> dict[str, Any]:
        """Return plain values for the document."""
        entry: dict[str, Any] = {}
        if self.noise is not None:
            noise = self.noise
            entry = {
                "deviation": noise.total if noise.is_known else None,
                "unit": CHANNELS[channel],
                "resolution": noise.resolution,
                "source": noise.source,
                "is_known": noise.is_known,
            }
        return {
            **entry,
            "faults": list(dict.fromkeys(fault.kind for fault in self.faults)),
            "says": [
                *([] if self.noise is None else [self.describe(channel)]),
                *(fault.says for fault in self.faults),
            ],
        }

    def list_faults(self, channel: str) -> list[str]:
        """Return a line for each fault, and one where the noise is unknown."""
        unknown = self.noise is not None and not self.noise.is_known
        return [*([self.describe(channel)] if unknown else []), *(f.says for f in self.faults)]

    def describe(self, channel: str) -> str:
        """Say how large the noise is and how that is known."""
        if self.noise is None:
            return ""
        if not self.noise.is_known:
            return (
                f"{channel}: noise unknown: the data do not tell it from the signal; state it with "
                f"`--noise {channel}=...`, in {CHANNELS[channel]}, or record a rest of 1 s"
            )
        return (
            f"{channel}: noise {self.noise.total:.3g} {CHANNELS[channel]}, "
            f"{SOURCES[self.noise.source]}"
        )


def describe_channels(
    records: Sequence[Record], noises: Mapping[str, Noise], mended: Iterable[SensorFault]
) -> dict[str, ChannelNoise]:
    """Return what is known of each channel; `mended` is what was taken off before."""
    faults = [*mended]
    for channel in noises:
        faults += _find_faults(records, channel)
    named = dict.fromkeys([*noises, *(fault.channel for fault in faults)])
    return {
        name: ChannelNoise(noises.get(name), tuple(f for f in faults if f.channel == name))
        for name in named
    }


def _find_faults(records: Sequence[Record], channel: str) -> Iterator[SensorFault]:
    filtering = find_filtering(records, channel)
    if filtering is not None:
        at = "" if filtering.cutoff_hz is None else f" near {filtering.cutoff_hz:.3g} Hz"
        how = ", forwards and backwards: it answers before its cause"
        how = how if filtering.is_zero_phase else ""
        says = f"{channel} was filtered{at}{how}; use the data as they were measured"
        yield SensorFault(channel, "filtered", says)
