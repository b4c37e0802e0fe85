"""Does a law track better on a rig with a hidden effect if the tick undoes that effect?

    python scripts/compensation_study.py [--effect NAME:SIZE ...] [--law qsmc ...]
        [--duration 16] [--json]

The rigs are those of tests/hidden: they share no code with the plant, and run here under the loop's
own tick in experiment 2. Each law tracks without compensation, with the rig's true numbers, and
with numbers that are 30 % too large and too small. Errors are of the true displacement. Markdown
on stdout, or one JSON document; progress on stderr. Exit code 3 if a compensated run is worse.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from hidden.plant import HiddenPlant  # noqa: E402
from hidden.rig import HiddenRig, hidden_rig  # noqa: E402
from support.runs import run  # noqa: E402

from pamctl.exit_codes import ExitCode  # noqa: E402
from pamctl.plant.catalogue import CATALOGUE  # noqa: E402
from pamctl.settings.resolve import resolve  # noqa: E402
from pamctl.simulate.merit import compute_merit  # noqa: E402

RIGS = (
    "valve_deadband:2", "valve_deadband:5", "valve_asymmetry:5", "valve_curve:5",
    "valve_curve/power:5", "valve_saturation:5", "encoder_scale:5", "pressure_sensor_gain:5",
    "pressure_sensor_offset:5",
)  # fmt: skip
LAWS = ("qsmc", "smc", "pid")
SHARES = {"none": 0.0, "true": 1.0, "30 % more": 1.3, "30 % less": 0.7}
"""How much of the effect is undone; with `none` there is no compensation."""
SEED = 20
NOISE_UM = 1.0
"""Differences below it, in the RMS error, are not counted: a third of the encoder's step."""


class Known(NamedTuple):
    """The rig's own numbers as a plant file has them."""

    effect: str
    values: dict[str, float]


@dataclass(frozen=True)
class Tracked:
    """One run."""

    rig: str
    law: str
    undone: str
    max_um: float | None
    """None if the run did not end well; `outcome` says how it ended."""
    rms_um: float | None
    travel_v_per_s: float
    """How far the valve's command travels in a second: chatter shows here."""
    outcome: str


def read_numbers(name: str, rig: HiddenRig) -> Known:
    """Return what a perfect diagnosis would write."""
    truth, sensors = rig.truth, rig.sensors
    effect = name.partition("/")[0]
    known: Mapping[str, Mapping[str, float]] = {
        "valve_deadband": {
            "fill_width_v": truth.overlap_fill_v, "exhaust_width_v": truth.overlap_vent_v,
        },
        "valve_asymmetry": {"exhaust_gain": truth.vent_gain},
        "valve_curve": {
            "curvature_per_v": truth.curve_per_v, "exponent": truth.curve_exponent,
        },
        "valve_saturation": {"shortfall_v": 5.0 - truth.drive_limit_v},
        "encoder_scale": {"scale": sensors.encoder_scale},
        "pressure_sensor_gain": {"gain": sensors.pressure_gain},
        "pressure_sensor_offset": {"offset_pa": sensors.pressure_offset_pa},
    }  # fmt: skip
    return Known(effect, dict(known[effect]))


def scale_numbers(known: Known, share: float) -> dict[str, float]:
    """Return the numbers of a diagnosis that found a share of the effect."""
    neutral = {p.name: p.neutral for p in CATALOGUE[known.effect].parameters}
    return {n: neutral[n] + share * (v - neutral[n]) for n, v in known.values.items()}


def track_on(name: str, law: str, undone: str, duration_s: float) -> Tracked:
    """Run experiment 2 on a hidden rig."""
    effect, _, size = name.partition(":")
    rig = hidden_rig({effect: float(size)}, seed=SEED)
    known = read_numbers(effect, rig)
    share = SHARES[undone]
    base = resolve(
        controller=law, experiment="tracking-2", fast=True, seed=SEED, duration_s=duration_s
    )
    if share:
        numbers = scale_numbers(known, share)
        plant = type(base.plant).model_validate({"effects": {known.effect: numbers}})
        compensating = base.rig.model_copy(update={"compensate": (known.effect,)})
        base = base.model_copy(update={"plant": plant, "rig": compensating})
    done = run(base, plant=HiddenPlant(rig))
    ticks = done.journal.ticks
    t_s = np.array([r.timing.t_s for r in ticks])
    phase = np.array([r.reference.phase for r in ticks])
    true_m = np.array([r.truth.true_position_m for r in ticks]) / rig.sensors.encoder_scale
    error_m = true_m - np.array([r.reference.reference_m for r in ticks])
    valve_v = np.array([r.decision.valve_v for r in ticks])[t_s > t_s[-1] / 2.0]
    whole = done.ending.code == ExitCode.OK
    found = compute_merit(t_s, phase, error_m) if whole else None
    result = Tracked(
        name,
        law,
        undone,
        None if found is None else found.max_m * 1e6,
        None if found is None else found.rms_m * 1e6,
        float(np.mean(np.abs(np.diff(valve_v)))) * base.rig.loop.rate_hz,
        "complete" if whole else done.ending.reason,
    )
    print(_format_run(result), file=sys.stderr, flush=True)
    return result


def _format_run(one: Tracked) -> str:
    figures = one.outcome if one.rms_um is None else f"{one.max_um:.0f} / {one.rms_um:.1f} um"
    return f"{one.rig}, {one.law}, {one.undone}: {figures}, {one.travel_v_per_s:.0f} V/s"


def find_worse(results: list[Tracked]) -> list[Tracked]:
    """Return the compensated runs whose RMS error is above that without compensation."""
    without = {(r.rig, r.law): r for r in results if r.undone == "none"}
    return [
        r
        for r in results
        if r.undone != "none"
        and (base := without[r.rig, r.law]).rms_um is not None
        and (r.rms_um is None or r.rms_um > max(base.rms_um + NOISE_UM, 1.02 * base.rms_um))
    ]


def markdown(results: list[Tracked]) -> Iterator[str]:
    """One row a rig and law: max / RMS (um)."""
    yield f"| hidden, size | law | {' | '.join(SHARES)} |"
    yield "| --- | --- |" + " --- |" * len(SHARES)
    for rig, law in dict.fromkeys((r.rig, r.law) for r in results):
        cells = [
            r.outcome if r.rms_um is None else f"{r.max_um:.0f} / {r.rms_um:.1f}"
            for r in results
            if (r.rig, r.law) == (rig, law)
        ]
        yield f"| `{rig.replace(':', '`, ')} | {law} | {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--effect", action="append", metavar="NAME:SIZE")
    parser.add_argument("--law", action="append", choices=LAWS)
    parser.add_argument("--duration", type=float, default=16.0, metavar="S")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    results = [
        track_on(rig, law, undone, options.duration)
        for rig in options.effect or RIGS
        for law in options.law or LAWS
        for undone in SHARES
    ]
    worse = find_worse(results)
    if options.json:
        document: dict[str, Any] = {
            "runs": [asdict(result) for result in results],
            "worse": [asdict(result) for result in worse],
        }
        print(json.dumps(document, indent=2))
    else:
        print("\n".join(markdown(results)))
        print(f"\n{len(worse)} of the compensated runs are worse than without.")
    sys.exit(3 if worse else 0)


if __name__ == "__main__":
    main()
