"""The numbers and signatures of `hal/comedi/libcomedi.py` against those of C."""

from __future__ import annotations

import ctypes
import re
import subprocess
from pathlib import Path

import pytest
from standin.standin import HERE, require_compiler
from support.command_line import run_process
from support.installing import alone, apt_install

from hal.comedi import libcomedi

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


def test_the_constants_are_those_of_the_kernel_s_header(tmp_path: Path) -> None:
    own = {name: value for name, value in numbers().items() if name not in IN_COMEDILIB}
    assert len(own) > 30
    assert dict(zip(own, compute(tmp_path, list(own)), strict=True)) == own
    assert {name: numbers()[name] for name in IN_COMEDILIB} == IN_COMEDILIB


def test_channels_and_lines_are_packed_as_the_kernel_s_header_packs_them(tmp_path: Path) -> None:
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
def test_the_structures_are_laid_out_as_the_kernel_s(
    structure: type[ctypes.Structure], name: str, tmp_path: Path
) -> None:
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


def test_the_signatures_are_those_of_the_stand_in() -> None:
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
