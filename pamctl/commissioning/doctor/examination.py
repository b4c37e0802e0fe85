"""What `pamctl doctor` looks at, from the PC to the muscle."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from pathlib import Path

from hal.reservation import reserved
from hal.rig import RigError
from pamctl.commissioning.doctor.card import card_findings, clock_finding
from pamctl.commissioning.doctor.findings import Finding
from pamctl.commissioning.doctor.latency import measured_wake_ups, wake_up_finding
from pamctl.commissioning.doctor.pc import pc_findings, permission_findings
from pamctl.commissioning.doctor.rig_findings import rig_findings, unavailable
from pamctl.commissioning.doctor.sensors import BY_HAND_COUNTS
from pamctl.commissioning.hands_on import Bench
from pamctl.commissioning.open_bench import workplace
from pamctl.commissioning.terminal_operator import NoAnswer, Terminal
from pamctl.processes.backends import SHARED_MEMORY, clock_of, device_of
from pamctl.realtime.scheduling import prepare
from pamctl.settings.resolve import RunSettings
from pamctl.settings.rig_file import NidaqRigSettings


def examination(
    settings: RunSettings, rt_seconds: float, *, actuate: bool, may_ask: bool
) -> Generator[Finding, None, None]:
    """Look at everything, from the PC to the muscle."""
    yield from pc_findings(SHARED_MEMORY, Path("logs"))
    yield from _timing(settings, rt_seconds)
    if isinstance(settings.rig, NidaqRigSettings):
        found = list(card_findings(settings.rig))
        yield from found
        if any(f.level == "fault" and f.name in _INDISPENSABLE for f in found):
            return
    try:
        with workplace(settings) as bench:
            yield from rig_findings(
                bench,
                actuate=actuate,
                by_hand=_asked if may_ask else lambda bench: None,
                loop_cpu=settings.rig.loop.cpu,
            )
        if isinstance(settings.rig, NidaqRigSettings):
            device = device_of(settings)
            with reserved(SHARED_MEMORY / f"pamctl-{device}.lock", device):
                yield clock_finding(settings.rig)
    except RigError as error:
        yield unavailable(error)


_INDISPENSABLE = ("card.driver", "card.device", "card.channels", "card.reservations")
"""Without these there is no rig to open; what else is wrong with the card does not hinder it."""


def _timing(settings: RunSettings, rt_seconds: float) -> Iterator[Finding]:
    """Measure the loop's clock as any program has it, and then with all that is permitted."""
    period_s = 1.0 / settings.rig.loop.rate_hz
    plain = measured_wake_ups(clock_of(settings, may_spin=False), rt_seconds)
    with prepare("auto", settings.rig.loop.cpu) as preparation:
        permitted = tuple(permission_findings(preparation))
        how = "SCHED_FIFO" if preparation.fifo else "no SCHED_FIFO"
        if preparation.may_spin:
            how += f", spinning {settings.rig.loop.spin_us:g} us"
        clock = clock_of(settings, may_spin=preparation.may_spin)
        prepared = measured_wake_ups(clock, rt_seconds)
    yield from permitted
    yield wake_up_finding("pc.wakeup", prepared, period_s, how)
    # For comparison: no run is scheduled so, unless told to by `--rt off`.
    plainly = wake_up_finding("pc.wakeup_plain", plain, period_s, "as any program")
    yield plainly._replace(level="ok")


def _asked(bench: Bench) -> int | None:
    """Ask for the carriage to be moved; return over how many counts it went."""
    terminal, counts = Terminal(), list[int]()

    def watch() -> None:
        counts.extend(s.encoder_counts for s in bench.hold_unwatched(bench.safe_valve_v, 0.02))

    request = (
        f"move the carriage by hand, by a millimetre ({BY_HAND_COUNTS} counts) or more, and back"
    )
    watch()  # before anybody is asked, and once more when it is said to be done
    try:
        done = terminal.did(request, watch)
    except NoAnswer:
        return None
    watch()
    return max(counts) - min(counts) if done else None
