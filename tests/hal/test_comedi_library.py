"""The backend on comedi against the real libcomedi, C's own numbers, and whole runs of `pamctl`."""

import ctypes
import errno
import json
import os
import random
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from standin.standin import COMEDI_SONAME, HERE, KERNEL_SONAME, Card, library, require_compiler
from support.command_line import run_process, start_process
from support.installing import alone, apt_install
from support.patience import BUSY_PC, PATIENCE_S
from support.processes.card_runs import await_writes
from support.processes.children import await_children
from support.runs import AO_STEP_V

from hal.comedi import libcomedi
from pamctl.log.reader import read
from pamctl.processes.backends import SHARED_MEMORY
from pamctl.signals import Phase

DRIVE = """
import json, sys, time
from hal.comedi.comedi_rig import ComediRig
from hal.comedi.comedi_backend import ComediSettings
from hal.rig import RigError, open_rig

settings = ComediSettings(calibration_file=sys.argv[1])
rig, second = (ComediRig(settings, safe_output_v=1.25) for _ in range(2))
with open_rig(rig):
    told = {"extra": rig.describe().extra, "vented_v": rig.read().pressure_v}
    told["applied_v"] = rig.write(7.0)
    time.sleep(0.3)
    told["counts"] = rig.read().encoder_counts
    try:
        second.open()
    except RigError as error:
        told["refused"] = error.code
    second.make_safe()
    told["left_to_the_owner"] = second.safe_failure.code
try:
    ComediRig(ComediSettings(), safe_output_v=1.25).open()
except RigError as error:
    told["uncalibrated"] = str(error)
print(json.dumps(told))
"""


def has_libcomedi() -> bool:
    loads = f"import ctypes; ctypes.CDLL({libcomedi.SONAME!r})"
    done = subprocess.run([sys.executable, "-c", loads], capture_output=True, timeout=60)
    return done.returncode == 0


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """What lets a process drive a card of its own through the real library."""
    if not has_libcomedi():
        with alone():
            apt_install("libcomedi0")
    if not has_libcomedi():
        pytest.skip("no libcomedi on this computer: apt install libcomedi0")
    require_compiler()
    card = Card(tmp_path / "registers", "comedi0")
    card.registers.ai_gain, card.registers.ao_gain = 0.95, 0.98
    card.calibrate()
    return {
        **os.environ,
        "LD_PRELOAD": str(library(KERNEL_SONAME)),
        "STANDIN_DEVICE": str(card.path),
        "PAMCTL_PERMIT_STAND_IN": "1",
        "PYTHONPATH": os.pathsep.join(sys.path),
    }


def test_the_rig_works_through_the_real_library(environment, tmp_path):
    done = run_process(
        [sys.executable, "-c", DRIVE, str(tmp_path / "registers.calibration")], env=environment
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout.splitlines()[-1])
    extra = told["extra"]
    assert Path(extra["library"]).parent != library(KERNEL_SONAME).parent
    assert (extra["driver_name"], extra["product_type"]) == ("stand_in", "pci-6221")
    assert extra["driver_version"] == "0.7.76"
    assert extra["reads_in_one_call"]
    assert extra["input_volts_coefficients"][1] == pytest.approx(10.0 / 65536.0 / 0.95)
    assert extra["output_code_coefficients"][1] == pytest.approx(65536.0 / 20.0 / 0.98)
    assert told["vented_v"] == pytest.approx(0.215, abs=3e-4)
    assert told["applied_v"] == pytest.approx(7.0, abs=3e-4)
    assert told["counts"] > 1000
    assert told["refused"] == errno.EBUSY
    assert told["left_to_the_owner"] == errno.EACCES
    assert "/var/lib/comedi/calibrations/stand_in_pci-6221_comedi0" in told["uncalibrated"]


# --- numbers and signatures ----------------------------------------------------------------------

HEADER = Path("/usr/include/linux/comedi.h")
"""The kernel's public header: package linux-libc-dev, which the C library's own headers need."""

