"""The valve chokes at a lower pressure ratio than an ideal nozzle (ISO 6358: b = 0.2 to 0.5)."""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.description import EffectDescription, size


class DischargeRatio(NamedTuple):
    """Critical ratio minus that of an isentropic nozzle (0.528 for air)."""

    shift: float = 0.0


def nozzle_ratio(discharge: DischargeRatio, ratio: float, critical_ratio: float) -> float:
    """Return the pressure ratio at which an ideal nozzle would pass the same share of the flow.

    It stretches the unchoked branch, so that choking begins at `critical_ratio + shift` and the
    flow is still 0 at equal pressures. The result is within 0.3 % of ISO 6358's ellipse.
    """
    if discharge.shift == 0.0:
        return ratio
    span = (1.0 - critical_ratio) / (1.0 - critical_ratio - discharge.shift)
    return 1.0 - (1.0 - ratio) * span


DESCRIPTION = EffectDescription(
    name="discharge_ratio",
    kind=DischargeRatio,
    block="pressure",
    equation="Psi(r') with 1 - r' = (1 - r) (1 - C_r) / (1 - b),  b = C_r + shift",
    parameters=(
        size(
            "shift",
            "1",
            0.15,
            smallest=0.025,
            start=-0.1,
            meaning="b - C_r, C_r = 0.528",
            low=-0.4,
        ),
    ),
    signature="the flow is wrong while it is not choked: near the end of filling and of venting",
    best_experiment="square-1",
    seen_by=("pressure",),
    woven=("air",),
)
