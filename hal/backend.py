"""A backend: one record that says all there is to know of one kind of rig.

A backend is found by the entry point group `pamctl.rigs`. A package adds one so:

    [project.entry-points."pamctl.rigs"]
    toy = "toy_rig:BACKEND"

The entry point's name is the backend's name: `--backend toy`, `backend: toy` in a rig file, and
the section `toy:` with its own settings. Nothing outside the record's folder names a backend.
Run the cases of `hal/rig_contract.py` over a new one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

from hal.calibration import CalibrationSettings, Configured, Output
from hal.entry_points import RIGS, find_rig_points
from hal.problem import Level, Problem
from hal.rig import Edge, Rig, RigError

S = TypeVar("S", bound=Configured)


class Plant(Protocol):
    """What lies behind the wires of a simulated rig. The caller supplies it."""

    def advance(self, command_v: float, duration_s: float) -> None:
        """Let time pass under a constant valve command (V)."""

    @property
    def position_m(self) -> float:
        """Displacement of what the encoder is fixed to."""

    @property
    def pressure_pa(self) -> float:
        """Absolute pressure that the sensor follows."""


@dataclass(frozen=True)
class RigRequest(Generic[S]):
    """What a backend is given to build a rig from."""

    settings: S
    """What stands under the backend's key in the rig file."""
    calibration: CalibrationSettings
    safe_volts: float
    """Analog output voltage at which the rig is safe."""
    rate_hz: float
    """Rate of the loop."""
    now_ns: Callable[[], int]
    """The computer's clock, for the times of samples."""
    plant: Plant
    """For a simulated rig; a real one leaves it alone."""
    seed: int = 0
    """Of simulated noise."""
    output_file: Path | None = None
    """Where a simulated output outlives its process; None: it lives within this one."""
    by_computer: bool = False
    """True: the caller paces by the computer's clock, even where the settings say otherwise."""


class BuiltRig(NamedTuple):
    """A rig, not yet opened, and what paces it."""

    rig: Rig
    await_edge: Callable[[], Edge] | None = None
    """Waits for the next edge of the device's sample clock; the next `read` returns its sample.

    It raises `RigError` where the device stops sampling. None: the computer's clock paces the
    loop. Given where `describe` names a `sample_clock`, and only there.
    """


@dataclass(frozen=True)
class ProbeRequest(Generic[S]):
    """What a device is checked against."""

    settings: S
    safe_volts: float
    rate_hz: float
    sensor_range_v: tuple[float, float]
    """Voltages of the pressure sensor that the limits of the rig file must be able to see."""
    sensor_pa_per_v: float


class DeviceProbe(NamedTuple, Generic[S]):
    """Checks of a device for `pamctl doctor`, done without `Rig`."""

    examine: Callable[[ProbeRequest[S]], Iterable[Problem]]
    """Looks at driver and device and moves nothing. Faults are findings, not exceptions."""
    required: frozenset[str] = frozenset()
    """Names of findings whose fault means that the rig cannot be opened."""
    examine_clock: Callable[[ProbeRequest[S]], Problem] | None = None
    """Tries the device's own sample clock with the safe voltage on the output."""
    examine_output: Callable[[ProbeRequest[S]], Iterable[Problem]] | None = None
    """Takes the output for a moment, and puts nothing but the safe voltage on it."""


class RigKeys(NamedTuple):
    """Keys of a rig file that hints name, such as `nidaq.terminal`; empty where there is none."""

    pressure_input: str = ""
    """The channel of the pressure sensor."""
    pressure_wiring: str = ""
    """How the sensor is grounded."""
    encoder_input: str = ""
    encoder_filter: str = ""
    valve_output: str = ""


NO_KEYS = RigKeys()


def require_nothing(settings: Configured) -> None:
    """Accept any settings: for a device that needs no driver."""


def accept_any_rate(settings: Configured, rate_hz: float) -> None:
    """Accept any rate of the loop."""


