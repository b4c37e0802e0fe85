"""Effects on forces and motion."""

from __future__ import annotations

from math import exp
from typing import TYPE_CHECKING, NamedTuple

from pamctl.plant.effects.description import (
    AsTerm,
    EffectDescription,
    EffectEntry,
    EffectForm,
    EffectMemory,
    shape,
    size,
)
from pamctl.plant.effects.places import lag_weights

if TYPE_CHECKING:
    from pamctl.plant.paper import PaperParameters


class BladderThreshold(NamedTuple):
    """The bladder must stretch before it loads the braid."""

    pressure_pa: float = 0.0


def reduce_pulling_pa(bladder: BladderThreshold, pulling_pa: float) -> float:
    """Return the gauge pressure that pulls."""
    if bladder.pressure_pa == 0.0:
        return pulling_pa
    return max(pulling_pa - bladder.pressure_pa, 0.0)


BLADDER_THRESHOLD = EffectDescription(
    kind=BladderThreshold, block="mechanics",
    equation="F = max(P_g - P_th, 0) A(x)",
    parameters=(size("pressure_pa", "Pa", 6e4, smallest=1e3, start=5e3, meaning="P_th"),),
    signature="the stroke begins late at the vented end; above, a constant loss of pressure",
    best_experiment="square-1",
    entries=(EffectEntry("pulling_pressure", reduce_pulling_pa),),
    actuators=("muscle",),
    as_terms=(AsTerm("pressing", "constant"), AsTerm("pressing", "curve", "pressure")),
)  # fmt: skip


class BraidStretch(NamedTuple):
    """The braid's threads are elastic: pressure makes them longer."""

    compliance_per_pa: float = 0.0


def stretch_ratio(braid: BraidStretch, gauge_pa: float) -> float:
    """Return the ratio of the threads' length to their length without pressure."""
    return 1.0 + braid.compliance_per_pa * gauge_pa


BRAID_STRETCH = EffectDescription(
    kind=BraidStretch, block="mechanics",
    equation="b = b_0 (1 + e P_g) in V(x) and A(x)",
    parameters=(
        size("compliance_per_pa", "1/Pa", 2e-7, smallest=1e-8, start=3e-8,
             meaning="e, strain per gauge pressure"),
    ),
    signature="a static error in the square of the pressure; similar to a change of k and b",
    best_experiment="fill-and-hold", seen_by=("mechanics", "pressure"), woven=("air", "mechanics"),
    actuators=("muscle",),
    as_terms=(AsTerm("pull", "gain", "pressure"),),
)  # fmt: skip


FAST = 0.1
"""Time constant of the fast branch over that of the slow one: the two look like a logarithm."""


class Creep(NamedTuple):
    """The bladder creeps: after a step the muscle keeps moving for seconds.

    A spring and a dashpot parallel to the muscle, or two such branches.
    """

    stiffness_n_per_m: float = 0.0
    time_constant_s: float = 1.0
    fast_share: float = 0.0
    """Share of the stiffness in a second branch, which is ten times as fast."""


class DashpotPositions(NamedTuple):
    """Positions of the dashpots."""

    slow_m: float
    fast_m: float


def start_dashpots(position_m: float, pressure_pa: float) -> DashpotPositions:
    """Return relaxed dashpots."""
    return DashpotPositions(position_m, position_m)


def advance_dashpots(
    creep: Creep, memory: DashpotPositions, begin_m: float, end_m: float, step_s: float
) -> DashpotPositions:
    """Advance the dashpots over a motion of constant speed, exactly."""
    kept, weight = lag_weights(creep.time_constant_s, step_s)
    slow_m = kept * memory.slow_m + (1.0 - kept) * begin_m + weight * (end_m - begin_m)
    if creep.fast_share == 0.0:
        return DashpotPositions(slow_m, slow_m)
    kept, weight = lag_weights(FAST * creep.time_constant_s, step_s)
    fast_m = kept * memory.fast_m + (1.0 - kept) * begin_m + weight * (end_m - begin_m)
    return DashpotPositions(slow_m, fast_m)


def creep_force_n(creep: Creep, memory: DashpotPositions, position_m: float) -> float:
    """Return the pull of the branches."""
    slow_n = creep.stiffness_n_per_m * (1.0 - creep.fast_share) * (position_m - memory.slow_m)
    fast_n = creep.stiffness_n_per_m * creep.fast_share * (position_m - memory.fast_m)
    return -(slow_n + fast_n)


