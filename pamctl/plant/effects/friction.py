"""Effects on friction, dry and viscous."""

from __future__ import annotations

from math import exp, pow
from typing import NamedTuple

from pamctl.plant.bristles import DAHL, ELASTO_PLASTIC, LUGRE, MAXWELL_SLIP
from pamctl.plant.effects.description import (
    AsTerm,
    Distinction,
    EffectDescription,
    EffectEntry,
    EffectForm,
    shape,
    size,
)
from pamctl.plant.effects.places import FrictionBand


class CoulombFriction(NamedTuple):
    """Dry friction that does not depend on pressure: seal, bushing, guide, encoder."""

    force_n: float = 0.0


def add_dry_friction(coulomb: CoulombFriction, band: FrictionBand) -> FrictionBand:
    """Widen the band on both sides."""
    return FrictionBand(band.lower_n - coulomb.force_n, band.upper_n + coulomb.force_n)


COULOMB_FRICTION = EffectDescription(
    kind=CoulombFriction, block="mechanics",
    equation="f in [-f_0, f_0], added to the band of Eq. 5",
    parameters=(size("force_n", "N", 40.0, smallest=0.3, start=2.0, meaning="f_0"),),
    signature="in both directions, also without pressure: what moves comes to rest off its zero",
    best_experiment="slow-ramps",
    entries=(EffectEntry("friction", add_dry_friction, after=("return_friction",)),),
    as_terms=(AsTerm("force", "hysteresis", "position"),),
)  # fmt: skip


class BraidDrag(NamedTuple):
    """The braid's friction grows with speed by more than in Eq. 5, or by less.

    Eq. 5 adds mu_k N A_b P_g to the damping while the muscle contracts. With a share of -1 the
    braid's friction is dry: it depends on pressure alone.
    """

    share: float = 0.0


def add_braid_drag(drag: BraidDrag, damping_n_s_per_m: float, grip: float) -> float:
    """Return the damping while the muscle contracts; a twentieth of that without the braid stays.

    `grip` is mu_k N A_b P_g of Eq. 5.
    """
    return max(damping_n_s_per_m + grip * (1.0 + drag.share), 0.05 * damping_n_s_per_m)


BRAID_DRAG = EffectDescription(
    kind=BraidDrag, block="mechanics",
    equation="(c + (1 + d) mu_k N A_b P_g) dx/dt in Eq. 5, while the muscle contracts",
    parameters=(
        size("share", "1", 3.0, smallest=0.05, start=-0.2,
             meaning="d, change of the braid's damping as a share; -1 is dry friction", low=-1.3),
    ),
    signature="an error only while the muscle contracts, in proportion to speed times pressure",
    best_experiment="square-1", woven=("mechanics",), actuators=("muscle",),
    as_terms=(AsTerm("damping", "gain", "pressure"), AsTerm("damping", "curve", "pressure"),
              AsTerm("braid_friction", "curve", "velocity")),
)  # fmt: skip


class FrictionAsymmetry(NamedTuple):
    """Dry friction differs between the two directions of motion."""

    share: float = 0.0


def tilt_band(asymmetry: FrictionAsymmetry, band: FrictionBand) -> FrictionBand:
    """Return the band with its two sides scaled apart."""
    return FrictionBand(
        band.lower_n * (1.0 - asymmetry.share), band.upper_n * (1.0 + asymmetry.share)
    )


FRICTION_ASYMMETRY = EffectDescription(
    kind=FrictionAsymmetry, block="mechanics",
    equation="f in [-(1 - a) f_0, (1 + a) f_0]; if f_0 is constant, the same as a load a f_0",
    parameters=(
        size("share", "1", 0.95, smallest=0.02, start=0.1,
             meaning="a, positive where dry friction is greater while x grows", low=-0.95),
    ),
    signature="a constant load, unless dry friction changes with pressure or speed",
    entries=(
        EffectEntry("friction", tilt_band,
                    after=("coulomb_friction", "pressure_friction", "return_friction", "stribeck")),
    ),
    actuators=("direct", "cylinder"),
)  # fmt: skip


class PositionFriction(NamedTuple):
    """The braid's friction changes along the stroke: its threads are worn there, or sit tighter."""

    share_per_m: float = 0.0


def position_factor(friction: PositionFriction, position_m: float) -> float:
    """Return the factor on the braid's friction at a displacement; never below 0."""
    return max(1.0 + friction.share_per_m * position_m, 0.0)


POSITION_FRICTION = EffectDescription(
    kind=PositionFriction, block="mechanics",
    equation="mu_k (1 + r x) in place of mu_k in Eq. 5",
    parameters=(
        size("share_per_m", "1/m", 500.0, smallest=5.0, start=20.0, meaning="r", low=-45.0),
    ),
    signature="the friction band widens, or narrows, along the stroke",
    best_experiment="slow-ramps", woven=("mechanics",), actuators=("muscle",),
    as_terms=(
        AsTerm("braid_friction", "gain", "position"),
        AsTerm("braid_friction", "curve", "position"),
    ),
)  # fmt: skip


