"""The catalogue of effects that the paper's model leaves out.

One file an effect: its parameters (a NamedTuple whose defaults are the neutral
values), its kernel, and its description. To add one: write the file, name it in its
part's effects and in `CATALOGUE`, and call its kernel where it enters the plant. At the
neutral values the paper's model is reproduced bit for bit.
"""

from __future__ import annotations

from typing import NamedTuple

from pamctl.plant.effects.air import (
    chamber_leak,
    dead_volume,
    discharge_ratio,
    line_restriction,
    polytropic,
    supply_droop,
)
from pamctl.plant.effects.air.chamber_leak import ChamberLeak
from pamctl.plant.effects.air.dead_volume import DeadVolume
from pamctl.plant.effects.air.discharge_ratio import DischargeRatio
from pamctl.plant.effects.air.line_restriction import LineRestriction
from pamctl.plant.effects.air.polytropic import Polytropic
from pamctl.plant.effects.air.supply_droop import SupplyDroop
from pamctl.plant.effects.description import EffectDescription
from pamctl.plant.effects.mechanics import (
    bladder_threshold,
    braid_stretch,
    coulomb_friction,
    creep,
    cubic_stiffness,
    drift,
    end_cap,
    external_load,
    moving_mass,
    presliding,
    pressure_damping,
    return_friction,
    stribeck,
)
from pamctl.plant.effects.mechanics.bladder_threshold import BladderThreshold
from pamctl.plant.effects.mechanics.braid_stretch import BraidStretch
from pamctl.plant.effects.mechanics.coulomb_friction import CoulombFriction
from pamctl.plant.effects.mechanics.creep import Creep
from pamctl.plant.effects.mechanics.cubic_stiffness import CubicStiffness
from pamctl.plant.effects.mechanics.drift import Drift
from pamctl.plant.effects.mechanics.external_load import ExternalLoad
from pamctl.plant.effects.mechanics.presliding import Presliding
from pamctl.plant.effects.mechanics.pressure_damping import PressureDamping
from pamctl.plant.effects.mechanics.return_friction import ReturnFriction
from pamctl.plant.effects.mechanics.stribeck import Stribeck
from pamctl.plant.effects.sensors import (
    encoder_backlash,
    encoder_scale,
    pressure_sensor_gain,
    pressure_sensor_lag,
    pressure_sensor_offset,
)
from pamctl.plant.effects.sensors.encoder_backlash import EncoderBacklash
from pamctl.plant.effects.sensors.encoder_scale import EncoderScale
from pamctl.plant.effects.sensors.pressure_sensor_gain import PressureSensorGain
from pamctl.plant.effects.sensors.pressure_sensor_lag import PressureSensorLag
from pamctl.plant.effects.sensors.pressure_sensor_offset import PressureSensorOffset
from pamctl.plant.effects.valve import (
    command_delay,
    valve_asymmetry,
    valve_curve,
    valve_deadband,
    valve_hysteresis,
    valve_leak,
    valve_saturation,
    valve_spool,
)
from pamctl.plant.effects.valve.command_delay import CommandDelay
from pamctl.plant.effects.valve.valve_asymmetry import ValveAsymmetry
from pamctl.plant.effects.valve.valve_curve import ValveCurve
from pamctl.plant.effects.valve.valve_deadband import ValveDeadband
from pamctl.plant.effects.valve.valve_hysteresis import ValveHysteresis
from pamctl.plant.effects.valve.valve_leak import ValveLeak
from pamctl.plant.effects.valve.valve_saturation import ValveSaturation
from pamctl.plant.effects.valve.valve_spool import ValveSpool


class ValveEffects(NamedTuple):
    """Parameters of the effects on what makes the opening of a command."""

    valve_deadband: ValveDeadband = ValveDeadband()
    valve_asymmetry: ValveAsymmetry = ValveAsymmetry()
    valve_saturation: ValveSaturation = ValveSaturation()
    valve_curve: ValveCurve = ValveCurve()
    valve_spool: ValveSpool = ValveSpool()
    valve_hysteresis: ValveHysteresis = ValveHysteresis()
    drift: Drift = Drift()


class AirEffects(NamedTuple):
    """Parameters of the effects on the air's flow and pressure."""

    valve_leak: ValveLeak = ValveLeak()
    chamber_leak: ChamberLeak = ChamberLeak()
    discharge_ratio: DischargeRatio = DischargeRatio()
    supply_droop: SupplyDroop = SupplyDroop()
    line_restriction: LineRestriction = LineRestriction()
    dead_volume: DeadVolume = DeadVolume()
    polytropic: Polytropic = Polytropic()
    braid_stretch: BraidStretch = BraidStretch()


class MechanicsEffects(NamedTuple):
    """Parameters of the effects on forces and friction."""

    presliding: Presliding = Presliding()
    stribeck: Stribeck = Stribeck()
    return_friction: ReturnFriction = ReturnFriction()
    coulomb_friction: CoulombFriction = CoulombFriction()
    pressure_damping: PressureDamping = PressureDamping()
    cubic_stiffness: CubicStiffness = CubicStiffness()
    creep: Creep = Creep()
    bladder_threshold: BladderThreshold = BladderThreshold()
    braid_stretch: BraidStretch = BraidStretch()
    external_load: ExternalLoad = ExternalLoad()
    drift: Drift = Drift()


class SensorEffects(NamedTuple):
    """Parameters of the effects on what the sensors show."""

    pressure_sensor_lag: PressureSensorLag = PressureSensorLag()
    pressure_sensor_offset: PressureSensorOffset = PressureSensorOffset()
    pressure_sensor_gain: PressureSensorGain = PressureSensorGain()
    encoder_scale: EncoderScale = EncoderScale()
    encoder_backlash: EncoderBacklash = EncoderBacklash()


class Effects(NamedTuple):
    """Parameters of every effect, by the part of a step that computes it; by default none acts.

    An effect that two parts compute stands in both. Two are in the plant's own numbers and in no
    step: `end_cap` and `moving_mass`.
    """

    command_delay: CommandDelay = CommandDelay()
    valve: ValveEffects = ValveEffects()
    air: AirEffects = AirEffects()
    mechanics: MechanicsEffects = MechanicsEffects()
    sensors: SensorEffects = SensorEffects()


CATALOGUE: dict[str, EffectDescription] = {
    effect.DESCRIPTION.name: effect.DESCRIPTION
    for effect in (
        valve_deadband,
        valve_asymmetry,
        valve_saturation,
        valve_curve,
        valve_spool,
        valve_hysteresis,
        valve_leak,
        command_delay,
        chamber_leak,
        discharge_ratio,
        supply_droop,
        line_restriction,
        dead_volume,
        polytropic,
        presliding,
        stribeck,
        return_friction,
        coulomb_friction,
        pressure_damping,
        cubic_stiffness,
        creep,
        bladder_threshold,
        braid_stretch,
        end_cap,
        external_load,
        moving_mass,
        pressure_sensor_lag,
        pressure_sensor_offset,
        pressure_sensor_gain,
        encoder_scale,
        encoder_backlash,
        drift,
    )
}
