"""How often the monitor is wrong, and how soon it is right, on simulated operation.

    python scripts/monitor_study.py --hours 2 --effects --explain 0 --out study.json

False alarms: a rig that is what its plant file says, in segments of 20 to 120 s: experiments,
positions held, other gains; each begins from the vented muscle, as after a restart. Delays: each
effect of the catalogue, three times its smallest size of interest, over several excitations.
The simulated rig shares its kernels with the model, so this measures the statistics alone; with
`--hidden`, faultless rigs and effects come from the independent equations of `tests/hidden`.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from hidden.excitations import Excitation, multisine, tracking
from hidden.rig import HiddenRig, hidden_rig

from pamctl.control.experiment import HoldSettings
from pamctl.diagnose.record import Record
from pamctl.log.measured_signals import Signals
from pamctl.monitor.explain_alarm import explain_record
from pamctl.monitor.watch_run import RunWatch
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.model import PlantSettings
from pamctl.settings.resolve import resolve
from pamctl.signals import Phase
from pamctl.simulate.closed_loop import simulate_run

PLANT = "paper-valve109"
TIMES_SMALLEST = 3.0
SEEN_BY = ("tracking-1", "tracking-2", "multisine", "square-1", "null-staircase", "chirp")
CONTROLLERS = ("qsmc", "pid", "smc")


def make_signals(
    t_s: Any, valve_v: Any, pressure_pa: Any, position_m: Any, held_v: float
) -> Signals:
    return Signals(
        t_s=t_s,
        dt_s=np.diff(t_s, prepend=t_s[0] - 1e-3),
        valve_v=valve_v,
        pressure_pa=pressure_pa,
        position_m=position_m,
        force_n=None,
        missed=np.zeros(len(t_s), dtype=np.int64),
        phase=np.full(len(t_s), int(Phase.TRACK)),
        held_v=held_v,
    )


def run_pamctl(
    experiment: str, seed: int, seconds: float, *over: str, law: str = "qsmc"
) -> Signals:
    """Simulate a run; an experiment `hold` holds the position (mm) that `over` gives."""
    hold = experiment == "hold"
    settings = resolve(
        experiment=None if hold else experiment, controller=law, plant=PLANT,
        overrides=() if hold else over, seed=seed, duration_s=seconds, fast=True,
    )  # fmt: skip
    if hold:
        held = HoldSettings(kind="hold", position_mm=float(over[0]), hold_s=200.0)
        settings = settings.model_copy(update={"experiment": held})
    run = simulate_run(settings)
    return make_signals(run.t_s, run["valve_v"], run["pressure_pa"], run["position_m"], -5.0)


def draw_segment(random: np.random.Generator) -> tuple[str, str, list[str], float]:
    """Return an experiment, a law, overrides and a duration."""
    law = str(random.choice(CONTROLLERS))
    seconds = float(random.uniform(20.0, 120.0))
    kind = random.integers(4)
    if kind == 0:  # a position held
        return "hold", law, [f"{random.uniform(3.0, 18.0):.2f}"], seconds
    if kind == 1:  # other gains
        scale = random.uniform(0.6, 1.0)
        named = "lambda_per_s" if law != "pid" else "lpf1_hz"
        value = getattr(resolve(controller=law).controller, named) * scale
        return "tracking-2", law, [f"controller.{named}={value:.6g}"], seconds
    experiment = str(random.choice([*SEEN_BY, "sine", "triangle", "fill-and-hold", "slow-ramps"]))
    return experiment, law, [], seconds


def count_false_alarms(hours: float, seed: int) -> dict[str, Any]:
    """Watch a faultless rig; an alarm that ends and comes again counts twice."""
    random = np.random.default_rng(seed)
    watch = RunWatch(resolve(plant=PLANT).plant)
    now_s, alarms, raised = 0.0, [], set()
    spent_s, states = 0.0, {}
    while now_s < hours * 3600.0:
        experiment, law, over, seconds = draw_segment(random)
        measured = run_pamctl(experiment, int(random.integers(1 << 30)), seconds, *over, law=law)
        watch.begin_run()
        for first in range(0, len(measured), 1000):
            began_s = time.process_time()
            changed = watch.take(measured[first : first + 1000], now_s + first * 1e-3)
            spent_s += time.process_time() - began_s
            for block, report in changed.items():
                key = f"{block}: {report.state}"
                states[key] = states.get(key, 0) + 1
                if report.alarm is None:
                    raised.discard(block)
                elif block not in raised:
                    raised.add(block)
                    alarms.append([experiment, law, over, block, report.alarm.over_floor])
                    print("false alarm:", alarms[-1], flush=True)
        now_s += len(measured) * 1e-3 + 5.0
        if watch.windows % 50 < 3:
            print(
                f"{now_s / 3600:.2f} h, {watch.windows} windows, {len(alarms)} alarms", flush=True
            )
    return {
        "hours": now_s / 3600.0,
        "windows": watch.windows,
        "alarms": alarms,
        "states": states,
        "ms_a_window": 1e3 * spent_s / max(watch.windows, 1),
    }


def list_changes() -> dict[str, list[str]]:
    """Return the overrides that put each effect into the plant, at `TIMES_SMALLEST`."""
    changes = {}
    for name, effect in CATALOGUE.items():
        values = []
        for p in effect.parameters:
            if p.choices:
                continue
            away = TIMES_SMALLEST * p.smallest_of_interest
            size = p.neutral + (away if p.high > p.neutral else -away)
            values.append((p.name, size if p.role == "size" else p.start))
        changes[name] = [f"plant.effects.{name}.{key}={value:.8g}" for key, value in values]
    return changes


def find_delay_s(
    watch: RunWatch, healthy: Signals, changed: Signals, now_s: float = 0.0
) -> tuple[float | None, Record | None, Record | None]:
    """Return the time from the changed rig's start to its alarm; None where none came.

    With it the record since the start, and the one before it.
    """
    watch.take(healthy, now_s)
    begin_s = now_s + len(healthy) * 1e-3 + 5.0
    watch.begin_run()
    delay_s = None
    for first in range(0, len(changed), 1000):
        reports = watch.take(changed[first : first + 1000], begin_s + first * 1e-3)
        if delay_s is None and any(r.alarm for r in reports.values()):
            delay_s = (first + 1000) * 1e-3
    return delay_s, watch.recall(begin_s), watch.recall_before(begin_s)


def measure_delays(seconds: float, explain: int) -> dict[str, Any]:
    """Measure each effect's delay by excitation, on the simulated rig."""
    plant = resolve(plant=PLANT).plant
    delays: dict[str, Any] = {}
    healthy = run_pamctl("tracking-2", 1, 20.0)
    for name, over in list_changes().items():
        delays[name] = {}
        for experiment in SEEN_BY:
            try:
                changed = run_pamctl(experiment, 5, seconds, *over)
            except Exception as error:
                delays[name] = f"cannot be simulated: {error}".splitlines()[0][:100]
                break
            delays[name][experiment] = find_delay_s(RunWatch(plant), healthy, changed)[0]
        print(name, delays[name], flush=True)
    return delays


