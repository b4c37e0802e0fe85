"""An NI M Series card, whichever driver serves it: wiring, safe voltage, what a doctor looks at.

The card has no watchdog and holds its last output voltage when a task stops, a process dies, or
the driver unloads. So `open` writes the safe voltage first, and every way out writes it last. A
dying process may still hold the output: then it is tried again and again.
"""

from __future__ import annotations

import math
import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, NamedTuple, Self, TypeVar

from pydantic import Field, model_validator

from hal.backend import ProbeRequest, describe_rig_error, report_check
from hal.calibration import Configured, Converter, Output, make_output, nearest_output_v
from hal.problem import Problem
from hal.rig import RigError


class MSeriesWiring(Configured):
    """Which terminals of which card, and in what ranges."""

    device: str
    """Name of the card, as its driver knows it."""
    pressure_channel: Annotated[str, Field(pattern="^ai([0-9]|[1-7][0-9])$")] = "ai0"
    terminal: Annotated[
        Literal["rse", "nrse", "diff"],
        Field(description="rse for a sensor fed by the card, nrse for one grounded elsewhere"),
    ] = "rse"
    input_low_v: Annotated[float, Field(ge=-10, le=10)] = -5.0
    input_high_v: Annotated[
        float, Field(ge=-10, le=10, description="the card takes its narrowest range that fits")
    ] = 5.0
    encoder_counter: Literal["ctr0", "ctr1"] = "ctr0"
    encoder_filter_ns: Annotated[
        Literal[0, 125, 6425],
        Field(description="shortest pulse that counts; 6425 loses counts above 0.99 m/s, 0 is off"),
    ] = 125
    valve_channel: Literal["ao0", "ao1"] = "ao0"
    output_low_v: Annotated[float, Field(ge=-10, le=10)] = 0.0
    output_high_v: Annotated[
        float, Field(ge=-10, le=10, description="no voltage outside these two leaves the rig")
    ] = 10.0

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if self.input_low_v >= self.input_high_v:
            raise ValueError("input_low_v must be below input_high_v")
        if self.output_low_v >= self.output_high_v:
            raise ValueError("output_low_v must be below output_high_v")
        return self


_CONVERTER = Converter(10.0)
"""An M Series output is always +-10 V, whatever range its channel is given."""


def card_output(wiring: MSeriesWiring) -> Output:
    """Return the valve's output as the card realises it."""
    return make_output(_CONVERTER, wiring.output_low_v, wiring.output_high_v)


def unwrap_count(last: int, reading: int, span: int = 1 << 32) -> int:
    """Return the count nearest to `last` that a counter of `span` values shows as `reading`.

    It makes no difference whether the counter shows -1 as -1 or as `span - 1`.
    """
    half = span // 2
    return last + (reading - last + half) % span - half


Settings = TypeVar("Settings", bound=MSeriesWiring)
Wired = TypeVar("Wired")

# Shorter than the heartbeat: a loop that tries for longer is killed, and its reason is lost. The
# guardian goes on trying.
_TRIES = 6
_TRIES_AS_OPEN = 2
_RETRY_S = 5e-3


