"""How often a diagnosis names or describes something where only the sensors are hostile.

    python scripts/null_study.py [--seeds 3,4,5] [--only TEXT] [--resume FILE] [--jobs N]

The physics is the model's, with numbers that a recalibration finds. What is wrong is how it was
read: hum, spikes, wander, jitter, noise that follows the flow, offline filters, coarse converters.
Three records of 7 to 9 s a case, two of them to fit. A verdict `described` or `named` is false in
each. One line of JSON a case is appended to FILE; the table goes to stdout.
"""

from __future__ import annotations

import argparse
import sys
import zlib
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "scripts")]

from hidden.excitations import Excitation, tracking  # noqa: E402
from hidden.hostile.file_of_lab import record_of  # noqa: E402
from hidden.hostile.lab import Lab  # noqa: E402
from hidden.hostile.programs import compose_open, shake_levels  # noqa: E402
from hidden.rig import hidden_rig  # noqa: E402
from resumable_study import run_resumable  # noqa: E402

from pamctl.diagnose import Record, diagnose  # noqa: E402
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document  # noqa: E402
from pamctl.plant.model import PlantSettings  # noqa: E402

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

FALSE = ("described", "named")


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


def examine(case: NullCase) -> dict[str, Any]:
    """Diagnose one case."""
    rig = hidden_rig({}, seed=zlib.crc32(case.key.encode()) % 1000)
    made = [record_of(rig, NULLS[case.kind], run, k / 2) for k, run in enumerate(case.excite())]
    records = [Record(name=r.name, **r.columns()) for r in made]
    began = process_time()
    diagnosis = diagnose(records[:2], records[2:], PlantSettings())
    document = build_diagnosis_document(diagnosis)
    described = diagnosis.described
    return {
        "key": case.key,
        "verdict": document["verdict"],
        "effects": [e["name"] for e in document["effects"]],
        "terms": [t["text"] for t in document["terms"]],
        "leads": [lead.text for lead in described.leads] if described else [],
        "setup": [[s["kind"], s["number"]] for s in document["setup"]],
        "cpu_s": round(process_time() - began, 1),
    }  # fmt: skip


def describe(result: dict[str, Any]) -> str:
    """Return what was said, in one line."""
    said = [*result["effects"], *result["terms"], *(kind for kind, _ in result["setup"])]
    return f"{result['verdict']} {', '.join(said)} {result['cpu_s']} s"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", default="1,2,3,4,5")
    parser.add_argument("--only", default="", help="only kinds whose name contains this")
    parser.add_argument("--resume", type=Path, default=Path("logs/nulls.jsonl"))
    parser.add_argument("--jobs", type=int, default=1)
    given = parser.parse_args()
    cases = [
        NullCase(kind, seed)
        for seed in map(int, given.seeds.split(","))
        for kind in NULLS
        if given.only in kind
    ]
    tasks = {case.key: case for case in cases}
    found = run_resumable(tasks, examine, given.resume, given.jobs, describe)
    results = [found[case.key] for case in cases]
    false = [r for r in results if r["verdict"] in FALSE]
    counts = Counter(r["verdict"] for r in results)
    print(f"{len(false)} of {len(results)} nulls named or described "
          f"({len(false) / len(results):.1%}); {dict(counts)}")  # fmt: skip
    for result in results:
        if result["effects"] or result["terms"]:
            print(f"- {result['key']}: {describe(result)}")


if __name__ == "__main__":
    main()