CREEP = EffectDescription(
    kind=Creep, block="mechanics",
    equation="-k x - k_c (x - z),  tau z' = x - z; two branches: a share of k_c with tau / 10",
    parameters=(
        size("stiffness_n_per_m", "N/m", 6000.0, smallest=50.0, start=300.0,
             meaning="k_c, stiffness that relaxes"),
        shape("time_constant_s", "s", 0.05, 30.0, usual=1.0, smallest=0.1,
              meaning="tau of the dashpot"),
        shape("fast_share", "1", 0.0, 1.0, usual=0.0, smallest=0.1,
              meaning="share of k_c with a tenth of tau"),
    ),
    signature="slow drift at rest after every step, in the direction of the step",
    best_experiment="long-holds",
    entries=(
        EffectEntry("force", creep_force_n, memory=EffectMemory(start_dashpots, advance_dashpots)),
    ),
    forms=(
        EffectForm("one branch", ("stiffness_n_per_m", "time_constant_s")),
        EffectForm("two branches", ("stiffness_n_per_m", "time_constant_s", "fast_share"),
                   {"fast_share": 0.4}),
    ),
    as_terms=(AsTerm("force", "lag", "position"),),
)  # fmt: skip


class CubicStiffness(NamedTuple):
    """The return spring, or the bladder, hardens or softens with stroke."""

    n_per_m3: float = 0.0


def cubic_force_n(cubic: CubicStiffness, position_m: float) -> float:
    """Return the pull; it opposes the displacement."""
    return -(cubic.n_per_m3 * position_m * position_m * position_m)


CUBIC_STIFFNESS = EffectDescription(
    kind=CubicStiffness, block="mechanics",
    equation="-k x - k_3 x^3",
    parameters=(size("n_per_m3", "N/m3", 1e7, smallest=2e5, start=1e6, meaning="k_3", low=-1e7),),
    signature="a static error, a function of the displacement only",
    best_experiment="fill-and-hold",
    entries=(EffectEntry("force", cubic_force_n),),
    as_terms=(AsTerm("force", "curve", "position"), AsTerm("force", "beyond", "position")),
)  # fmt: skip


LEAST_FACTOR = 0.1
"""A drifting number keeps at least this share of its first value."""


class Drift(NamedTuple):
    """What changes over minutes: temperature, wear, a supply that runs down."""

    valve_gain_per_s: float = 0.0
    stiffness_per_s: float = 0.0
    friction_per_s: float = 0.0


def drift_factor(per_s: float, age_s: float) -> float:
    """Return the factor by which a number has changed."""
    return max(1.0 + per_s * age_s, LEAST_FACTOR) if per_s != 0.0 else 1.0


def apply_gain_drift_v(drift: Drift, opening_v: float, age_s: float) -> float:
    """Return the opening that a valve without drift would need for the same area."""
    return drift_factor(drift.valve_gain_per_s, age_s) * opening_v


DRIFT = EffectDescription(
    kind=Drift, block="pressure",
    equation="K_Av (1 + r_v t),  k (1 + r_k t),  mu_k (1 + r_f t)",
    parameters=(
        size("valve_gain_per_s", "1/s", 0.01, smallest=2e-4, start=5e-4,
             meaning="r_v, trend of the valve's gain", low=-0.01),
        size("stiffness_per_s", "1/s", 0.01, smallest=1e-4, start=5e-4,
             meaning="r_k, trend of the stiffness", low=-0.01),
        size("friction_per_s", "1/s", 0.01, smallest=2e-4, start=5e-4,
             meaning="r_f, trend of the kinetic friction", low=-0.01),
    ),
    signature="parameters fitted to successive parts of a record show a trend in time",
    best_experiment="squares-apart", seen_by=("pressure", "mechanics"),
    entries=(EffectEntry("opening", apply_gain_drift_v, after=("valve_asymmetry",)),),
    woven=("mechanics",),
    forms=(
        EffectForm("valve gain", free=("valve_gain_per_s",)),
        EffectForm("stiffness", free=("stiffness_per_s",)),
        EffectForm("friction", free=("friction_per_s",)),
    ),
    as_terms=(
        AsTerm("filling", "gain", "time"),
        AsTerm("exhausting", "gain", "time"),
        AsTerm("opening", "gain", "time"),
        AsTerm("stiffness", "gain", "time"),
        AsTerm("braid_friction", "gain", "time"),
    ),
)  # fmt: skip


class EndCap(NamedTuple):
    """The ends of the muscle are not cylindrical: a part of the length neither fills nor pulls."""

    length_m: float = 0.0


def shorten_muscle(cap: EndCap, numbers: PaperParameters) -> PaperParameters:
    """Return the plant's numbers with the active part of L_0."""
    return numbers._replace(rest_length_m=numbers.rest_length_m - cap.length_m)


END_CAP = EffectDescription(
    kind=EndCap, block="mechanics",
    equation="L = L_0 - l_e - x in V(x), A(x) and theta",
    parameters=(
        size("length_m", "m", 0.02, smallest=1e-3, start=3e-3, meaning="l_e, lost length"),
    ),
    signature="a static error: a function of the displacement, multiplied by the pressure",
    best_experiment="fill-and-hold", seen_by=("mechanics", "pressure"),
    entries=(EffectEntry("numbers", shorten_muscle),),
    actuators=("muscle",),
    as_terms=(AsTerm("force", "curve", "position"), AsTerm("pull", "curve", "position")),
)  # fmt: skip


