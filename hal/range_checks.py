"""Whether an analog input sees every voltage that a limit must see: for `pamctl doctor`."""

from __future__ import annotations

from typing import Any

from hal.backend import ProbeRequest
from hal.doctor_finding import DoctorFinding

VoltRange = tuple[float, float]


def judge_input_range(
    section: str, requested: VoltRange, ranges: tuple[VoltRange, ...], request: ProbeRequest[Any]
) -> DoctorFinding:
    """Check the range that a 16-bit card takes; `section` is the section of the rig file."""
    name, least = "card.input_range", request.sensor_range_v
    taken = min(
        (one for one in ranges if holds(one, requested)),
        key=lambda one: one[1] - one[0],
        default=None,
    )
    found = f"asked {format_range(requested)}" + (
        f", the card takes {format_range(taken)}" if taken else ""
    )
    if taken is None:
        wanted = f"within one of {', '.join(map(format_range, ranges))}"
        fix = f"correct {section}.input_low_v and {section}.input_high_v"
        return DoctorFinding(name, "fault", found, wanted, fix)
    resolution_pa = (taken[1] - taken[0]) / 65536 * request.sensor_pa_per_v
    data = {"low_v": taken[0], "high_v": taken[1], "step_pa": resolution_pa}
    if not holds(requested, least) or not holds(taken, least):
        wanted = (
            f"at least {format_range(least)}; otherwise limits.pressure_pa and the sensor's wire "
            "are not watched"
        )
        fix = f"set {section}.input_low_v to -5 and {section}.input_high_v to 5"
        return DoctorFinding(name, "fault", found, wanted, fix, data)
    return DoctorFinding(name, "ok", f"{found}: {resolution_pa:.0f} Pa a code", data=data)


def holds(outer: VoltRange, inner: VoltRange) -> bool:
    """Return whether one range lies within another."""
    return outer[0] <= inner[0] and inner[1] <= outer[1]


def format_range(pair: VoltRange) -> str:
    """Return a range as text."""
    return f"{pair[0]:g} to {pair[1]:g} V"