class Presliding(NamedTuple):
    """Before it slides, friction is a spring: bristles bend, and keep their force at reversals.

    This replaces the set-valued friction at rest. There are four forms: elasto-plastic (a spring on
    a slider), Dahl (the spring softens towards its limit), LuGre (Dahl, with damping of the
    bristle) and Maxwell slip (four springs on sliders side by side, of equal stiffness and unequal
    limits: it softens step by step, and remembers earlier reversals). The Stribeck part of LuGre's
    model is the effect `stribeck`.
    """

    compliance_m_per_n: float = 0.0
    """1 / sigma_0; 0 is friction that sticks rigidly."""
    form: float = ELASTO_PLASTIC
    bristle_damping_n_s_per_m: float = 0.0
    """Sigma_1 of LuGre's form."""
    second_over_first: float = 1.0
    """What the second element of Maxwell's form can hold, over what the first can."""
    third_over_first: float = 1.0
    fourth_over_first: float = 1.0


PRESLIDING = EffectDescription(
    kind=Presliding, block="mechanics",
    equation="df/dx = sigma_0 within the band (elasto-plastic), or sigma_0 (f_lim - f) / (f_upper "
    "- f_lower) (Dahl), with sigma_1 dz/dt added (LuGre), or four such springs of sigma_0 / 4 "
    "with unequal bands (Maxwell slip)",
    parameters=(
        size("compliance_m_per_n", "m/N", 2e-4, smallest=1e-6, start=1e-5,
             meaning="1 / sigma_0, deflection of the bristles per force"),
        shape("form", "", 0.0, 3.0, usual=0.0, smallest=1.0,
              meaning="law of the bristle's deflection",
              choices=("elasto_plastic", "dahl", "lugre", "maxwell_slip")),
        shape("bristle_damping_n_s_per_m", "N s/m", 0.0, 2000.0, usual=0.0, smallest=20.0,
              meaning="sigma_1, in the form lugre only"),
        *(
            shape(
                f"{name}_over_first",
                "",
                0.1,
                50.0,
                usual=1.0,
                smallest=0.3,
                meaning=f"what the {name} element can hold, over what the first can; in the "
                "form maxwell_slip only",
            )
            for name in ("second", "third", "fourth")
        ),
    ),
    signature="at reversals only: it moves some micrometres before it slides, and the force "
    "depends on where it reversed; the error grows with pressure",
    best_experiment="multisine-small", woven=("mechanics",),
    forms=(
        EffectForm("elasto-plastic", ("compliance_m_per_n",), {"form": ELASTO_PLASTIC}),
        EffectForm("Dahl", ("compliance_m_per_n",), {"form": DAHL}),
        EffectForm("LuGre", ("compliance_m_per_n", "bristle_damping_n_s_per_m"),
                   {"form": LUGRE, "bristle_damping_n_s_per_m": 20.0}),
        EffectForm("Maxwell slip",
                   (
                       "compliance_m_per_n",
                       "second_over_first",
                       "third_over_first",
                       "fourth_over_first",
                   ),
                   {
                       "form": MAXWELL_SLIP,
                       "second_over_first": 1.5,
                       "third_over_first": 2.3,
                       "fourth_over_first": 3.5,
                   }),
    ),
    as_terms=(AsTerm("force", "hysteresis", "position"),),
)  # fmt: skip


class PressureDamping(NamedTuple):
    """Viscous friction grows with pressure, in both directions."""

    per_pa: float = 0.0


def pressure_damping_n_s_per_m(damping: PressureDamping, gauge_pa: float) -> float:
    """Return the damping added to c; 0 below atmospheric pressure."""
    return damping.per_pa * max(gauge_pa, 0.0)


PRESSURE_DAMPING = EffectDescription(
    kind=PressureDamping, block="mechanics",
    equation="c = c_0 + c_p P_g",
    parameters=(size("per_pa", "N s/(m Pa)", 2e-3, smallest=5e-5, start=2e-4, meaning="c_p"),),
    signature="an error in proportion to speed times pressure",
    best_experiment="square-1",
    entries=(EffectEntry("damping", pressure_damping_n_s_per_m),),
    as_terms=(AsTerm("damping", "gain", "pressure"), AsTerm("damping", "curve", "pressure")),
)  # fmt: skip


class PressureFriction(NamedTuple):
    """Dry friction grows with pressure, in both directions: a seal that the air presses on."""

    n_per_pa: float = 0.0


