"""Speed of the simulation, and its distance from the converged solution, in one run.

    python scripts/bench_simulation.py > simulation.json

JSON on stdout, a table on stderr. Rounds interleave all variants, so that disturbances of the
machine affect all of them; times are CPU times. The table gives the median and the best round: a
neighbour on the other half of the core can double the median, but hardly the best.

- the plant alone, compiled and in plain Python, at 1, 2 and 4 steps a tick, with the largest error
  of position against 512 steps a tick;
- the whole closed loop, compiled: plant, sensors, filters, law, safety;
- LSODA restarted every tick, as a general solver in a control loop must be, on the same model
  with a smoothed friction jump (SciPy needs that);
- one step of each law, and one whole tick, in plain Python: the cost in the real-time loop.
"""

from __future__ import annotations

import argparse
import gc
import json
import math
import os
import platform
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import odeint, solve_ivp

from hal.rig import RawSample
from hal.sim import sensed_counts, sensed_pressure_v, sensor_chain
from pamctl.control.experiment import plan_experiment
from pamctl.control.law import Memory, respond
from pamctl.kernel.calls import machine, prepare
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.paper import axial_forces, force_area_m2, valve_flow, volume_m3
from pamctl.plant.parameters import PlantParameters, PlantState, vented_state
from pamctl.plant.step import advance_plant
from pamctl.realtime.tick import TickState, first_state, step
from pamctl.settings.build import build_tick_setup
from pamctl.settings.resolve import resolve
from pamctl.signals import Estimate, Reference, Timing
from pamctl.simulate.closed_loop import draw_sensor_noise, simulate, tabulate_references

TICK_S = 1e-3
LAWS = ("qsmc", "smc", "pid")
STEPS = (1, 2, 4)
P = plant_parameters(PlantSettings())

SQUARE_V = [5.0 if i % 1000 < 500 else -5.0 for i in range(2000)]
SMALL_V = [
    0.0 if i // 250 % 4 == 3 else 1.5 * math.sin(2 * math.pi * 3 * i * TICK_S) for i in range(2000)
]
COMMANDS_V = {"square +-5 V 1 Hz": SQUARE_V, "sine 1.5 V 3 Hz with holds": SMALL_V}

LAW_TICKS = 5000
LSODA_TICKS = 700
"""For the square: filling, rest at the top, the stuck 14 ms after the switch, and venting."""


# The plant.


def run_plant(
    p: PlantParameters,
    state: PlantState,
    commands_v: NDArray[np.float64],
    longest_step_s: float,
    positions_m: NDArray[np.float64],
) -> None:
    """Kernel: hold each command for a tick."""
    for i in range(len(commands_v)):
        state = advance_plant(p, state, commands_v[i], 1e-3, longest_step_s)
        positions_m[i] = state.position_m


def run_plant_plain(commands_v: Sequence[float], steps: int) -> list[float]:
    state, positions_m = vented_state(P), []
    for command_v in commands_v:
        state = advance_plant(P, state, command_v, TICK_S, TICK_S / steps)
        positions_m.append(state.position_m)
    return positions_m


def run_plant_compiled(commands_v: NDArray[np.float64], steps: int) -> NDArray[np.float64]:
    positions_m = np.empty_like(commands_v)
    machine(run_plant)(P, vented_state(P), commands_v, TICK_S / steps, positions_m)
    return positions_m


def plant_errors_um() -> dict[str, dict[int, float]]:
    """Largest error of position, by command and steps a tick."""
    errors: dict[str, dict[int, float]] = {}
    for name, commands_v in COMMANDS_V.items():
        converged_m = run_plant_compiled(np.array(commands_v), 512)
        errors[name] = {
            steps: largest_um(run_plant_compiled(np.array(commands_v), steps), converged_m)
            for steps in STEPS
        }
    return errors


def largest_um(positions_m: Any, converged_m: NDArray[np.float64]) -> float:
    difference_m = np.abs(np.asarray(positions_m) - converged_m[: len(positions_m)])
    return float(difference_m.max() * 1e6)


# LSODA, restarted every tick.


