"""Effects between the command and the valve's opening."""

from __future__ import annotations

import math
from math import copysign, pow
from typing import Any, NamedTuple

from pamctl.plant.effects.description import (
    AsTerm,
    Distinction,
    EffectDescription,
    EffectEntry,
    EffectForm,
    EffectMemory,
    shape,
    size,
)
from pamctl.plant.effects.places import follow_with_play


class CommandDelay(NamedTuple):
    """The command reaches the valve late: converters, driver, bus.

    The delay shifts the commands in time before they reach the valve; a step of the plant does not
    contain it. It is exact: a step is cut where a command arrives, so a fit can resolve a fraction
    of a tick.
    """

    delay_s: float = 0.0


COMMAND_DELAY = EffectDescription(
    kind=CommandDelay, block="pressure",
    equation="u(t - tau)",
    parameters=(
        size("delay_s", "s", 20e-3, smallest=2e-4, start=1e-3,
             meaning="tau, any fraction of a tick"),
    ),
    signature="an error in the first milliseconds after every change of the command; a phase lag "
    "in proportion to frequency",
    best_experiment="chirp", woven=("timing",),
    told_from={
        "valve_spool": Distinction("chirp",
                                   "a lag of second order and a pure delay differ at high "
                                     "frequency only"),
    },
    as_terms=(AsTerm("command", "lag", "command"),),
)  # fmt: skip


class NullOffset(NamedTuple):
    """The valve does not close at zero command: its spool, or its driver, has an offset."""

    offset_v: float = 0.0


def add_offset_v(null: NullOffset, command_v: float) -> float:
    """Return the command that the spool gets."""
    return command_v + null.offset_v


def remove_offset_v(null: NullOffset, passed_v: float) -> float:
    """Return the command at which the spool gets `passed_v`."""
    return passed_v - null.offset_v


NULL_OFFSET = EffectDescription(
    kind=NullOffset, block="pressure",
    equation="A_v = K_Av (u + u_0)",
    parameters=(
        size("offset_v", "V", 1.0, smallest=0.02, start=0.1,
             meaning="u_0; above 0 the valve fills at zero command", low=-1.0),
    ),
    signature="at zero command the measured pressure moves one way; commands near null fill too "
    "much and exhaust too little, or the other way round",
    best_experiment="null-staircase",
    entries=(EffectEntry("command", add_offset_v, undo=remove_offset_v),),
    as_terms=(AsTerm("command", "constant"),),
)  # fmt: skip


class ValveAsymmetry(NamedTuple):
    """The exhaust port is wider or narrower than the filling one."""

    exhaust_gain: float = 1.0


def apply_asymmetry_v(asymmetry: ValveAsymmetry, opening_v: float) -> float:
    """Return the opening that a symmetric valve would need for the same area."""
    return opening_v if opening_v > 0.0 else asymmetry.exhaust_gain * opening_v


def undo_asymmetry_v(asymmetry: ValveAsymmetry, passed_v: float) -> float:
    """Return the opening of the wider or narrower port that has this area."""
    return passed_v if passed_v > 0.0 else passed_v / asymmetry.exhaust_gain


VALVE_ASYMMETRY = EffectDescription(
    kind=ValveAsymmetry, block="pressure",
    equation="A_v = a K_Av u for u < 0",
    parameters=(
        size("exhaust_gain", "1", 2.0, smallest=0.03, start=0.9,
             meaning="ratio of the gain for u < 0 to that for u > 0", neutral=1.0, low=0.4),
    ),
    signature="filling is right; the flow of exhausting is wrong by a constant factor",
    best_experiment="null-staircase",
    entries=(
        EffectEntry("opening", apply_asymmetry_v, after=("valve_curve",), undo=undo_asymmetry_v),
    ),
    told_from={
        "valve_deadband": Distinction("null-staircase", "a dead band acts near null only"),
        "supply_droop": Distinction("square-1",
                                    "a droop grows with the flow, an asymmetry does not"),
    },
    as_terms=(AsTerm("filling", "constant"), AsTerm("exhausting", "constant")),
)  # fmt: skip