class ExternalLoad(NamedTuple):
    """A weight or a spring under tension pulls the muscle out."""

    force_n: float = 0.0


def load_force_n(load: ExternalLoad) -> float:
    """Return the pull; it opposes contraction."""
    return -load.force_n


EXTERNAL_LOAD = EffectDescription(
    kind=ExternalLoad, block="mechanics",
    equation="F - F_e",
    parameters=(
        size("force_n", "N", 20.0, smallest=0.5, start=3.0, meaning="F_e, against contraction",
             low=-20.0),
    ),
    signature="a constant static offset; it vanishes if the encoder is homed under the load",
    best_experiment="fill-and-hold",
    entries=(EffectEntry("force", load_force_n),),
    actuators=("muscle",),
    as_terms=(AsTerm("force", "constant"),),
)  # fmt: skip


class MovingMass(NamedTuple):
    """A load moves with the muscle. On the paper's it hardly shows: M / c is 88 us."""

    added_kg: float = 0.0


def add_mass(mass: MovingMass, numbers: PaperParameters) -> PaperParameters:
    """Return the plant's numbers with the total mass."""
    return numbers._replace(mass_kg=numbers.mass_kg + mass.added_kg)


def explain_settling(numbers: PaperParameters) -> str:
    """Say how fast the velocity settles: a mass shows in no slower motion."""
    settling_s = numbers.mass_kg / numbers.damping_n_s_per_m
    return (
        f"velocity settles within M / c = {1e3 * settling_s:.2g} ms, and a mass shows in faster "
        "motion only: weigh what moves"
    )


MOVING_MASS = EffectDescription(
    kind=MovingMass, block="mechanics",
    equation="(M + m) x''",
    parameters=(size("added_kg", "kg", 2.0, smallest=0.03, start=0.2, meaning="m"),),
    signature="with a light load nothing above the noise: velocity settles within M / c",
    entries=(EffectEntry("numbers", add_mass),),
    unidentifiable=explain_settling,
    actuators=("muscle",),
)  # fmt: skip


class Piston(NamedTuple):
    """A piston of constant area, on which the measured pressure acts."""

    area_m2: float = 0.0


def piston_force_n(piston: Piston, gauge_pa: float) -> float:
    """Return the push; it acts towards growing displacement where the area is positive."""
    return piston.area_m2 * gauge_pa


PISTON = EffectDescription(
    kind=Piston, block="mechanics",
    equation="A (P - P_atm), added to the force",
    parameters=(
        size("area_m2", "m2", 1e-3, smallest=1e-6, start=3e-5,
             meaning="A; negative where pressure pushes towards smaller x", low=-1e-3),
    ),
    signature="an error in proportion to pressure, at any position and speed",
    entries=(EffectEntry("force", piston_force_n),),
    actuators=("direct",),
)  # fmt: skip


class SpringHysteresis(NamedTuple):
    """Loading and unloading differ at any speed: rubber, a cable, a spring that rubs on itself.

    Bouc and Wen's force, with one number for the way back.
    """

    force_n: float = 0.0
    way_m: float = 1e-3


class Loop(NamedTuple):
    """Where the spring is in its loop: -1 unloading, 1 loading."""

    state: float


def start_loop(position_m: float, pressure_pa: float) -> Loop:
    """Return a spring that was never loaded."""
    return Loop(0.0)


def follow_loop(spring: SpringHysteresis, memory: Loop, begin_m: float, end_m: float) -> Loop:
    """Advance the loop over a motion in one direction, exactly."""
    if end_m == begin_m:
        return memory
    limit = 1.0 if end_m > begin_m else -1.0
    return Loop(limit + (memory.state - limit) * exp(-abs(end_m - begin_m) / spring.way_m))


def loop_force_n(spring: SpringHysteresis, memory: Loop) -> float:
    """Return the pull of the loop: against the motion that made it."""
    return -spring.force_n * memory.state


SPRING_HYSTERESIS = EffectDescription(
    kind=SpringHysteresis, block="mechanics",
    equation="-k x - f z,  dz = (sign(dx) - z) |dx| / w",
    parameters=(
        size("force_n", "N", 20.0, smallest=0.3, start=1.0,
             meaning="f, half the force between loading and unloading"),
        shape("way_m", "m", 1e-5, 20e-3, usual=1e-3, smallest=1e-4,
              meaning="w, the way over which the loop closes after a reversal"),
    ),
    signature="after every reversal the motion lags by a force that builds up over a way, at any "
    "speed and also without pressure",
    best_experiment="slow-ramps",
    entries=(EffectEntry("force", loop_force_n, memory=EffectMemory(start_loop, follow_loop)),),
    actuators=("muscle", "direct", "cylinder"),
    as_terms=(AsTerm("force", "hysteresis", "position"),),
)  # fmt: skip