def plant_of(rig: HiddenRig) -> PlantSettings:
    """Return the plant file that belongs to a hidden rig without effects."""
    truth = rig.truth
    return PlantSettings.model_validate(
        {"parameters": {
            "damping_n_s_per_m": truth.damping,
            "stiffness_n_per_m": truth.stiffness,
            "kinetic_friction_per_m": truth.mu_k,
            "valve_gain_m2_per_v": truth.valve_m2_per_v,
            "tank_pressure_pa": truth.supply_pa,
            "braid_length_m": truth.braid_m,
        }}
    )  # fmt: skip


def run_hidden(rig: HiddenRig, excitation: Excitation) -> Signals:
    record = rig.run(excitation).record
    return make_signals(
        record.t_s, record.valve_v, record.pressure_pa, record.position_m, excitation.rest_v
    )


HIDDEN = (
    "chamber_leak", "valve_leak", "valve_deadband", "valve_hysteresis", "command_delay",
    "supply_droop", "valve_spool", "valve_asymmetry", "creep", "stribeck", "coulomb_friction",
    "return_friction", "cubic_stiffness", "encoder_backlash",
)  # fmt: skip


def watch_hidden(rigs: int, explain: int) -> dict[str, Any]:
    """Watch hidden rigs: faultless ones for false alarms, then each effect at size 3."""
    false, windows, delays, names = [], 0, {}, {}
    for seed in range(rigs):
        rig = hidden_rig({}, seed=seed)
        watch = RunWatch(plant_of(rig))
        for k in range(6):
            watch.begin_run()
            excitation = tracking(18.0, seed + k) if k % 2 else multisine(1.5, 0.3, 40.0, 18.0, k)
            reports = watch.take(run_hidden(rig, excitation), 30.0 * k)
            false += [[seed, b] for b, r in reports.items() if r.alarm]
        windows += watch.windows
    print("hidden, faultless:", windows, "windows, alarms", false, flush=True)
    for number, name in enumerate(HIDDEN):
        rig, faulty = (hidden_rig(e, seed=3) for e in ({}, {name: TIMES_SMALLEST}))
        plant = plant_of(rig)
        delays[name] = {}
        for excitation in (tracking(18.0, 53), multisine(2.0, 0.3, 50.0, 18.0, 53)):
            changed = run_hidden(faulty, excitation)
            healthy = run_hidden(rig, tracking(18.0, 3))
            delay_s, record, before = find_delay_s(RunWatch(plant), healthy, changed)
            delays[name][excitation.name] = delay_s
            if delay_s is not None and number < explain and record is not None:
                names.setdefault(name, explain_record(record, plant, before))
        print(name, delays[name], names.get(name, {}).get("sentence", ""), flush=True)
    return {"windows": windows, "false_alarms": false, "delays_s": delays, "explained": names}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hours", type=float, default=0.0, help="of faultless operation")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--effects", action="store_true", help="delays on the simulated rig")
    parser.add_argument("--hidden", type=int, default=0, help="number of faultless hidden rigs")
    parser.add_argument("--explain", type=int, default=0, help="hidden effects to diagnose too")
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    found: dict[str, Any] = {}
    if asked.effects:
        found["delays_s"] = measure_delays(15.0, asked.explain)
    if asked.hidden:
        found["hidden"] = watch_hidden(asked.hidden, asked.explain)
    if asked.hours:
        found["false_alarms"] = count_false_alarms(asked.hours, asked.seed)
    text = json.dumps(found, indent=1)
    print(text) if asked.out is None else asked.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