class ValveCurve(NamedTuple):
    """The port's area is not proportional to the spool's travel.

    A quadratic part of the area, or a power law, which equals the linear area at 5 V.
    """

    curvature_per_v: float = 0.0
    exponent: float = 1.0


def apply_curve_v(curve: ValveCurve, opening_v: float) -> float:
    """Return the opening that a linear valve would need for the same area."""
    travel = abs(opening_v)
    bent_v = opening_v * (1.0 + curve.curvature_per_v * travel)
    if curve.exponent != 1.0 and travel > 0.0:
        bent_v *= pow(travel / FULL_COMMAND_V, curve.exponent - 1.0)
    return bent_v


def undo_curve_v(curve: ValveCurve, passed_v: float) -> float:
    """Return the travel at which the port has this area, by bisection.

    The area of a curve that bends down has a largest value: beyond it the travel stays there.
    """
    if passed_v == 0.0:
        return 0.0
    low_v, high_v = 0.0, 2.0 * FULL_COMMAND_V
    bend, power = curve.curvature_per_v, curve.exponent
    if bend < 0.0:
        high_v = min(high_v, -power / ((power + 1.0) * bend))
    for _ in range(60):
        middle_v = 0.5 * (low_v + high_v)
        if apply_curve_v(curve, middle_v) < abs(passed_v):
            low_v = middle_v
        else:
            high_v = middle_v
    return copysign(high_v, passed_v)


VALVE_CURVE = EffectDescription(
    kind=ValveCurve, block="pressure",
    equation="A_v = K_Av u (1 + k_2 |u|) (|u| / 5 V)^(n - 1)",
    parameters=(
        size("curvature_per_v", "1/V", 0.2, smallest=0.006, start=0.02, meaning="k_2", low=-0.15),
        size("exponent", "1", 2.0, smallest=0.03, start=1.1, meaning="n", neutral=1.0, low=0.5),
    ),
    signature="the flow's error depends on the size of the command and not on its sign",
    best_experiment="null-staircase",
    entries=(EffectEntry("opening", apply_curve_v, after=("valve_deadband",), undo=undo_curve_v),),
    forms=(
        EffectForm("quadratic", free=("curvature_per_v",)),
        EffectForm("power", free=("exponent",)),
    ),
    as_terms=(AsTerm("command", "curve", "command"), AsTerm("opening", "curve", "command")),
)  # fmt: skip


class ValveDeadband(NamedTuple):
    """The spool's lands overlap the ports: near null the valve does not open."""

    fill_width_v: float = 0.0
    exhaust_width_v: float = 0.0


def apply_deadband_v(deadband: ValveDeadband, opening_v: float) -> float:
    """Return the spool's travel minus the overlap."""
    if opening_v > 0.0:
        return max(opening_v - deadband.fill_width_v, 0.0)
    return min(opening_v + deadband.exhaust_width_v, 0.0)


def undo_deadband_v(deadband: ValveDeadband, passed_v: float) -> float:
    """Return the travel that leaves this opening beyond the overlap; 0 for a closed valve."""
    if passed_v > 0.0:
        return passed_v + deadband.fill_width_v
    return passed_v - deadband.exhaust_width_v if passed_v < 0.0 else 0.0


VALVE_DEADBAND = EffectDescription(
    kind=ValveDeadband, block="pressure",
    equation="A_v = K_Av (u - d_f) for u > d_f, K_Av (u + d_e) for u < -d_e, else 0",
    parameters=(
        size("fill_width_v", "V", 1.5, smallest=0.02, start=0.1, meaning="dead band where u > 0"),
        size("exhaust_width_v", "V", 1.5, smallest=0.02, start=0.1,
             meaning="dead band where u < 0"),
    ),
    signature="with commands within some three widths of null the simulated pressure drifts and "
    "the measured one stays; full-scale squares show only a loss of gain",
    best_experiment="null-staircase",
    entries=(EffectEntry("opening", apply_deadband_v, undo=undo_deadband_v),),
    forms=(
        EffectForm("two sides", free=("fill_width_v", "exhaust_width_v")),
        EffectForm("filling only", free=("fill_width_v",)),
        EffectForm("exhausting only", free=("exhaust_width_v",)),
    ),
    as_terms=(AsTerm("command", "dead_zone", "command"), AsTerm("command", "curve", "command")),
)  # fmt: skip