class Lsoda(NamedTuple):
    """One way to call LSODA."""

    compiled_rates: bool
    in_c: bool
    """`odeint`, whose loop over the solver's steps is Fortran and C; else `solve_ivp`."""
    rtol: float
    slip_m_per_s: float
    """Friction rises from 0 to its full value over this range of speed."""


LSODA = {
    "solve_ivp, plain rates, 1e-6": Lsoda(False, False, 1e-6, 1e-5),
    "solve_ivp, compiled rates, 1e-6": Lsoda(True, False, 1e-6, 1e-5),
    "odeint, plain rates, 1e-6": Lsoda(False, True, 1e-6, 1e-5),
    "odeint, compiled rates, 1e-6": Lsoda(True, True, 1e-6, 1e-5),
    "odeint, compiled rates, 1e-4": Lsoda(True, True, 1e-4, 1e-4),
}


def rates(t: float, y: Any, command_v: float, slip_m_per_s: float) -> tuple[float, float, float]:
    """Kernel: Eq. 9 for a general solver, with a smoothed friction jump."""
    x, v, pressure_pa = y[0], y[1], y[2]
    forces = axial_forces(P.paper, x, pressure_pa)
    friction_n = forces.damping_down_n_s_per_m * v
    if v > 0.0:
        friction_n = forces.damping_up_n_s_per_m * v + forces.upper_n * min(v / slip_m_per_s, 1.0)
    inflow = P.paper.specific_energy_j_per_kg * valve_flow(P.paper, command_v, pressure_pa)
    return (
        v,
        (forces.drive_n - friction_n) / P.paper.mass_kg,
        (inflow - pressure_pa * force_area_m2(P.paper, x) * v) / volume_m3(P.paper, x),
    )


def fill_rates(
    y: NDArray[np.float64], command_v: float, slip_m_per_s: float, found: NDArray[np.float64]
) -> None:
    """Kernel: fill what `rates` returns."""
    found[0], found[1], found[2] = rates(0.0, y, command_v, slip_m_per_s)


class CompiledRates:
    """`rates` in machine code, for one command after the other."""

    def __init__(self, slip_m_per_s: float) -> None:
        self._y, self._found = np.zeros(3), np.zeros(3)
        given = {
            "y": self._y, "command_v": 0.0, "slip_m_per_s": slip_m_per_s, "found": self._found,
        }  # fmt: skip
        self.call = prepare(fill_rates, given)

    def __call__(self, t: float, y: Any, *given: float) -> NDArray[np.float64]:
        """Return what `rates` does; the command is that of `call`."""
        self._y[:] = y
        self.call.run()
        return self._found


def run_lsoda(how: Lsoda, commands_v: Sequence[float]) -> list[float]:
    compiled = CompiledRates(how.slip_m_per_s) if how.compiled_rates else None
    right_hand_side = compiled or rates
    atol = [how.rtol * scale for scale in (1e-3, 1e-1, 1e5)]
    state: Any = [0.0, 0.0, P.paper.atmospheric_pressure_pa]
    positions_m = []
    for command_v in commands_v:
        given = (command_v, how.slip_m_per_s)
        if compiled is not None:
            compiled.call.put("command_v", command_v)
        if how.in_c:
            ends = (0.0, TICK_S)
            state = odeint(
                right_hand_side, state, ends, given, rtol=how.rtol, atol=atol, tfirst=True
            )[-1]
        else:
            state = solve_ivp(
                right_hand_side,
                (0.0, TICK_S),
                state,
                method="LSODA",
                args=given,
                rtol=how.rtol,
                atol=atol,
                t_eval=(TICK_S,),
            ).y[:, -1]
        positions_m.append(float(state[0]))
    return positions_m


# The closed loop.


