"""Find, load and call machine code that `emit.py` has built: the loop's side, without numba."""

from __future__ import annotations

import ctypes
import hashlib
import os
import sys
import weakref
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from shutil import which
from types import ModuleType
from typing import Any

from pamctl.code_folder.find_code_folder import find_code_folder

_ROOT = Path(__file__).parents[2]
_SOURCES = (
    "hal/*.py",
    "hal/sim/*.py",
    "pamctl/*.py",
    "pamctl/compensation/*.py",
    "pamctl/compiled_ahead/*.py",
    "pamctl/control/**/*.py",
    "pamctl/plant/**/*.py",
    "pamctl/realtime/*.py",
    "pamctl/simulate/*.py",
)
"""All that a kernel of the tick or of the simulation can be made of."""
SYMBOL = "pamctl_kernel"
FORBIDDEN = "PAMCTL_NO_BUILD"
"""Environment variable: where it is set, nothing is built."""


class KernelLibrary:
    """The one function of a library. It takes pointers, and returns whether it went through."""

    def __init__(self, path: Path) -> None:
        """Load it; raise OSError where it cannot be."""
        weakref.finalize(self, os.close, hold_library(path))
        # ctypes calls it without the arguments' conversion: they are pointers already.
        self._function = getattr(ctypes.CDLL(str(path)), SYMBOL)
        self._function.restype = ctypes.c_int
        # numba's convention: the result's place, the exception's place, then the arguments.
        self._result = ctypes.c_void_p()
        self._exception = ctypes.c_void_p()

    def bind(self, *buffers: bytearray) -> tuple[Any, list[Any]]:
        """Return a function and its arguments, which run the kernel on these buffers.

        The function returns 0, or another number where plain Python would raise. The arguments
        keep the buffers where they are.
        """
        held = [(ctypes.c_char * len(buffer)).from_buffer(buffer) for buffer in buffers]
        return self._function, [*map(ctypes.pointer, (self._result, self._exception, *held))]

    def run(self, *addresses: int) -> bool:
        """Run the kernel on buffers at these addresses; return whether it went through."""
        places = map(ctypes.c_void_p, addresses)
        result, exception = ctypes.byref(self._result), ctypes.byref(self._exception)
        return not self._function(result, exception, *places)


def hold_library(path: Path) -> int:
    """Open a library, so that nobody removes it before this descriptor is closed.

    Raise OSError where it cannot be opened, or files cannot be locked, as on Windows.
    """
    try:
        import fcntl
    except ImportError as error:
        raise OSError("this system has no file locks; machine code is for Linux") from error

    held = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    fcntl.flock(held, fcntl.LOCK_SH)
    return held


def find_linker() -> str | None:
    """Return a program that links object files; None where there is none."""
    return next(filter(None, map(which, ("cc", "gcc", "clang"))), None)


def find_library_path(name: str, *parts: str) -> Path:
    """Return where the library of a kernel is, or will be, for this source on this machine.

    `parts` are texts that the machine code depends on beside the sources of pamctl.
    """
    digest = hashlib.sha256(_hash_house().encode())
    for part in parts:
        digest.update(part.encode() + b"\0")
    return find_code_folder() / "ahead" / f"{name}-{digest.hexdigest()[:20]}.so"


def hash_module(module: ModuleType) -> str:
    """Hash the sources of a module's package; a module that stands alone is hashed alone."""
    if module.__name__.partition(".")[0] in ("pamctl", "hal"):
        return ""  # `find_library_path` has them
    top = sys.modules[module.__name__.partition(".")[0]]
    places = [Path(place) for place in getattr(top, "__path__", ())]
    files = [file for place in places for file in sorted(place.rglob("*.py"))]
    return _hash_files(files or [Path(str(module.__file__))])


@cache
def _hash_house() -> str:
    files = sorted({file for pattern in _SOURCES for file in _ROOT.glob(pattern)})
    versions = [sys.version, *(_find_version(name) for name in ("numba", "llvmlite"))]
    return "\n".join([_hash_files(files), *versions, _describe_processor()])


def _hash_files(files: list[Path]) -> str:
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def _find_version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _describe_processor() -> str:
    """Return model and features: a home directory may be shared by different computers."""
    try:
        lines = Path("/proc/cpuinfo").read_text().partition("\n\n")[0].splitlines()
    except OSError:
        return os.uname().machine
    wanted = ("model name", "flags", "Features", "CPU part")
    return "\n".join(line for line in lines if line.startswith(wanted))
