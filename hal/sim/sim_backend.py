"""The record of the simulated rig."""

from __future__ import annotations

from hal.backend import Backend, BuiltRig, RigRequest
from hal.sim.register import SharedRegister
from hal.sim.sim_rig import SimRig, SimSettings, sensor_chain, simulated_output


def _build(request: RigRequest[SimSettings]) -> BuiltRig:
    settings, output_file = request.settings, request.output_file
    rig = SimRig(
        request.plant,
        sensor_chain(settings, request.calibration),
        safe_output_v=request.safe_volts,
        now_ns=request.now_ns,
        output_delay_ticks=settings.output_delay_ticks,
        seed=request.seed,
        register=None if output_file is None else SharedRegister(output_file, settings.device),
    )
    return BuiltRig(rig)


SIM = Backend(
    name="sim",
    description="A simulated rig; what it moves is the plant.",
    settings=SimSettings,
    rig_file="sim",
    safe_volts=0.0,
    device=lambda settings: settings.device,
    output=simulated_output,
    build=_build,
    is_simulated=True,
)