class ClosedLoop:
    """A law with its shipped gains on experiment 2, and its inputs."""

    def __init__(self, law: str) -> None:
        settings = resolve(controller=law, overrides=["rig.homing.enabled=false"], fast=True)
        rig: Any = settings.rig
        self.setup = build_tick_setup(settings)
        self.chain = sensor_chain(rig.sim, rig.calibration)
        self.reference = tabulate_references(plan_experiment(settings.experiment).segments, TICK_S)
        self.noise = draw_sensor_noise(len(self.reference), 0)
        self.batch = self.simulate()
        self.seconds = len(self.batch["position_m"]) * TICK_S

    def simulate(self) -> Any:
        """Run the whole experiment."""
        return simulate(self.setup, P, self.chain, self.reference, self.noise)

    def ticks(self, count: int) -> list[tuple[RawSample, Reference, Timing]]:
        """The inputs of the tick, from the middle of the approach on."""
        xs, pressures = self.batch["true_position_m"], self.batch["true_pressure_pa"]
        first = 2000
        return [
            (
                RawSample(
                    sensed_pressure_v(self.chain, float(pressures[i]), float(self.noise[i])),
                    sensed_counts(self.chain, float(xs[i])),
                    i * 1_000_000,
                    i * 1_000_000,
                ),
                Reference(int(self.reference[i, 0]), *map(float, self.reference[i, 1:])),
                Timing(i, i * TICK_S, TICK_S, 0.0, 0),
            )
            for i in range(first, first + count)
        ]

    def start(self) -> TickState:
        """Return the state before the first tick, homed."""
        return first_state(self.setup, self.chain.zero._replace(encoder_zero_counts=1000.0))

    def estimates(self, count: int) -> list[tuple[Reference, Estimate]]:
        """The inputs of the law."""
        state, seen = self.start(), []
        for raw, reference, timing in self.ticks(count):
            state, _ = step(self.setup, state, raw, reference, timing)
            seen.append((reference, state.estimate))
        return seen


def run_law(loop: ClosedLoop, seen: Sequence[tuple[Reference, Estimate]]) -> Memory:
    gains, armed = loop.setup.gains, loop.setup.armed
    state = armed
    for reference, estimate in seen:
        _, state = respond(gains, armed, state, reference, estimate, TICK_S)
    return state


def run_nothing(seen: Sequence[tuple[Reference, Estimate]]) -> None:
    """Run the same loop without the call."""
    gains, state = None, None
    for _reference, _estimate in seen:
        _, state = gains, state


def tick_times_us(
    loop: ClosedLoop, ticks: Sequence[tuple[RawSample, Reference, Timing]]
) -> list[float]:
    """Time of each tick, without the two readings of the clock."""
    setup, state, now_ns = loop.setup, loop.start(), time.perf_counter_ns
    taken_ns = []
    for raw, reference, timing in ticks:
        begin_ns = now_ns()
        state, _ = step(setup, state, raw, reference, timing)
        taken_ns.append(now_ns() - begin_ns)
    clock_ns = median([-now_ns() + now_ns() for _ in range(1000)])
    return [(ns - clock_ns) / 1e3 for ns in taken_ns]


# Measuring.


def seconds(work: Callable[[], object]) -> float:
    begin_s = time.process_time()
    work()
    return time.process_time() - begin_s


def time_interleaved(
    variants: dict[str, Callable[[], object]], rounds: int
) -> dict[str, list[float]]:
    """CPU seconds of each variant; every round runs each once, in a rotated order."""
    taken: dict[str, list[float]] = {name: [] for name in variants}
    for work in variants.values():
        work()  # warm: code compiled, files read, caches filled
    for number in range(rounds):
        tell(f"round {number + 1} of {rounds}")
        first = number % len(variants)
        for name in (*list(variants)[first:], *list(variants)[:first]):
            taken[name].append(seconds(variants[name]))
    return taken


