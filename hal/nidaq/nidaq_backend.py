"""The record of the NI card. nidaqmx is imported only where the card is really needed."""

from __future__ import annotations

from hal.backend import Backend, BuiltRig, DeviceProbe, RigKeys, RigRequest
from hal.m_series import card_output
from hal.nidaq.card_checks import REQUIRED, examine_card, examine_card_clock, examine_output
from hal.nidaq.card_settings import NidaqSettings
from hal.nidaq.driver_errors import PACKAGE_BROKEN
from hal.rig import RigError


def _require(settings: NidaqSettings) -> None:
    try:
        from hal.nidaq.driver import require_card
    # Any exception at all: the package reads every `.env` file from this directory upwards.
    except Exception as error:
        raise RigError(
            f"the package nidaqmx cannot be imported: {error}", fix=PACKAGE_BROKEN
        ) from error
    require_card(settings)


def _build(request: RigRequest[NidaqSettings]) -> BuiltRig:
    settings = request.settings
    if request.by_computer or settings.timing == "on_demand":
        from hal.nidaq.on_demand import NidaqRig

        return BuiltRig(NidaqRig(settings, safe_output_v=request.safe_volts, now_ns=request.now_ns))

    from hal.nidaq.hardware_timed import HardwareTimedRig

    timed = HardwareTimedRig(
        settings,
        rate_hz=request.rate_hz,
        safe_output_v=request.safe_volts,
        now_ns=request.now_ns,
    )
    return BuiltRig(timed, timed.await_edge)


def _check(settings: NidaqSettings, rate_hz: float) -> None:
    if settings.timing == "hardware_timed" and settings.timeout_s * rate_hz < 2:
        raise ValueError(
            f"nidaq.timeout_s {settings.timeout_s:g} is less than two periods of "
            f"loop.rate_hz {rate_hz:g}: a hardware-timed read waits for one"
        )


NIDAQ = Backend(
    name="nidaq",
    description="An NI card. `safe_volts` has no default: only its owner knows what is safe.",
    settings=NidaqSettings,
    rig_file="pci6221",
    safe_volts=None,
    device=lambda settings: settings.device,
    output=card_output,
    build=_build,
    require=_require,
    check=_check,
    keys=RigKeys(
        pressure_input="nidaq.pressure_channel",
        pressure_wiring="nidaq.terminal",
        encoder_input="nidaq.encoder_counter",
        encoder_filter="nidaq.encoder_filter_ns",
        valve_output="nidaq.valve_channel",
    ),
    probe=DeviceProbe(examine_card, REQUIRED, examine_card_clock, examine_output),
)