class ValveHysteresis(NamedTuple):
    """Play or stiction of the spool: it follows its command with a slack."""

    width_v: float = 0.0


class SpoolMemory(NamedTuple):
    """Where the spool is, as far as an effect has let it go."""

    spool_v: float


def start_at_null(position_m: float, pressure_pa: float) -> SpoolMemory:
    """Return a spool at null."""
    return SpoolMemory(0.0)


def give_spool_v(effect: Any, memory: SpoolMemory) -> float:
    """Return the spool's position (V)."""
    return memory.spool_v


def follow_hysteresis_v(
    hysteresis: ValveHysteresis, memory: SpoolMemory, end: float
) -> SpoolMemory:
    """Follow the command with a total slack of `width_v`."""
    return SpoolMemory(follow_with_play(memory.spool_v, end, hysteresis.width_v))


VALVE_HYSTERESIS = EffectDescription(
    kind=ValveHysteresis, block="pressure",
    equation="play operator: u - w/2 <= s <= u + w/2, s moves only when pushed",
    parameters=(
        size("width_v", "V", 0.5, smallest=0.02, start=0.1, meaning="w, width of the slack"),
    ),
    signature="the opening depends on the previous commands; visible with small commands only",
    best_experiment="null-staircase",
    entries=(
        EffectEntry("command", give_spool_v,
                    memory=EffectMemory(start_at_null, follow_hysteresis_v),
                    after=("valve_saturation",)),
    ),
    as_terms=(AsTerm("command", "play", "command"),),
)  # fmt: skip


class ValveLeak(NamedTuple):
    """Air leaks past the spool's lands: from the tank to the muscle, and from there to the room.

    Two equal leaks at null; they shrink as the spool moves.
    """

    area_m2: float = 0.0
    fade_per_v: float = 0.0


def leak_area_m2(leak: ValveLeak, spool_v: float) -> float:
    """Return the area of each of the two leaks."""
    return leak.area_m2 / (1.0 + leak.fade_per_v * abs(spool_v))


VALVE_LEAK = EffectDescription(
    kind=ValveLeak, block="pressure",
    equation="m += A (Psi(P_tank, P) - Psi(P, P_atm)),  A = A_l / (1 + k |u|)",
    parameters=(
        size("area_m2", "m2", 3e-6, smallest=1e-9, start=1e-8, meaning="A_l, area of each leak"),
        shape("fade_per_v", "1/V", 0.0, 5.0, usual=0.0, smallest=0.2,
              meaning="k, fading of the leak as the spool leaves null"),
    ),
    signature="with the valve closed the pressure drifts to a value between tank and atmosphere; "
    "filling and exhausting do not reach their end pressures",
    best_experiment="fill-and-hold", woven=("air",),
    forms=(
        EffectForm("everywhere", free=("area_m2",)),
        EffectForm("at null", free=("area_m2", "fade_per_v"), held={"fade_per_v": 0.5}),
    ),
    as_terms=(AsTerm("flow", "curve", "pressure"), AsTerm("leak", "curve", "command")),
)  # fmt: skip


FULL_COMMAND_V = 5.0


class ValveSaturation(NamedTuple):
    """The spool reaches its stop, or the driver its limit, before the command does."""

    shortfall_v: float = 0.0


def saturate_command_v(saturation: ValveSaturation, command_v: float) -> float:
    """Return the command that the driver passes on; it is its own inverse within the limit."""
    if saturation.shortfall_v <= 0.0:
        return command_v
    limit_v = FULL_COMMAND_V - saturation.shortfall_v
    return min(max(command_v, -limit_v), limit_v)


