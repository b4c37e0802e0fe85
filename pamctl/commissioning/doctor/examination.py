"""What `pamctl doctor` looks at, from the PC to the muscle."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from pathlib import Path

from hal.reservation import hold_reservation
from hal.rig import RigError
from pamctl.commissioning.doctor.card import examine_card, examine_card_clock
from pamctl.commissioning.doctor.findings import DoctorFinding
from pamctl.commissioning.doctor.latency import judge_wake_ups, measure_wake_ups
from pamctl.commissioning.doctor.pc import examine_pc, judge_permissions
from pamctl.commissioning.doctor.rig_findings import examine_rig, report_unavailable_rig
from pamctl.commissioning.doctor.sensors import BY_HAND_COUNTS
from pamctl.commissioning.hands_on import Bench
from pamctl.commissioning.open_bench import open_workplace
from pamctl.commissioning.terminal_operator import NoAnswer, Terminal
from pamctl.processes.backends import SHARED_MEMORY, build_clock, device_of
from pamctl.realtime.scheduling import prepare
from pamctl.settings.resolve import RunSettings
from pamctl.settings.rig_file import NidaqRigSettings


def examine_all(
    settings: RunSettings, rt_seconds: float, *, actuate: bool, may_ask: bool
) -> Generator[DoctorFinding, None, None]:
    """Look at everything, from the PC to the muscle."""
    yield from examine_pc(SHARED_MEMORY, Path("logs"))
    yield from _measure_timing(settings, rt_seconds)
    if isinstance(settings.rig, NidaqRigSettings):
        found = list(examine_card(settings.rig))
        yield from found
        if any(f.level == "fault" and f.name in _INDISPENSABLE for f in found):
            return
    try:
        with open_workplace(settings) as bench:
            yield from examine_rig(
                bench,
                actuate=actuate,
                by_hand=_ask_for_motion if may_ask else lambda bench: None,
                loop_cpu=settings.rig.loop.cpu,
            )
        if isinstance(settings.rig, NidaqRigSettings):
            device = device_of(settings)
            with hold_reservation(SHARED_MEMORY / f"pamctl-{device}.lock", device):
                yield examine_card_clock(settings.rig)
    except RigError as error:
        yield report_unavailable_rig(error)


_INDISPENSABLE = ("card.driver", "card.device", "card.channels", "card.reservations")
"""Without these there is no rig to open; what else is wrong with the card does not hinder it."""


def _measure_timing(settings: RunSettings, rt_seconds: float) -> Iterator[DoctorFinding]:
    """Measure the loop's clock as any program has it, and then with all that is permitted."""
    period_s = 1.0 / settings.rig.loop.rate_hz
    plain = measure_wake_ups(build_clock(settings, may_spin=False), rt_seconds)
    with prepare("auto", settings.rig.loop.cpu) as preparation:
        permitted = tuple(judge_permissions(preparation))
        how = "SCHED_FIFO" if preparation.fifo else "no SCHED_FIFO"
        if preparation.may_spin:
            how += f", spinning {settings.rig.loop.spin_us:g} us"
        clock = build_clock(settings, may_spin=preparation.may_spin)
        prepared = measure_wake_ups(clock, rt_seconds)
    yield from permitted
    yield judge_wake_ups("pc.wakeup", prepared, period_s, how)
    # For comparison: no run is scheduled so, unless told to by `--rt off`.
    plainly = judge_wake_ups("pc.wakeup_plain", plain, period_s, "as any program")
    yield plainly._replace(level="ok")


def _ask_for_motion(bench: Bench) -> int | None:
    """Ask for the carriage to be moved; return over how many counts it went."""
    terminal, counts = Terminal(), list[int]()

    def watch() -> None:
        counts.extend(s.encoder_counts for s in bench.hold_unwatched(bench.safe_valve_v, 0.02))

    request = (
        f"move the carriage by hand, by a millimetre ({BY_HAND_COUNTS} counts) or more, and back"
    )
    watch()  # before anybody is asked, and once more when it is said to be done
    try:
        done = terminal.confirm_done(request, watch)
    except NoAnswer:
        return None
    watch()
    return max(counts) - min(counts) if done else None