def add_pressed_friction(
    pressed: PressureFriction, band: FrictionBand, gauge_pa: float
) -> FrictionBand:
    """Widen the band on both sides; by nothing below atmospheric pressure."""
    force_n = pressed.n_per_pa * max(gauge_pa, 0.0)
    return FrictionBand(band.lower_n - force_n, band.upper_n + force_n)


PRESSURE_FRICTION = EffectDescription(
    kind=PressureFriction, block="mechanics",
    equation="f in [-(f_0 + f_1 P_g), f_0 + f_1 P_g]",
    parameters=(
        size("n_per_pa", "N/Pa", 4e-4, smallest=1e-6, start=1e-5,
             meaning="f_1, dry friction per gauge pressure"),
    ),
    signature="an error with the sign of the speed, in proportion to pressure",
    entries=(EffectEntry("friction", add_pressed_friction, after=("return_friction",)),),
    actuators=("direct", "cylinder"),
)  # fmt: skip


class ReturnFriction(NamedTuple):
    """Kinetic friction also acts when the muscle lengthens; in the paper only when it contracts."""

    share: float = 0.0


def add_return_friction(friction: ReturnFriction, band: FrictionBand) -> FrictionBand:
    """Extend the band of Eq. 5 to the other direction."""
    return FrictionBand(band.lower_n - friction.share * band.upper_n, band.upper_n)


RETURN_FRICTION = EffectDescription(
    kind=ReturnFriction, block="mechanics",
    equation="f in [-r f_c, f_c],  f_c = mu_k N P_g A_b b theta cos(theta)",
    parameters=(
        size("share", "1", 2.0, smallest=0.025, start=0.1,
             meaning="r, share of the friction when contracting"),
    ),
    signature="an error only while the muscle lengthens, in proportion to pressure",
    best_experiment="slow-ramps",
    entries=(EffectEntry("friction", add_return_friction),),
    actuators=("muscle",),
    as_terms=(AsTerm("pull", "hysteresis", "position"),),
)  # fmt: skip


class Stribeck(NamedTuple):
    """Dry friction is greater at rest and at low speed."""

    rise: float = 0.0
    speed_m_per_s: float = 5e-3
    exponent: float = 2.0
    """2 is Gaussian, 1 Tustin's exponential."""


def stribeck_factor(stribeck: Stribeck, velocity_m_per_s: float) -> float:
    """Return the ratio of dry friction to that at high speed."""
    if stribeck.rise == 0.0:
        return 1.0
    share = abs(velocity_m_per_s) / stribeck.speed_m_per_s
    return 1.0 + stribeck.rise * exp(-pow(share, stribeck.exponent))


def scale_band(stribeck: Stribeck, band: FrictionBand, velocity_m_per_s: float) -> FrictionBand:
    """Return the band at a speed."""
    factor = stribeck_factor(stribeck, velocity_m_per_s)
    return FrictionBand(factor * band.lower_n, factor * band.upper_n)


STRIBECK = EffectDescription(
    kind=Stribeck, block="mechanics",
    equation="f_lim (1 + s exp(-(|v| / v_s)^n))",
    parameters=(
        size("rise", "1", 1.5, smallest=0.04, start=0.2, meaning="s, rise at rest"),
        shape("speed_m_per_s", "m/s", 5e-4, 0.1, usual=5e-3, smallest=1e-3,
              meaning="v_s, speed at which the rise has fallen to a third"),
        shape("exponent", "1", 0.5, 2.0, usual=2.0, smallest=0.5,
              meaning="n: 2 Gaussian, 1 Tustin's"),
    ),
    signature="a late break-away that overshoots, and an error at low speed",
    best_experiment="multisine-small",
    entries=(
        EffectEntry("friction", scale_band,
                    after=("coulomb_friction", "pressure_friction", "return_friction")),
    ),
    forms=(
        EffectForm("Gaussian", ("rise", "speed_m_per_s"), {"exponent": 2.0}),
        EffectForm("Tustin", ("rise", "speed_m_per_s"), {"exponent": 1.0}),
    ),
    told_from={
        "return_friction": Distinction("slow-ramps",
                                       "return friction grows with pressure, while the muscle "
                                         "lengthens only; this one grows at low speed, in both "
                                         "directions"),
    },
    as_terms=(AsTerm("braid_friction", "curve", "velocity"),),
)  # fmt: skip


class ViscousAsymmetry(NamedTuple):
    """Viscous friction differs between the two directions of motion."""

    share: float = 0.0


VISCOUS_ASYMMETRY = EffectDescription(
    kind=ViscousAsymmetry, block="mechanics",
    equation="c (1 + a) while x grows, c (1 - a) while it falls",
    parameters=(
        size("share", "1", 0.95, smallest=0.02, start=0.1,
             meaning="a, positive where the damping is greater while x grows", low=-0.95),
    ),
    signature="an error in proportion to the absolute value of the speed",
    woven=("mechanics",), actuators=("direct", "cylinder"),
)  # fmt: skip