@dataclass(frozen=True, kw_only=True)
class Backend(Generic[S]):
    """The record of one kind of rig."""

    name: str
    """The entry point's name: a word of lower-case letters, digits and underscores."""
    description: str
    """One or two sentences for the schema of rig files."""
    settings: type[S]
    """Model of what stands under `name` in a rig file."""
    rig_file: str
    """What `--backend NAME` alone means: the path of a rig file, or the name of a shipped one."""
    safe_volts: float | None
    """Default of a rig file's `safe_volts`; None: the user must say what is safe."""
    device: Callable[[S], str]
    """Name of the device. A device serves one run at a time."""
    output: Callable[[S], Output]
    """The analog output as a write realises it: replay repeats it without the device."""
    build: Callable[[RigRequest[S]], BuiltRig]
    """Makes the rig; opens nothing."""
    require: Callable[[S], None] = require_nothing
    """Loads the driver; raises `RigError` with the fix where driver or device is missing."""
    check: Callable[[S, float], None] = accept_any_rate
    """Raises `ValueError` where settings and rate of the loop (Hz) contradict each other."""
    is_simulated: bool = False
    """True: the rig moves `RigRequest.plant`, may run without a clock, and takes `faults`."""
    keys: RigKeys = NO_KEYS
    probe: DeviceProbe[S] | None = None


class InstalledBackends(NamedTuple):
    """The backends of this installation."""

    found: Mapping[str, Backend[Any]]
    packages: Mapping[str, str]
    """Name and version of the package that a backend came with, by the backend's name."""
    failed: Mapping[str, str]
    """Why an entry point could not be used, by its name."""


_OTHER_KEYS = frozenset(
    {"backend", "safe_volts", "calibration", "limits", "homing", "loop", "faults"}
)
"""Keys of a rig file that are not a backend's own."""


@cache
def find_backends() -> InstalledBackends:
    """Load the records of all installed backends, the shipped ones first.

    A package that fails to load takes no other backend with it.
    """
    points = find_rig_points()
    loaded = {name: _try_record(name) for name in points}
    return InstalledBackends(
        found={name: one for name, one in loaded.items() if isinstance(one, Backend)},
        packages={
            name: f"{point.dist.name} {point.dist.version}"
            for name, point in points.items()
            if point.dist is not None
        },
        failed={name: one for name, one in loaded.items() if isinstance(one, str)},
    )


@cache
def _try_record(name: str) -> Backend[Any] | str:
    """Return the record of an entry point, or why it cannot be used."""
    point = find_rig_points()[name]
    try:
        return _load_record(point)
    # Whatever the package does wrong: the other backends must go on working.
    except Exception as error:
        return f"{point.value}: {type(error).__name__}: {error}"


def _load_record(point: EntryPoint) -> Backend[Any]:
    record = point.load()
    if not isinstance(record, Backend):
        raise TypeError(f"not a hal.backend.Backend but a {type(record).__name__}")
    if record.name != point.name:
        raise ValueError(f"the record calls itself '{record.name}', its entry point '{point.name}'")
    if not record.name.isidentifier() or record.name in _OTHER_KEYS:
        raise ValueError(f"'{record.name}' cannot be a key of its own in a rig file")
    return record


def get_backend(name: str) -> Backend[Any]:
    """Return the record of an installed backend; raise `RigError` where it is not installed.

    No other backend is loaded: a guardian needs its own alone.
    """
    record = _try_record(name) if name in find_rig_points() else ""
    if isinstance(record, Backend):
        return record
    raise RigError(f"there is no backend '{name}'", fix=hint_at_missing(name))


def hint_at_missing(name: str) -> str:
    """Say why a backend may be unknown here."""
    installed = find_backends()
    if name in installed.failed:
        package = installed.packages.get(name, "its package")
        return f"{package} does not load: {installed.failed[name]}"
    return f"if a package provides '{name}', install it (its entry point is in the group {RIGS})"


def report_check(
    name: str,
    level: Level,
    found: str,
    wanted: str = "",
    fix: str = "",
    data: Mapping[str, object] | None = None,
) -> Problem:
    """Return a check of `pamctl doctor` and its result; `name` is stable between versions."""
    return Problem("", name, found, level, wanted, fix, data or {})


def report_rig_error(name: str, error: RigError, wanted: str) -> Problem:
    """Return a check that ended in an error of the device, with the fix that the error names."""
    return report_check(name, "fault", describe_rig_error(error), wanted, error.fix)


def describe_rig_error(error: RigError) -> str:
    """Return what the device reports, with its error number and without the fix."""
    return error.what if error.code is None else f"{error.what} (device error {error.code})"
