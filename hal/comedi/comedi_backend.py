"""The record of a card behind comedi. libcomedi is loaded only where the card is really needed."""

from __future__ import annotations

from pathlib import PurePosixPath

from hal.backend import Backend, BuiltRig, DeviceProbe, RigKeys, RigRequest
from hal.comedi.comedi_checks import REQUIRED, examine_comedi
from hal.comedi.comedi_settings import ComediSettings
from hal.m_series import card_output


def _require(settings: ComediSettings) -> None:
    from hal.comedi.comedi_rig import require_card

    require_card(settings)


def _build(request: RigRequest[ComediSettings]) -> BuiltRig:
    from hal.comedi.comedi_rig import ComediRig

    return BuiltRig(
        ComediRig(request.settings, safe_output_v=request.safe_volts, now_ns=request.now_ns)
    )


COMEDI = Backend(
    name="comedi",
    description="An NI card behind the kernel's own driver. `safe_volts` has no default: only "
    "its owner knows what is safe.",
    settings=ComediSettings,
    rig_file="pci6221-comedi",
    safe_volts=None,
    device=lambda settings: PurePosixPath(settings.device).name,
    output=card_output,
    build=_build,
    require=_require,
    keys=RigKeys(
        pressure_input="comedi.pressure_channel",
        pressure_wiring="comedi.terminal",
        encoder_input="comedi.encoder_a_pfi",
        encoder_filter="comedi.encoder_filter_ns",
        valve_output="comedi.valve_channel",
    ),
    probe=DeviceProbe(examine_comedi, REQUIRED),
)