VALVE_SATURATION = EffectDescription(
    kind=ValveSaturation, block="pressure",
    equation="u limited to +-(5 V - d)",
    parameters=(
        size("shortfall_v", "V", 4.0, smallest=0.2, start=0.5,
             meaning="by how much the limit is below the full command of 5 V"),
    ),
    signature="at large commands only, in both directions, the measured flow is smaller",
    best_experiment="null-staircase",
    entries=(
        EffectEntry("command", saturate_command_v, after=("null_offset",), undo=saturate_command_v),
    ),
    as_terms=(AsTerm("command", "saturation", "command"),),
)  # fmt: skip


class ValveSlew(NamedTuple):
    """The spool moves at a limited rate: its driver's current or its spring is at the limit."""

    slowness_s_per_v: float = 0.0


def follow_slew_v(slew: ValveSlew, memory: SpoolMemory, end: float, step_s: float) -> SpoolMemory:
    """Move towards the command by at most `step_s` over the slowness."""
    way_v = step_s / slew.slowness_s_per_v
    return SpoolMemory(memory.spool_v + min(max(end - memory.spool_v, -way_v), way_v))


VALVE_SLEW = EffectDescription(
    kind=ValveSlew, block="pressure",
    equation="|s'| <= 1 / r, s goes to u",
    parameters=(
        size("slowness_s_per_v", "s/V", 20e-3, smallest=1e-4, start=5e-4,
             meaning="r, time that the spool takes for a volt"),
    ),
    signature="an error in the first milliseconds after a step of the command; it grows with the "
    "height of the step, and small commands do not show it",
    best_experiment="chirp",
    entries=(
        EffectEntry("command", give_spool_v, memory=EffectMemory(start_at_null, follow_slew_v),
                    after=("valve_saturation", "valve_hysteresis")),
    ),
    as_terms=(AsTerm("command", "slew", "command"),),
)  # fmt: skip


class ValveSpool(NamedTuple):
    """The valve's spool follows its command as a system of first or second order, not at once.

    Lag of the spool. The paper's 109 Hz valve has a time constant of 1.46 ms.
    """

    time_constant_s: float = 0.0
    """1 / (2 pi natural frequency in Hz); of first order until 63 % is reached. 0 is no lag."""
    damping_ratio: float = 0.7
    """Of second order."""
    order: float = 2.0
    """2, or 1 for a spool without mass, as behind a pilot stage."""


def spool_step(
    spool: ValveSpool, spool_v: float, rate_v_per_s: float, command_v: float, step_s: float
) -> tuple[float, float]:
    """Advance s'' = w^2 (u - s) - 2 zeta w s', or s' = w (u - s), over a step of constant command.

    Returns the spool's position, in volts of the command that would hold it there,
    and its rate in V/s.
    """
    if spool.time_constant_s <= 0.0:
        return command_v, 0.0
    natural = 1.0 / spool.time_constant_s
    offset = spool_v - command_v
    if spool.order < 2.0:
        left = offset * math.exp(-natural * step_s)
        return command_v + left, -natural * left
    decay_rate = spool.damping_ratio * natural
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


VALVE_SPOOL = EffectDescription(
    kind=ValveSpool, block="pressure",
    equation="s'' = w^2 (u - s) - 2 zeta w s', or s' = w (u - s);  A_v = K_Av s",
    parameters=(
        size("time_constant_s", "s", 0.1, smallest=2e-4, start=1e-3,
             meaning="1 / natural angular frequency; of first order, the time to 63 %"),
        shape("damping_ratio", "1", 0.2, 2.0, usual=0.7, smallest=0.1,
              meaning="damping of the spool of second order"),
        shape("order", "1", 1.0, 2.0, usual=2.0, smallest=1.0,
              meaning="2, or 1 for a spool without mass"),
    ),
    forms=(
        EffectForm("second order", ("time_constant_s", "damping_ratio"), {"order": 2.0}),
        EffectForm("first order", ("time_constant_s",), {"order": 1.0}),
    ),
    signature="an error in the first milliseconds after every step of the command; it grows with "
    "frequency",
    best_experiment="chirp", woven=("valve",),
    as_terms=(AsTerm("command", "lag", "command"),),
)  # fmt: skip
