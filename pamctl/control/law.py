"""The contract of a control law, and which laws there are.

A law is a pure kernel: `(gains, state, reference, estimate, dt) -> (command, state)`.
It logs the terms it is made of with the command. All it remembers is its `LawState`,
which can be frozen and thawed, so a replay can start in the middle of a log.
"""

from __future__ import annotations

from math import isnan, nan
from typing import Annotated, NamedTuple

from pydantic import Field

from pamctl.control.filters import FilterGains
from pamctl.control.pid import PidGains, PidSettings, pid, pid_gains
from pamctl.control.qsmc import QsmcGains, QsmcSettings, SlidingGains, qsmc, qsmc_gains
from pamctl.control.smc import SmcGains, SmcSettings, smc, smc_gains
from pamctl.control.surface import ARMED, LawState
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.signals import Command, Estimate, Reference

ControllerSettings = Annotated[QsmcSettings | SmcSettings | PidSettings, Field(discriminator="law")]

QSMC, SMC, PID = 0, 1, 2


class Gains(NamedTuple):
    """Gains of the law in use; those of the others are there and not used.

    Numba needs one type for all laws, so that the closed loop compiles once for all.
    """

    law: int
    qsmc: QsmcGains
    smc: SmcGains
    pid: PidGains


_NO_SURFACE = SlidingGains(1.0, 1.0, 0.0, 1.0, True, 0.0)
_IDLE = Gains(
    -1,
    QsmcGains(_NO_SURFACE, 0.0),
    SmcGains(_NO_SURFACE, 0.0, plant_parameters(PlantSettings()).paper),
    PidGains(0.0, 0.0, 0.0, 0.0),
)


def law_gains(settings: QsmcSettings | SmcSettings | PidSettings) -> Gains:
    """Turn a gains file into the numbers that the kernels use."""
    match settings:
        case QsmcSettings():
            return _IDLE._replace(law=QSMC, qsmc=qsmc_gains(settings))
        case SmcSettings():
            return _IDLE._replace(law=SMC, smc=smc_gains(settings))
        case PidSettings():
            return _IDLE._replace(law=PID, pid=pid_gains(settings))


def filter_gains(settings: QsmcSettings | SmcSettings | PidSettings) -> FilterGains:
    """Return the filters that a gains file asks for."""
    return FilterGains(settings.lpf1_hz, settings.lpf2_hz)


def respond(
    gains: Gains, state: LawState, reference: Reference, estimate: Estimate, dt_s: float
) -> tuple[Command, LawState]:
    """Let the law answer; a reference that is a valve command is obeyed as it stands.

    Open loop the law rests with its integral cleared, and so takes over without a jump.
    """
    if not isnan(reference.reference_valve_v):
        return Command(reference.reference_valve_v, nan, 0.0, 0.0, False), ARMED
    if gains.law == QSMC:
        return qsmc(gains.qsmc, state, reference, estimate, dt_s)
    if gains.law == SMC:
        return smc(gains.smc, state, reference, estimate, dt_s)
    return pid(gains.pid, state, reference, estimate, dt_s)