def measure(rounds: int) -> dict[str, Any]:
    loops = {law: ClosedLoop(law) for law in LAWS}
    seen = {law: loop.estimates(LAW_TICKS) for law, loop in loops.items()}
    ticks = {law: loop.ticks(LAW_TICKS) for law, loop in loops.items()}
    tick_us: dict[str, list[float]] = {law: [] for law in LAWS}
    converged_m = run_plant_compiled(np.array(SQUARE_V), 512)
    square_v = np.array(SQUARE_V * 5)

    def measure_ticks(law: str) -> None:
        tick_us[law] += tick_times_us(loops[law], ticks[law])

    variants: dict[str, Callable[[], object]] = {}
    for n in STEPS:
        variants[f"compiled {n}"] = partial(run_plant_compiled, square_v, n)
        variants[f"plain {n}"] = partial(run_plant_plain, SQUARE_V, n)
    for name, how in LSODA.items():
        variants[name] = partial(run_lsoda, how, SQUARE_V[:LSODA_TICKS])
    variants["nothing"] = partial(run_nothing, seen["pid"])
    for law, loop in loops.items():
        variants[f"loop {law}"] = loop.simulate
        variants[f"law {law}"] = partial(run_law, loop, seen[law])
        variants[f"tick {law}"] = partial(measure_ticks, law)

    gc.collect()
    gc.freeze()
    gc.disable()  # as in the loop process
    taken = time_interleaved(variants, rounds)
    gc.enable()

    errors = plant_errors_um()
    lsoda_errors = {
        name: largest_um(run_lsoda(how, SQUARE_V[:LSODA_TICKS]), converged_m)
        for name, how in LSODA.items()
    }
    seconds_of = {law: loop.seconds for law, loop in loops.items()}
    tick = {
        law: {"p50_us": quantile(values, 0.5), "p99_us": quantile(values, 0.99)}
        for law, values in tick_us.items()
    }
    picks = {"median": median, "best": min}
    return {
        name: {
            **summary({variant: pick(values) for variant, values in taken.items()}, seconds_of),
            "tick": tick,
        }
        for name, pick in picks.items()
    } | {"largest_error_um": {"plant": errors, "lsoda": lsoda_errors}}


def summary(taken_s: dict[str, float], loop_s: dict[str, float]) -> dict[str, Any]:
    """Costs and ratios of one round, or of the medians over all."""
    square_ticks, law_ticks = 5 * len(SQUARE_V), LAW_TICKS
    per_tick_us = {
        "compiled": {n: taken_s[f"compiled {n}"] / square_ticks * 1e6 for n in STEPS},
        "plain": {n: taken_s[f"plain {n}"] / len(SQUARE_V) * 1e6 for n in STEPS},
    }
    plant = {
        form: {
            str(n): {
                "us_per_tick": us,
                "times_real_time": 1e3 / us,
            }
            for n, us in by_steps.items()
        }
        for form, by_steps in per_tick_us.items()
    }
    lsoda = {
        name: {
            "us_per_tick": (us := taken_s[name] / LSODA_TICKS * 1e6),
            "rtol": how.rtol,
            "friction_smoothed_over_m_per_s": how.slip_m_per_s,
            "slower_than_compiled_at_2_steps": us / per_tick_us["compiled"][2],
            "slower_than_plain_at_2_steps": us / per_tick_us["plain"][2],
        }
        for name, how in LSODA.items()
    }
    closed_loop = {
        law: {
            "us_per_tick": (us := taken_s[f"loop {law}"] / loop_s[law] * 1e3),
            "times_real_time": 1e3 / us,
        }
        for law in LAWS
    }
    law_us = {law: (taken_s[f"law {law}"] - taken_s["nothing"]) / law_ticks * 1e6 for law in LAWS}
    laws = {law: {"us": us, "times_pid": us / law_us["pid"]} for law, us in law_us.items()}
    return {"plant": plant, "closed_loop": closed_loop, "lsoda_per_tick": lsoda, "law": laws}


def quantile(values: Sequence[float], share: float) -> float:
    return sorted(values)[int(share * (len(values) - 1))]


# Output.


class Target(NamedTuple):
    """A target."""

    what: str
    median: float
    best: float
    at_least: bool
    target: float


