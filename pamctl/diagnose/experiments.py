"""Which experiment tells two effects apart; measured on the paper's model, 6 s each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from pamctl.plant.catalogue import CATALOGUE

SEPARATING_EXPERIMENTS: Mapping[frozenset[str], tuple[str, str]] = {
    frozenset({"valve_spool", "command_delay"}): (
        "chirp",
        "a lag of second order and a pure delay part at high frequency only",
    ),
    frozenset({"pressure_sensor_lag", "valve_spool"}): (
        "fill-and-hold",
        "after the valve closes the spool is silent and the sensor still catches up",
    ),
    frozenset({"pressure_sensor_lag", "command_delay"}): (
        "fill-and-hold",
        "after the valve closes the delay is over and the sensor still catches up",
    ),
    frozenset({"valve_leak", "chamber_leak"}): (
        "fill-and-hold",
        "with the valve closed one drifts towards the middle, the other to the atmosphere",
    ),
    frozenset({"dead_volume", "pressure_sensor_lag"}): (
        "fill-and-hold",
        "a volume matters while air flows, a lag also afterwards",
    ),
    frozenset({"return_friction", "stribeck"}): (
        "slow ramps up and down at several pressures",
        "one scales with the pressure on the way back only, the other with slowness both ways",
    ),
    frozenset({"valve_deadband", "valve_asymmetry"}): (
        "null staircase",
        "a dead band acts near null only",
    ),
    frozenset({"supply_droop", "valve_asymmetry"}): (
        "full-scale squares",
        "a droop grows with the flow, an asymmetry does not",
    ),
}


def find_separating_experiment(names: Iterable[str]) -> dict[str, object]:
    """Return the experiment that tells these effects apart, and why."""
    wanted = sorted(names)
    for pair, (experiment, why) in SEPARATING_EXPERIMENTS.items():
        if pair <= {*wanted}:
            return {"name": experiment, "separates": sorted(pair), "why": why}
    first = CATALOGUE[wanted[0]]
    return {
        "name": first.best_experiment,
        "separates": wanted,
        "why": f"it shows {first.name} best: {first.signature}",
    }


def find_showing_experiment(name: str) -> dict[str, object]:
    """Return the experiment that shows an effect best."""
    effect = CATALOGUE[name]
    why = f"these records cannot show {name}: {effect.signature}"
    return {"name": effect.best_experiment, "separates": [name], "why": why}
