"""Healthy rigs that are read badly: hum, spikes, wander, jitter, filters, coarse converters.

The physics is the model's, with numbers that a recalibration finds. Whatever is named or described
is false. Three records of 7 to 9 s a case, two of them to fit.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace

from hidden.excitations import Excitation, tracking
from hidden.hostile.file_of_lab import record_of
from hidden.hostile.lab import Lab
from hidden.hostile.programs import compose_open, shake_levels
from hidden.rig import Record, hidden_rig
from pamctl.plant.model import PlantSettings

HUM = Lab(hum_hz=50.0)
SPIKES = Lab(spikes=0.002)
NULLS = {
    "wander_1s": Lab(wander_pa=1000.0, wander_s=1.0),
    "wander_5s": Lab(wander_pa=2000.0, wander_s=5.0),
    "wander_fast": Lab(wander_pa=1500.0, wander_s=0.2),
    "wander_slow": Lab(wander_pa=3000.0, wander_s=20.0),
    "wander_large": Lab(wander_pa=5000.0, wander_s=2.0),
    "wander_small": Lab(wander_pa=400.0, wander_s=2.0),
    "hum_50": replace(HUM, hum_pa=1000.0),
    "hum_large": replace(HUM, hum_pa=5000.0),
    "hum_16": Lab(hum_hz=16.7, hum_pa=1500.0),
    "hum_encoder": Lab(hum_hz=60.0, hum_pa=500.0, hum_m=30e-6),
    "hum_slow": Lab(hum_hz=5.0, hum_pa=800.0),
    "spikes": replace(SPIKES, spike_pa=20e3),
    "spikes_small": replace(SPIKES, spike_pa=4e3),
    "spikes_encoder": replace(SPIKES, spike_m=0.3e-3),
    "spikes_many": Lab(spikes=0.01, spike_pa=30e3, spike_m=0.1e-3),
    "dropouts": Lab(dropouts=0.002),
    "jitter_small": Lab(jittered_stamps_s=0.1e-3),
    "jitter": Lab(jittered_stamps_s=0.4e-3),
    "flow_noise": Lab(noise_with_flow=2.0),
    "flow_noise_large": Lab(noise_with_flow=6.0),
    "filtfilt_100": Lab(filter_hz=100.0),
    "filtfilt_40": Lab(filter_hz=40.0),
    "filtfilt_20": Lab(filter_hz=20.0),
    "bits_12": Lab(adc_bits=12),
    "bits_10": Lab(adc_bits=10),
    "bits_8": Lab(adc_bits=8),
    "clock_of_all": Lab(time_rate=0.01),
    "wander_and_hum": Lab(wander_pa=1500.0, wander_s=2.0, hum_hz=50.0, hum_pa=1500.0),
    "wander_and_spikes": Lab(wander_pa=1500.0, wander_s=1.0, spikes=0.002, spike_pa=15e3),
    "flow_noise_and_bits": Lab(noise_with_flow=3.0, adc_bits=10),
}
"""Thirty ways to read a healthy rig badly."""


@dataclass(frozen=True)
class NullCase:
    """A healthy rig that is read badly."""

    kind: str
    seed: int

    @property
    def key(self) -> str:
        """Its name in the results."""
        return f"{self.kind}/{self.seed}"

    def excite(self) -> list[Excitation]:
        """Return three runs: open, in closed loop, or at random levels, in turn by kind."""
        draw = zlib.crc32(self.key.encode()) % 100_000
        way = (list(NULLS).index(self.kind) + self.seed) % 3
        if way == 0:
            return [compose_open(draw + 101 * k, 1.2, 2.0, 1.6) for k in range(3)]
        if way == 1:
            runs = [tracking(7.0, draw + 101 * k) for k in range(3)]
            return [replace(run, name=f"closed-loop-{k}") for k, run in enumerate(runs)]
        return [shake_levels(draw + 101 * k, 7.0) for k in range(3)]

    def records(self) -> tuple[list[Record], list[Record]]:
        """Return the records for the fit, and the one to judge by."""
        rig = hidden_rig({}, seed=zlib.crc32(self.key.encode()) % 1000)
        made = [record_of(rig, NULLS[self.kind], run, k / 2) for k, run in enumerate(self.excite())]
        return made[:2], made[2:]

    def start_plant(self) -> PlantSettings:
        """Return the paper's plant."""
        return PlantSettings()
