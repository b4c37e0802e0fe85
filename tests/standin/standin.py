"""The stand-in card from Python: build its driver, look at its registers, break it.

The drivers are C: `daqmx.c` is NI's, so that the unmodified nidaqmx package runs over it,
`comedi.c` is libcomedi, and `comedi_kernel.c` is the kernel below the real libcomedi. The card's
registers lie in a file; every process that is to see the card names it in `STANDIN_DEVICE`.
"""

from __future__ import annotations

import atexit
import ctypes
import hashlib
import mmap
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

import pytest
from support.installing import alone, apt_install

HERE = Path(__file__).parent
SONAME = "libnidaqmx.so.1"
COMEDI_SONAME = "libcomedi.so.0"
KERNEL_SONAME = "libcomedikernel.so.0"
"""Preloaded below the real libcomedi, this one is the kernel."""
_DRIVERS = {SONAME: "daqmx.c", COMEDI_SONAME: "comedi.c", KERNEL_SONAME: "comedi_kernel.c"}
PERMIT = "PAMCTL_PERMIT_STAND_IN"
"""Set by tests, and by nobody else: without it `pamctl` refuses this card."""

PCI, USB = 12582, 12586

_HISTORY = 64
_FOREVER = 1 << 62


# --- the registers: the mirror of `Registers` in device.h --------------------------------


class Plant(ctypes.Structure):
    _fields_ = [(name, ctypes.c_double) for name in ("position_m", "velocity", "pressure_pa")]


class Owner(ctypes.Structure):
    _fields_ = [(name, ctypes.c_int64) for name in ("pid", "born", "task")]


class Fault(ctypes.Structure):
    _fields_ = [
        ("function", ctypes.c_char * 48),
        ("code", ctypes.c_int64),
        ("after", ctypes.c_int64),
        ("times", ctypes.c_int64),
        ("hang_s", ctypes.c_double),
        ("is_deaf", ctypes.c_int64),
    ]


class Registers(ctypes.Structure):
    _fields_ = [
        ("size", ctypes.c_int64),
        ("name", ctypes.c_char * 40),
        ("is_virtual", ctypes.c_int64),
        ("virtual_ns", ctypes.c_int64),
        ("plant_ns", ctypes.c_int64),
        ("plant", Plant),
        ("ao_v", ctypes.c_double * 2),
        ("ao_ns", ctypes.c_int64),
        ("ao_writes", ctypes.c_int64),
        ("ao_history_v", ctypes.c_double * _HISTORY),
        ("ao_history_ns", ctypes.c_int64 * _HISTORY),
        ("ao_glitch_v", ctypes.c_double),
        ("ao_glitch_ns", ctypes.c_int64),
        ("loopback_ai", ctypes.c_int64),
        ("driver_offset_v", ctypes.c_double),
        ("driver_gain", ctypes.c_double),
        ("sensor_zero_v", ctypes.c_double),
        ("sensor_pa_per_v", ctypes.c_double),
        ("noise_v", ctypes.c_double),
        ("noise_state", ctypes.c_int64),
        ("wire_is_broken", ctypes.c_int64),
        ("pull_down_is_missing", ctypes.c_int64),
        ("open_drift_v_per_s", ctypes.c_double),
        ("open_v", ctypes.c_double),
        ("open_ns", ctypes.c_int64),
        ("ai_terminal", ctypes.c_int64),
        ("ai_full_scale_v", ctypes.c_double),
        ("encoder_m_per_edge", ctypes.c_double),
        ("encoder_phase_edges", ctypes.c_double),
        ("encoder_sign", ctypes.c_int64),
        ("encoder_is_unplugged", ctypes.c_int64),
        ("encoder_edges", ctypes.c_int64),
        ("counter", ctypes.c_int64),
        ("counter_runs", ctypes.c_int64),
        ("counter_edges_per_count", ctypes.c_int64),
        ("counter_filter_s", ctypes.c_double),
        ("counter_z_resets", ctypes.c_int64),
        ("ticks_are_unsigned", ctypes.c_int64),
        ("counter_maxdata", ctypes.c_int64),
        ("encoder_pfi", ctypes.c_int64 * 2),
        ("has_37_pins", ctypes.c_int64),
        ("ai_gain", ctypes.c_double),
        ("ai_offset_v", ctypes.c_double),
        ("ao_gain", ctypes.c_double),
        ("ao_offset_v", ctypes.c_double),
        ("is_gone", ctypes.c_int64),
        ("bus", ctypes.c_int64),
        ("valve_is_stuck", ctypes.c_int64),
        ("valve_stuck_v", ctypes.c_double),
        ("clock_runs", ctypes.c_int64),
        ("clock_start_ns", ctypes.c_int64),
        ("clock_period_ns", ctypes.c_int64),
        ("clock_edges", ctypes.c_int64),
        ("clock_read", ctypes.c_int64),
        ("sampled_v", ctypes.c_double),
        ("sampled_count", ctypes.c_int64),
        ("ao_is_pending", ctypes.c_int64 * 2),
        ("ao_pending_v", ctypes.c_double * 2),
        ("clock_skips", ctypes.c_int64),
        ("ai_wait_mode", ctypes.c_int64),
        ("transfer_is_fixed", ctypes.c_int64),
        ("late_code", ctypes.c_int64),
        ("moves", ctypes.c_int64),
        ("move", ctypes.c_int64 * _HISTORY),
        ("keeps_dead_owners", ctypes.c_int64),
        ("owners", Owner * 5),
        ("faults", Fault * 8),
        ("mutex_is_ready", ctypes.c_int64),
        ("mutex", ctypes.c_int64 * 5),
    ]