class CardRig(ABC, Generic[Settings, Wired]):
    """A rig on one M Series card; `Wired` is what an open card offers."""

    def __init__(
        self,
        settings: Settings,
        *,
        safe_output_v: float,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`safe_output_v` is the analog output voltage at which the rig is safe."""
        self._settings = settings
        self._now_ns = now_ns
        self._output = card_output(settings)
        self._safe_v = nearest_output_v(self._output, safe_output_v)
        self._safe_output_v = safe_output_v
        self._wired: Wired | None = None
        self._held = ExitStack()
        self._counts = 0
        self._identity: Mapping[str, object] = {}
        self._safe_failure: Exception | None = None

    def open(self) -> None:
        """Drive the safe voltage, and only then take the inputs."""
        if self._wired is not None:
            raise RigError("the rig is open already", fix="call close() first")
        with self._explain_opening(), ExitStack() as acquired:
            wired = self._wire(acquired)
            self._counts = 0
            self._wired, self._held = wired, acquired.pop_all()

    def write(self, ao_v: float) -> float:
        """Put a voltage on the output: the nearest code within the configured range."""
        wired = self._require_open()
        if not math.isfinite(ao_v):
            raise RigError(f"refused to output {ao_v} V", fix="a law must command a finite voltage")
        admitted_v = nearest_output_v(self._output, ao_v)
        self._put_v(wired, admitted_v)
        return admitted_v

    def make_safe(self) -> None:
        """Drive the safe voltage, over the open card or over an output taken for this alone.

        If every try fails, `safe_failure` says why. An output that fails twice is released and
        taken again; to go on, the rig must then be opened again.
        """
        for attempt in range(_TRIES):
            try:
                self._drive_safe(as_open=attempt < _TRIES_AS_OPEN)
            # Any exception at all: the next try is worth more than the reason.
            except Exception as error:
                self._safe_failure = error
                if self._is_hopeless(error):
                    return
                time.sleep(_RETRY_S)
            else:
                self._safe_failure = None
                return

    def close(self) -> None:
        """Make safe, then release the card; the output holds the safe voltage."""
        self.make_safe()
        self._release()

    @property
    def safe_failure(self) -> RigError | None:
        """Why the last `make_safe` could not drive the safe voltage; None where it did."""
        failure = self._safe_failure
        return None if failure is None else self._explain_failure(failure)

    @abstractmethod
    def _wire(self, acquired: ExitStack) -> Wired:
        """Write the safe voltage, and only then take the inputs."""

    @abstractmethod
    def _put_v(self, wired: Wired, volts: float) -> None:
        """Write to the output of an open card; raise `RigError`."""

    @abstractmethod
    def _write_safe_as_wired(self, wired: Wired) -> None:
        """Write the safe voltage to the output of an open card; anything may be raised."""

    @abstractmethod
    def _write_safe_alone(self) -> None:
        """Write the safe voltage through an output that is taken for this alone."""

    @abstractmethod
    def _is_hopeless(self, error: Exception) -> bool:
        """Tell whether no further try can help."""

    @abstractmethod
    def _explain_failure(self, failure: Exception) -> RigError:
        """Return the error of a safe voltage that could not be driven."""

    def _explain_opening(self) -> AbstractContextManager[None]:
        """Return what turns the driver's errors into `RigError` while the card is opened."""
        return nullcontext()

    def _drive_safe(self, *, as_open: bool) -> None:
        if self._wired is not None and as_open:
            self._write_safe_as_wired(self._wired)
        else:
            self._release()
            self._write_safe_alone()

    def _release(self) -> None:
        self._wired = None
        # Nothing can be done about a part of the card that cannot be released.
        with suppress(Exception):
            self._held.close()

    def _require_open(self) -> Wired:
        if self._wired is None:
            raise RigError("the card is not open", fix="call open() first")
        return self._wired


STAND_IN_PERMIT = "PAMCTL_PERMIT_STAND_IN"
"""Environment variable that permits the stand-in drivers; only tests set it."""


def find_loaded_library(name: str) -> str:
    """Return the path of the library (`libcomedi.so`) that this process has really loaded."""
    for mapping in Path("/proc/self/maps").read_text().splitlines():
        if f"/{name}" in mapping:
            return mapping.split(maxsplit=5)[5]
    return ""


def refuse_stand_in(device: str, library: str) -> None:
    """Raise `RigError` for a stand-in driver, except in the tests."""
    if STAND_IN_PERMIT not in os.environ:
        raise RigError(
            f"{device} is not a card: it is the stand-in driver of pamctl's tests, in {library}",
            fix="take its directory out of LD_LIBRARY_PATH",
        )


PCI_DEVICES = Path("/sys/bus/pci/devices")
COMEDI_DRIVER = "ni_pcimio"
"""The kernel's own driver. It takes a PCI-6221 by itself when the PC starts."""
NO_CARD_FIX = "is the card seated and powered? lspci -nn -d 1093: lists it"

_NI = "0x1093"


class PciCard(NamedTuple):
    """One of NI's cards, as the kernel sees it."""

    slot: str
    """Such as 0000:05:00.0."""
    device_id: str
    """Such as 0x70af."""
    driver: str
    """Name of the kernel driver that holds it; empty where none does."""


def find_pci_cards(directory: Path = PCI_DEVICES) -> list[PciCard]:
    """Return NI's cards in the order of their slots; none where the system has no such place."""
    slots = sorted(directory.iterdir()) if directory.is_dir() else []
    return [
        PciCard(
            slot.name,
            read_line(slot / "device"),
            (slot / "driver").resolve().name if (slot / "driver").exists() else "",
        )
        for slot in slots
        if read_line(slot / "vendor") == _NI
    ]


def read_line(path: Path) -> str:
    """Return what the kernel says in a file; empty where there is none."""
    try:
        return path.read_text().strip()
    except OSError:
        return ""


def judge_holder(
    cards: Sequence[PciCard], wanted: str, is_right: Callable[[str], bool], fix: str
) -> Problem:
    """Say which kernel driver holds NI's cards: only one of NI's own and comedi's can."""
    name, wanted = "card.kernel_driver", f"a card held by {wanted}"
    if not cards:
        found = "no card of NI's on the PCI bus (a card on USB is not listed there)"
        return report_check(name, "warning", found, wanted, NO_CARD_FIX)
    found = "; ".join(
        f"{card.slot} ({card.device_id}) is held by {card.driver or 'no driver'}" for card in cards
    )
    data = {"cards": [card._asdict() for card in cards]}
    if any(is_right(card.driver) for card in cards):
        return report_check(name, "ok", found, data=data)
    return report_check(name, "fault", found, wanted, fix, data)


def judge_parts(busy: Mapping[str, RigError], holders: str) -> Problem:
    """Say which parts of the card could not be taken; `holders` is the fix where all are held."""
    name = "card.reservations"
    if not busy:
        return report_check(name, "ok", "input, counter and output are free")
    found = "; ".join(describe_rig_error(error) for error in busy.values())
    return report_check(name, "fault", found, "free", holders, {"channels": sorted(busy)})


VoltRange = tuple[float, float]


def judge_input_range(
    section: str, requested: VoltRange, ranges: tuple[VoltRange, ...], request: ProbeRequest[Any]
) -> Problem:
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
        return report_check(name, "fault", found, wanted, fix)
    resolution_pa = (taken[1] - taken[0]) / 65536 * request.sensor_pa_per_v
    data = {"low_v": taken[0], "high_v": taken[1], "step_pa": resolution_pa}
    if not holds(requested, least) or not holds(taken, least):
        wanted = (
            f"at least {format_range(least)}; otherwise limits.pressure_pa and the sensor's wire "
            "are not watched"
        )
        fix = f"set {section}.input_low_v to -5 and {section}.input_high_v to 5"
        return report_check(name, "fault", found, wanted, fix, data)
    return report_check(name, "ok", f"{found}: {resolution_pa:.0f} Pa a code", data=data)


def holds(outer: VoltRange, inner: VoltRange) -> bool:
    """Return whether one range lies within another."""
    return outer[0] <= inner[0] and inner[1] <= outer[1]


def format_range(pair: VoltRange) -> str:
    """Return a range as text."""
    return f"{pair[0]:g} to {pair[1]:g} V"