OTHER_NAMES = {
    "NI_PFI_FILTER_125NS": "NI_PFI_FILTER_125ns",
    "NI_PFI_FILTER_6425NS": "NI_PFI_FILTER_6425ns",
    "UNIT_VOLT": "UNIT_volt",
    **{f"SUBD_{kind}": f"COMEDI_SUBD_{kind}" for kind in ("AI", "AO", "DIO", "COUNTER")},
}
IN_COMEDILIB = {"TO_PHYSICAL": 0, "FROM_PHYSICAL": 1}
"""`enum comedi_conversion_direction` of comedilib.h 0.11: not the kernel's."""


def numbers() -> dict[str, int]:
    """Return the constants of the backend by their names in C."""
    own = {name: value for name, value in vars(libcomedi).items() if type(value) is int}
    return {OTHER_NAMES.get(name, name): value for name, value in own.items()}


def compute(tmp_path: Path, expressions: list[str]) -> list[int]:
    """Let a C program that includes the kernel's header compute expressions."""
    require_compiler()
    if not HEADER.exists():
        with alone():
            apt_install("linux-libc-dev")
    if not HEADER.exists():
        pytest.skip(f"no {HEADER}: apt install linux-libc-dev")
    lines = "".join(f'    printf("%lld\\n", (long long)({one}));\n' for one in expressions)
    source = tmp_path / "numbers.c"
    source.write_text(
        "#include <linux/comedi.h>\n#include <stddef.h>\n#include <stdio.h>\n"
        f"int main(void)\n{{\n{lines}    return 0;\n}}\n"
    )
    program = tmp_path / "numbers"
    subprocess.run(["gcc", "-o", str(program), str(source)], check=True, timeout=60)
    told = run_process([str(program)], check=True)
    return [int(line) for line in told.stdout.split()]


def test_the_constants_are_those_of_the_kernel_s_header(tmp_path):
    own = {name: value for name, value in numbers().items() if name not in IN_COMEDILIB}
    assert len(own) > 30
    assert dict(zip(own, compute(tmp_path, list(own)), strict=True)) == own
    assert {name: numbers()[name] for name in IN_COMEDILIB} == IN_COMEDILIB


def test_channels_and_lines_are_packed_as_the_kernel_s_header_packs_them(tmp_path):
    packed = [(0, 0, 0), (15, 3, 2), (79, 255, 1), (2, 1, 3)]
    assert compute(tmp_path, [f"CR_PACK({c}, {r}, {a})" for c, r, a in packed]) == [
        libcomedi.pack_channel(*one) for one in packed
    ]
    assert compute(tmp_path, [f"NI_GPCT_PFI_OTHER_SELECT({line})" for line in range(16)]) == [
        libcomedi.select_pfi(line) for line in range(16)
    ]


@pytest.mark.parametrize(
    ("structure", "name"),
    [(libcomedi.ComediInsn, "comedi_insn"), (libcomedi.ComediInsnList, "comedi_insnlist")],
)
def test_the_structures_are_laid_out_as_the_kernel_s(structure, name, tmp_path):
    fields = [field for field, _ in structure._fields_]  # type: ignore[misc]
    asked = [f"offsetof(struct {name}, {field})" for field in fields]
    told = compute(tmp_path, [f"sizeof(struct {name})", *asked])
    assert told == [ctypes.sizeof(structure), *(getattr(structure, f).offset for f in fields)]


C_TYPES = {
    "void": None,
    "int": ctypes.c_int,
    "enum comedi_conversion_direction": ctypes.c_int,
    "unsigned": ctypes.c_uint,
    "unsigned int": ctypes.c_uint,
    "lsampl_t": ctypes.c_uint,
    "char *": ctypes.c_char_p,
    "comedi_t *": ctypes.c_void_p,
    "comedi_calibration_t *": ctypes.c_void_p,
    "comedi_insn *": ctypes.POINTER(libcomedi.ComediInsn),
    "comedi_insnlist *": ctypes.POINTER(libcomedi.ComediInsnList),
    "comedi_range *": ctypes.POINTER(libcomedi.ComediRange),
    "comedi_polynomial_t *": ctypes.POINTER(libcomedi.ComediPolynomial),
}


def read_type(declared: str) -> object:
    """Return the ctypes type of a declaration such as `const char *path`."""
    kind = re.sub(r"\bconst\b", "", declared).strip()
    return C_TYPES[re.sub(r"\s+", " ", kind).strip()]