_POWER_UP = {
    "size": ctypes.sizeof(Registers),
    "driver_offset_v": 5.0,
    "driver_gain": 1.0,
    "sensor_zero_v": 0.215,
    "sensor_pa_per_v": 1.0 / (5.0 * 1.2858e-6),
    "noise_state": 88172645463325252,
    "encoder_m_per_edge": 25.4e-3 / 8000.0,
    "encoder_phase_edges": 0.4,
    "encoder_sign": 1,
    "counter_edges_per_count": 1,
    "counter_maxdata": 0xFFFFFFFF,
    "encoder_pfi": (8, 10),
    "ai_gain": 1.0,
    "ao_gain": 1.0,
    "bus": PCI,
}
"""What is not zero when the computer is switched on; the sensors are the sim rig's."""


_INPUT_RANGES_V = (10.0, 5.0, 1.0, 0.2)

# The form that comedi_soft_calibrate writes.
_CALIBRATION = """{{
    driver_name => "ni_pcimio",
    board_name => "pci-6221",
    calibrations =>
    [{}
    ]
}}
"""
_SETTING = """
        {{
            subdevice => {},
            channels => [],
            ranges => [{}],
            arefs => [],
            caldacs => [],{}
        }},"""
_LINE = """
            softcal_{}_phys =>
            {{
                expansion_origin => {!r},
                coefficients => [{!r}, {!r}]
            }}"""


