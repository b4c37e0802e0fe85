"""`pamctl safe`: the safe voltage, in any situation."""

from __future__ import annotations

from pamctl.cli.failure import Failed
from pamctl.cli.options import require_linux, verb
from pamctl.cli.output import print_result
from pamctl.cli.settings_from_options import RigOptions
from pamctl.exit_codes import ExitCode
from pamctl.settings.resolve import RunSettings

_PATIENCE_S = 0.5
"""Time for a process that holds the device and is dying; a living one must be stopped first."""


@verb
def safe(asked: RigOptions) -> None:
    """Drive the rig to its safe voltage, in any situation."""
    settings, _ = asked.resolve()
    require_linux()
    from pamctl.processes.backends import device_of

    device, volts = device_of(settings), settings.rig.safe_volts
    failure = _make_safe(settings)
    if failure is not None:
        reason = f"NOT SAFE, {device}: {volts:g} V could not be driven: {failure}"
        raise Failed(ExitCode.UNAVAILABLE, reason, device=device, safe_volts=volts)
    cal = settings.rig.calibration
    u_v = (volts - cal.driver_offset_v) / cal.driver_gain
    document = {"exit_code": 0, "device": device, "safe_volts": volts, "reason": ""}
    text = f"{device}: {volts:g} V on the output (u = {u_v:g} V): safe"
    print_result(document, text, as_json=asked.as_json)


def _make_safe(settings: RunSettings) -> Exception | None:
    from pamctl.processes.backends import build_clock, build_rig, require_backend
    from pamctl.processes.guardian import drive_safe

    try:
        require_backend(settings)
        rig = build_rig(settings, build_clock(settings, may_spin=False)).rig
        return drive_safe(rig, _PATIENCE_S)
    # Whatever it is, the valve may be open: the line must say so.
    except Exception as error:
        return error