def targets(found: dict[str, Any]) -> list[Target]:
    """Speeds at two steps a tick, as the simulated rig takes them; the worst law and command."""
    error_um = max(by_steps[2] for by_steps in found["largest_error_um"]["plant"].values())

    def both(value: Callable[[dict[str, Any]], float]) -> tuple[float, float]:
        return value(found["median"]), value(found["best"])

    def lsoda(pick: Callable[[list[float]], float]) -> Callable[[dict[str, Any]], float]:
        slower = "slower_than_compiled_at_2_steps"
        return lambda one: pick([how[slower] for how in one["lsoda_per_tick"].values()])

    plain = both(lambda one: one["plant"]["plain"]["2"]["times_real_time"])
    quick = both(lambda one: one["plant"]["compiled"]["2"]["times_real_time"])
    loops = both(lambda one: min(o["times_real_time"] for o in one["closed_loop"].values()))
    qsmc = both(lambda one: one["law"]["qsmc"]["times_pid"])
    tick = both(lambda one: one["tick"]["qsmc"]["p50_us"])
    return [
        Target("error at 2 steps a tick, um", error_um, error_um, False, 1.0),
        Target("plant compiled, x real time", *quick, True, 1000),
        Target("plant plain, x real time", *plain, True, 100),
        Target("closed loop compiled, x real time", *loops, True, 500),
        Target(
            "faster than solve_ivp's LSODA per tick", *both(lsoda(lambda all_: all_[0])), True, 300
        ),
        Target("faster than the quickest LSODA per tick", *both(lsoda(min)), True, 300),
        Target("qSMC's cost, x PID", *qsmc, False, 1.5),
        Target("tick with qSMC, p50 of all rounds, us", *tick, False, 6.0),
    ]


def is_met(row: Target) -> bool:
    return row.median >= row.target if row.at_least else row.median <= row.target


def tell(text: str = "") -> None:
    """Print progress and tables to stderr: stdout is the result."""
    print(text, file=sys.stderr, flush=True)


def tell_all(found: dict[str, Any]) -> None:
    """Print tables: the median round, and the best in brackets."""
    middle, best, errors = found["median"], found["best"], found["largest_error_um"]
    names = list(COMMANDS_V)
    tell(f"\nplant: us/tick (best), x real time (best), largest error in um: {'; '.join(names)}")
    for form, by_steps in middle["plant"].items():
        for n, one in by_steps.items():
            top = best["plant"][form][n]
            off = "  ".join(f"{errors['plant'][name][int(n)]:.3f}" for name in names)
            tell(
                f"  {form + ', ' + n + ' steps a tick':27}"
                f"{one['us_per_tick']:8.3f} ({top['us_per_tick']:.3f})"
                f"{one['times_real_time']:9.0f} ({top['times_real_time']:.0f})   {off}"
            )
    tell(
        "\nLSODA restarted every tick: us (best), slower than compiled at 2 steps (best), error um"
    )
    for name, one in middle["lsoda_per_tick"].items():
        top, slower = best["lsoda_per_tick"][name], "slower_than_compiled_at_2_steps"
        tell(
            f"  {name:33}{one['us_per_tick']:7.1f} ({top['us_per_tick']:.1f})"
            f"{one[slower]:9.0f} ({top[slower]:.0f}){errors['lsoda'][name]:10.3f}"
        )
    tell("\nclosed loop: us/tick, x real time (best); law: us, x PID (best); tick: p50, p99 us")
    for law in LAWS:
        loop, cost, tick = (middle[part][law] for part in ("closed_loop", "law", "tick"))
        tell(
            f"  {law:5}{loop['us_per_tick']:8.3f}{loop['times_real_time']:8.0f}"
            f" ({best['closed_loop'][law]['times_real_time']:.0f}){cost['us']:10.2f}"
            f"{cost['times_pid']:7.2f} ({best['law'][law]['times_pid']:.2f})"
            f"{tick['p50_us']:10.2f}{tick['p99_us']:7.2f}"
        )
    tell()
    for row in found["targets"]:
        bound = "at least" if row["at_least"] else "at most"
        verdict = "met" if row["met"] else "NOT MET"
        tell(
            f"  {row['what']}: {row['median']:.2f} (best round {row['best']:.2f}), "
            f"{bound} {row['target']:g}: {verdict}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=15)
    options = parser.parse_args()
    machine = {"cpus": os.cpu_count(), "python": platform.python_version()}
    found = {"machine": machine, "rounds": options.rounds, **measure(options.rounds)}
    found["targets"] = [{**row._asdict(), "met": is_met(row)} for row in targets(found)]
    tell_all(found)
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