def test_the_signatures_are_those_of_the_stand_in():
    """And the stand-in's are those of comedilib.h 0.11.0, compared by hand on 2026-11-22."""
    source = (HERE / "comedi.c").read_text()
    prototypes = re.findall(r"EXPORT ([\w ]+?[ *]+)(comedi_\w+)\(([^)]*)\)\n{", source)
    declared = {}
    for result, name, arguments in prototypes:
        types = [re.sub(r"\w+$", "", one) for one in arguments.split(",") if one != "void"]
        declared[name] = (read_type(result), *map(read_type, types))
    # The one string that the caller frees.
    declared["comedi_get_default_calibration_path"] = (ctypes.c_void_p, ctypes.c_void_p)
    assert declared == dict(libcomedi.SIGNATURES)


# --- runs of pamctl over the stand-in ------------------------------------------------------------

PAMCTL = str(Path(sys.executable).with_name("pamctl"))
SAFE_V = 0.625
safe = pytest.approx(SAFE_V, abs=AO_STEP_V)


@pytest.fixture
def own(tmp_path: Path) -> Iterator[Card]:
    """A card that this process does not drive, of its own name; its output was left at 8 V."""
    require_compiler()
    (tmp_path / "cwd").mkdir()
    own = Card(tmp_path / "registers", f"comedi{os.getpid()}{random.randrange(10**6)}")
    own.registers.ao_v[0] = 8.0
    yield own
    (SHARED_MEMORY / f"pamctl-{own.name}.lock").unlink(missing_ok=True)


def start(own: Card, *command: str, **environment: str | None) -> subprocess.Popen[str]:
    """Start a verb of pamctl on the card; an environment variable that is None is taken away."""
    options = [
        f"rig.comedi.device=/dev/{own.name}",
        f"rig.safe_volts={SAFE_V}",
        "rig.homing.enabled=false",
        *BUSY_PC,
    ]
    changed = {**own.environment(), **environment}
    return start_process(
        [PAMCTL, *command, "--backend", "comedi", *(p for one in options for p in ("--set", one))],
        cwd=own.path.parent / "cwd",
        env={name: value for name, value in changed.items() if value is not None},
    )


RUN = ("run", "--quiet", "--log", "run.mcap")


@pytest.mark.long
def test_a_run_is_complete_ends_at_the_safe_voltage_and_replays_to_the_bit(own):
    process = start(own, *RUN, "--duration", "1", "--json", LC_ALL="C")
    said, complaints = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, complaints
    report = json.loads(said)
    assert report["log_is_whole"]
    assert report["backend"] == "comedi"
    assert own.written_v[-1] == own.output_v == safe
    log = read(own.path.parent / "cwd" / "run.mcap")
    assert log["phase"][-1] == Phase.STOPPING
    identity = log.metadata["rig"]
    assert identity["library"] == str(library(COMEDI_SONAME))
    assert identity["calibrated_by"] == str(own.calibration_path)
    assert identity["reads_in_one_call"]

    # On a PC without the library and without the card.
    replayed = run_process([PAMCTL, "replay", "run.mcap"], cwd=own.path.parent / "cwd")
    assert replayed.returncode == 0, replayed.stderr
    assert "equal" in replayed.stdout


def test_when_the_loop_dies_the_guardian_takes_the_card_over(own):
    process = start(own, *RUN)
    await_writes(own, process, 700)
    os.kill(await_children(process.pid, "loop_main")["loop_main"], signal.SIGKILL)
    _, complaints = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert "the guardian drove the safe voltage" in complaints
    assert own.output_v == safe


def test_a_run_without_its_card_leaves_with_69_and_says_what_to_do(own):
    process = start(own, *RUN, STANDIN_DEVICE=None)
    said, complaints = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 69, said
    assert "modprobe ni_pcimio" in complaints
    assert "Traceback" not in complaints
    assert not (own.path.parent / "cwd" / "run.mcap").exists()


def test_safe_drives_the_safe_voltage_whatever_was_left_on_the_output(own):
    process = start(own, "safe")
    _, complaints = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, complaints
    assert own.output_v == safe