class Card:
    """One card in the computer."""

    def __init__(self, path: Path, name: str = "Dev1") -> None:
        """A process that drives it locks `name`: cards side by side need one each."""
        self.path = path
        self.name = name
        path.write_bytes(bytes(ctypes.sizeof(Registers)))
        with path.open("r+b") as file:
            self._map = mmap.mmap(file.fileno(), ctypes.sizeof(Registers))
        self.registers = Registers.from_buffer(self._map)
        self.power_up()
        self.calibrate()

    def power_up(self) -> None:
        """Switch the computer off and on; only the mutex stays as it is."""
        until_mutex = Registers.mutex_is_ready.offset
        ctypes.memset(ctypes.addressof(self.registers), 0, until_mutex)
        for register, value in _POWER_UP.items():
            setattr(self.registers, register, value)
        self.registers.name = self.name.encode()
        self.registers.plant.pressure_pa = 101.3e3

    @property
    def output_v(self) -> float:
        """What a voltmeter on AO 0 shows."""
        return float(self.registers.ao_v[0])

    @property
    def output_at_next_edge_v(self) -> float:
        """What it will show after the next edge of the sample clock."""
        pending = self.registers.ao_is_pending[0]
        return float(self.registers.ao_pending_v[0]) if pending else self.output_v

    @property
    def written_v(self) -> list[float]:
        """The last voltages written to any output, oldest first."""
        writes = self.registers.ao_writes
        first = max(0, writes - _HISTORY)
        return [self.registers.ao_history_v[n % _HISTORY] for n in range(first, writes)]

    @property
    def task_moves(self) -> list[str]:
        """Starts (+) and stops (-) of tasks, oldest first, by what they use."""
        names = ("ai", "ao0", "ao1", "ctr0", "ctr1")
        moves = self.registers.moves
        last = (self.registers.move[n % _HISTORY] for n in range(max(0, moves - _HISTORY), moves))
        return [("+" if move > 0 else "-") + names[abs(move) - 1] for move in last]

    def now_ns(self) -> int:
        """The time of a card whose time stands still, as `set_time_ns` has it."""
        return int(self.registers.virtual_ns) - 1

    def stop_time(self) -> None:
        """Let time stand still but for `set_time_ns`."""
        self.registers.is_virtual = 1
        self.registers.virtual_ns = 1

    def set_time_ns(self, now_ns: int) -> None:
        """Move the time that stands still; it begins at 1 ns."""
        self.registers.virtual_ns = now_ns + 1

    def fail(
        self,
        function: str,
        code: int = 0,
        *,
        after: int = 0,
        times: int = _FOREVER,
        hang_s: float = 0.0,
        is_deaf: bool = False,
    ) -> None:
        """Let `times` calls of a driver function go wrong, once `after` have gone right.

        A positive code is a warning. A call that hangs longer than its timeout returns
        -200284, unless it is deaf to it.
        """
        fault = next(fault for fault in self.registers.faults if fault.times == 0)
        fault.function = function.encode()
        fault.code, fault.after = code, after
        fault.hang_s, fault.is_deaf = hang_s, is_deaf
        fault.times = times  # last: it arms the fault

    def mend(self) -> None:
        """Take every fault away."""
        for fault in self.registers.faults:
            fault.times = 0

    @property
    def calibration_path(self) -> Path:
        """Where libcomedi looks for this card's calibration."""
        return Path(f"{self.path}.calibration")

    def calibrate(self, *, inputs: bool = True, outputs: bool = True) -> None:
        """Write the calibration that undoes the card's own gains and offsets, as comedi's tool."""
        r, settings = self.registers, []
        for number, full_scale_v in enumerate(_INPUT_RANGES_V if inputs else ()):
            step_v = 2.0 * full_scale_v / 65536.0
            zero = 32768.0 + r.ai_offset_v / step_v
            line = _LINE.format("to", zero, 0.0, step_v / r.ai_gain)
            settings.append(_SETTING.format(0, number, line))
        if outputs:
            codes_per_v = 65536.0 / 20.0 / r.ao_gain
            line = _LINE.format("from", r.ao_offset_v, 32768.0, codes_per_v)
            settings.append(_SETTING.format(1, 0, line))
        self.calibration_path.write_text(_CALIBRATION.format("".join(settings)))

    def environment(self) -> Mapping[str, str]:
        """What a process needs in its environment to find the driver and this card."""
        search = os.pathsep.join([str(library().parent), os.environ.get("LD_LIBRARY_PATH", "")])
        return {
            **os.environ,
            "LD_LIBRARY_PATH": search.rstrip(os.pathsep),
            "STANDIN_DEVICE": str(self.path),
            PERMIT: "1",
        }


