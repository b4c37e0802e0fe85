"""The valve's spool follows its command as a second-order system, not at once."""

from __future__ import annotations

import math
from typing import NamedTuple

from pamctl.plant.effects.description import AsTerm, EffectDescription, EffectParameter


class ValveSpool(NamedTuple):
    """Lag of the spool. The paper's 109 Hz valve has a time constant of 1.46 ms."""

    time_constant_s: float = 0.0
    """1 / (2 pi natural frequency in Hz); 0 is a spool without mass."""
    damping_ratio: float = 0.7


def spool_step(
    spool: ValveSpool, spool_v: float, rate_v_per_s: float, command_v: float, step_s: float
) -> tuple[float, float]:
    """Advance s'' = w^2 (u - s) - 2 zeta w s' exactly over a step of constant command.

    Returns the spool's position, in volts of the command that would hold it there,
    and its rate in V/s.
    """
    if spool.time_constant_s <= 0.0:
        return command_v, 0.0
    natural = 1.0 / spool.time_constant_s
    decay_rate = spool.damping_ratio * natural
    offset = spool_v - command_v
    curvature = natural * natural - decay_rate * decay_rate
    # `level` and `swing`: what a unit of offset and of push leave at the end of the step.
    if curvature > 0.0:
        decay = math.exp(-decay_rate * step_s)
        ringing = math.sqrt(curvature)
        swing = decay * math.sin(ringing * step_s) / ringing
        level = decay * math.cos(ringing * step_s)
    elif curvature < 0.0:
        # Written with the slower pole: cosh and sinh overflow in a long step.
        spread = math.sqrt(-curvature)
        decay = math.exp((spread - decay_rate) * step_s)
        swing = -decay * math.expm1(-2.0 * spread * step_s) / (2.0 * spread)
        level = decay * (0.5 + 0.5 * math.exp(-2.0 * spread * step_s))
    else:
        decay = math.exp(-decay_rate * step_s)
        swing = decay * step_s
        level = decay
    push = rate_v_per_s + decay_rate * offset
    pull = natural * natural * offset + decay_rate * rate_v_per_s
    return command_v + offset * level + push * swing, rate_v_per_s * level - pull * swing


DESCRIPTION = EffectDescription(
    name="valve_spool",
    kind=ValveSpool,
    block="pressure",
    equation="s'' = w^2 (u - s) - 2 zeta w s',  A_v = K_Av s",
    parameters=(
        EffectParameter(
            "time_constant_s",
            "s",
            neutral=0.0,
            low=0.0,
            high=8e-3,
            smallest_of_interest=2e-4,
            meaning="1 / natural angular frequency",
            start=1e-3,
        ),
        EffectParameter(
            "damping_ratio",
            "1",
            neutral=0.7,
            low=0.2,
            high=2.0,
            smallest_of_interest=0.1,
            meaning="damping of the spool",
            start=0.7,
            role="shape",
        ),
    ),
    signature="an error in the first milliseconds after every step of the command; it grows with "
    "frequency",
    best_experiment="chirp",
    seen_by=("pressure",),
    woven=("valve",),
    as_terms=(AsTerm("command", "lag", "command"),),
)