# --- the driver --------------------------------------------------------------------------


def library(soname: str = SONAME) -> Path:
    """Build the drivers, or find them built from the same sources; return the path of one."""
    source = b"".join(path.read_bytes() for path in sorted(HERE.glob("*.[ch]")))
    digest = hashlib.sha256(source).hexdigest()[:16]
    directory = Path(tempfile.gettempdir()) / f"pamctl-standin-{os.getuid()}-{digest}"
    built = directory / soname
    if not built.exists():
        directory.mkdir(mode=0o700, exist_ok=True)
        for name in _DRIVERS:
            _compile(directory, name)
    return built


def _compile(directory: Path, soname: str) -> None:
    with tempfile.TemporaryDirectory(dir=directory) as scratch:
        fresh = Path(scratch) / soname
        options = ["-O2", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-fvisibility=hidden"]
        shared = ["-shared", "-fPIC", f"-Wl,-soname,{soname}", "-o", str(fresh)]
        sources = [str(HERE / name) for name in (_DRIVERS[soname], "device.c", "plant.c")]
        subprocess.run(
            ["gcc", *options, *shared, *sources, "-lm", "-lpthread", "-ldl"],
            check=True,
            timeout=120,
        )
        with suppress(FileExistsError):
            (directory / soname.rpartition(".")[0]).symlink_to(soname)
        fresh.rename(directory / soname)  # whole or not at all


def require_compiler() -> None:
    """Skip the test where there is no gcc; in CI get one, or fail."""
    if not shutil.which("gcc"):
        with alone():
            if not shutil.which("gcc"):
                apt_install("gcc", "libc6-dev")
    if not shutil.which("gcc"):
        missing = "the stand-in driver needs gcc: apt install gcc libc6-dev"
        if os.environ.get("CI") == "true":
            pytest.fail(missing)
        pytest.skip(missing)


@contextmanager
def permit() -> Iterator[None]:
    """Permit the card to `pamctl` in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(PERMIT, "1")
        yield


@cache
def here() -> Card:
    """Return the card of this very process; its driver is loaded once.

    The nidaqmx package asks `ctypes.util.find_library`, whose linker uses the present
    LD_LIBRARY_PATH. The loader uses its value at the start of the process, but finds a loaded
    library by its soname. Afterwards the environment is as before: other tests count on a
    computer without a driver.
    """
    require_compiler()
    directory = Path(tempfile.mkdtemp(prefix="pamctl-card-"))
    atexit.register(shutil.rmtree, directory, ignore_errors=True)
    card = Card(directory / "registers")
    ctypes.CDLL(str(library()), ctypes.RTLD_GLOBAL)
    before = dict(os.environ)
    os.environ.update(card.environment())
    try:
        from nidaqmx.system import System

        assert [device.name for device in System.local().devices] == ["Dev1"]
    finally:
        os.environ.clear()
        os.environ.update(before)
    return card


@cache
def here_behind_comedi() -> Card:
    """Return the card of this very process behind libcomedi, which is loaded once.

    The product loads the library by its soname, and the loader knows it from here on. Only the
    registers' place is read from the environment, at the first access.
    """
    require_compiler()
    directory = Path(tempfile.mkdtemp(prefix="pamctl-card-"))
    atexit.register(shutil.rmtree, directory, ignore_errors=True)
    card = Card(directory / "registers", "comedi0")
    driver = ctypes.CDLL(str(library(COMEDI_SONAME)), ctypes.RTLD_GLOBAL)
    before = os.environ.get("STANDIN_DEVICE")
    os.environ["STANDIN_DEVICE"] = str(card.path)
    try:
        assert not driver.comedi_open(b"/dev/none")
    finally:
        if before is None:
            del os.environ["STANDIN_DEVICE"]
        else:
            os.environ["STANDIN_DEVICE"] = before
    return card
