"""Build machine code of C source, once for a user, and load it.

A library's name holds the digest of all that it was made of: the sources of pamctl, the compiler,
and the types of the arguments. It appears whole or not at all. Two processes that need the same one
build it once. Libraries of other sources are removed when they have not been used for long.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

# What only a build needs is imported there: most processes load what is built.

_ROOT = Path(__file__).parents[2]
_SOURCES = (
    "hal",
    "pamctl/kernel",
    "pamctl/plant",
    "pamctl/control",
    "pamctl/realtime",
    "pamctl/offline",
)
"""All that a kernel of pamctl can be made of, beside the files in `pamctl` itself."""
_FLAGS = (
    "-O2", "-std=gnu11", "-w", "-fPIC", "-shared", "-fvisibility=hidden",
    # The bits of Python: no fused operations, and no function computed by the compiler.
    "-ffp-contract=off", "-fno-builtin", "-fno-math-errno", "-fno-sanitize=undefined",
    # States are small structs: keep them in registers, call by call, and never copy two numbers at
    # once, as the next one to read a single number would have to wait.
    "-fno-tree-vectorize", "--param=sra-max-scalarization-size-Ospeed=512",
    "--param=max-inline-insns-single=150",
)  # fmt: skip
PLAIN = "PAMCTL_PLAIN_PYTHON"
"""Environment variable: where it is set, there is no machine code."""
_TOLD = "PAMCTL_TOLD_"
"""Begins variables that are set for child processes: the user knows."""
_REMEDY = (
    "machine code needs a C compiler: install gcc (Debian: apt install gcc), "
    "or the Python package ziglang (pip install ziglang)"
)
KEPT = 8
"""Folders of machine code that stay: a user may change between some versions."""
LONGEST_BUILD_S = 120.0


class Progress:
    """What a user who waits may want to know."""

    builds = False
    """Machine code is built now, or was: some seconds."""

    begin: Callable[[], None] = staticmethod(lambda: None)
    """What is done when the first build begins: a verb may tell its user."""


progress = Progress()


class CannotBuild(Exception):
    """There is no machine code. The message says why, and what helps."""


def load_function(name: str, parts: tuple[str, ...], write: Callable[[], str]) -> Any:
    """Return the C function `run` of a library; build it where it is missing.

    `parts` are the texts that tell it from others of the same sources, `write` returns its source.
    Raise `CannotBuild`.
    """
    if os.environ.get(PLAIN):
        raise CannotBuild(f"{PLAIN} is set")
    if ctypes.sizeof(ctypes.c_void_p) != 8:
        raise CannotBuild("this is a system of 32 bits")
    folder = _find_folder()
    digest = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:20]
    path = folder / f"{name}-{digest}{'.dll' if sys.platform == 'win32' else '.so'}"
    function = _load(path)
    if function is None:
        _build_once(path, write)
        function = _load(path)
    if function is None:
        raise CannotBuild(f"{path} cannot be loaded")
    return function


def _load(path: Path) -> Any:
    """Return the function of a library; None if there is none, or if it is damaged."""
    try:
        function = ctypes.CDLL(str(path)).run
    except (OSError, AttributeError):
        return None
    function.restype = ctypes.c_int
    function.argtypes = (ctypes.c_void_p,)
    return function


def tell_plain(error: CannotBuild) -> None:
    """Tell the user once why Python computes itself."""
    if not os.environ.get(PLAIN):
        _tell_once("PLAIN_PYTHON", f"plain Python computes, slowly: {error}")


def _tell_once(about: str, text: str) -> None:
    """Tell the user something, once in this process and its children."""
    if not os.environ.get(_TOLD + about):
        os.environ[_TOLD + about] = "1"
        with suppress(OSError, AttributeError):
            print(f"note: {text}", file=sys.stderr, flush=True)


# --- the compiler ----------------------------------------------------------------------------


@cache
def find_compiler() -> tuple[str, ...] | None:
    """Return the command of a C compiler; None if there is none."""
    from importlib.util import find_spec

    end = ".exe" if sys.platform == "win32" else ""
    for name in ("cc", "gcc", "clang"):
        if found := _which(name + end, os.get_exec_path()):
            return (found,)
    spec = find_spec("ziglang")
    zig = spec and _which("zig" + end, spec.submodule_search_locations or ())
    return (zig, "cc") if zig else None


def _which(name: str, folders: Iterable[str]) -> str | None:
    # As `shutil.which`, whose module takes long to import.
    paths = (os.path.join(place, name) for place in folders if os.path.isabs(place))
    return next((p for p in paths if os.path.isfile(p) and os.access(p, os.X_OK)), None)


def _build_once(path: Path, write: Callable[[], str]) -> None:
    """Build a library in place of none, or of a damaged one, unless another process does."""
    compiler = require_compiler()
    if not progress.builds:
        progress.builds = True
        progress.begin()
    try:
        path.parent.mkdir(mode=0o700, exist_ok=True)  # others may have removed it as an old one
        with _lock(path.with_suffix(".lock")) as is_alone:
            if _load(path) is None:
                compile_library(compiler, {"kernel.c": write()}, path, is_alone=is_alone)
    except OSError as error:
        raise CannotBuild(f"{path}: {error.strerror or error}") from error


def require_compiler() -> tuple[str, ...]:
    """Return the command of a C compiler. Raise `CannotBuild` if there is none."""
    compiler = find_compiler()
    if compiler is None:
        raise CannotBuild(_REMEDY)
    return compiler


def compile_library(
    compiler: tuple[str, ...], sources: Mapping[str, str], path: Path, *, is_alone: bool = False
) -> None:
    """Compile the first source, which may include the others. Raise `CannotBuild`.

    `is_alone`: no other process builds this one; what a killed one has left is removed.
    """
    import shutil
    import tempfile

    if is_alone:  # builds that were killed
        for left in path.parent.glob(f"{path.stem}.*.tmp"):
            shutil.rmtree(left, ignore_errors=True)
    scratch = Path(tempfile.mkdtemp(".tmp", f"{path.stem}.", path.parent))
    try:
        for name, text in sources.items():
            (scratch / name).write_text(text, "utf-8")
        first = next(iter(sources))
        _run_compiler([*compiler, *_FLAGS, first, "-o", path.name, "-lm"], scratch)
        made = scratch / path.name
        with made.open("rb") as file:
            os.fsync(file.fileno())  # a machine that loses power must not keep half of it
        made.replace(path)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _run_compiler(command: list[str], scratch: Path) -> None:
    import signal
    from subprocess import DEVNULL, PIPE, Popen, TimeoutExpired

    given = {**os.environ, "TMPDIR": str(scratch), "ZIG_LOCAL_CACHE_DIR": str(scratch)}
    if not os.environ.get("HOME"):  # zig needs a place for what it makes of its C library
        given.setdefault("ZIG_GLOBAL_CACHE_DIR", str(scratch))
    with Popen(
        command,
        cwd=scratch,
        env=given,
        stdin=DEVNULL,
        stdout=DEVNULL,
        stderr=PIPE,
        text=True,
        errors="replace",
        process_group=0,
    ) as compiling:
        try:
            said = compiling.communicate(timeout=LONGEST_BUILD_S)[1]
        except BaseException as error:  # Ctrl-C, too, ends what the compiler has started
            with suppress(OSError, AttributeError):
                os.killpg(compiling.pid, signal.SIGKILL)
            compiling.kill()
            if isinstance(error, TimeoutExpired):
                why = f"{command[0]} did not end within {LONGEST_BUILD_S:g} s"
                raise CannotBuild(why) from error
            raise
    if compiling.returncode:
        lines = (line for line in said.splitlines() if "error: " in line or "failed: " in line)
        why = next(lines, f"exit code {compiling.returncode}")
        raise CannotBuild(f"{command[0]} failed: {why}; {_REMEDY}")


@contextmanager
def _lock(path: Path) -> Iterator[bool]:
    """Hold a lock; yield whether the system has locks: without, two may build the same."""
    try:
        import fcntl

        held = path.open("w")
    except (ImportError, OSError):
        yield False
        return
    with held:
        try:
            fcntl.flock(held, fcntl.LOCK_EX)
        except OSError:  # a file system without locks
            yield False
            return
        try:
            yield True
        finally:
            path.unlink(missing_ok=True)
            fcntl.flock(held, fcntl.LOCK_UN)  # a process forked meanwhile has the file, too


# --- the folder ------------------------------------------------------------------------------


def find_code_folder() -> Path:
    """Return the user's private folder for machine code; /tmp is shared, and thus no substitute."""
    if given := os.environ.get("XDG_CACHE_HOME"):
        return Path(given) / "pamctl"
    try:
        return Path.home() / ".cache" / "pamctl"
    except RuntimeError:  # neither HOME nor an entry among the users, as in a container
        return Path(os.devnull) / "pamctl"


@cache
def _find_folder() -> Path:
    """Return the folder of these sources and this compiler, marked as used.

    Where the user's folder cannot be written, it is one of this process.
    """
    home = find_code_folder()
    sources = f"library-{_hash_house()[:16]}"
    compiler = find_compiler()
    if compiler is None:  # what it built before it was removed is as good as ever
        known = sorted(home.glob(f"{sources}-*"), key=lambda place: place.stat().st_mtime)
        return known[-1] if known else home / sources
    folder = home / f"{sources}-{_identify(compiler)}"
    try:
        is_new = not folder.is_dir()
        home.mkdir(parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        for place in (home, folder):
            _check_owner(place)
        os.utime(folder)
        if is_new:
            _remove_old(home)
    except OSError as error:
        return _make_own_folder(folder, error)
    return folder


def _check_owner(place: Path) -> None:
    """Raise PermissionError for a folder of another user, who may put code into it."""
    if hasattr(os, "getuid") and place.stat().st_uid != os.getuid():
        raise PermissionError(13, "it belongs to another user")
    if not os.access(place, os.W_OK):
        raise PermissionError(13, "it cannot be written")


def _make_own_folder(folder: Path, error: OSError) -> Path:
    import atexit
    import shutil
    import tempfile

    why = f"{folder}: {error.strerror or error}"
    try:
        own = tempfile.mkdtemp(prefix="pamctl-")
    except OSError:
        raise CannotBuild(f"{why}; no folder for temporary files") from error
    atexit.register(shutil.rmtree, own, ignore_errors=True)
    _tell_once(
        "UNKEPT_CODE",
        f"each process builds its own machine code, which takes seconds: {why}; "
        "name a folder that can be written with XDG_CACHE_HOME",
    )
    return Path(own)


def _remove_old(home: Path) -> None:
    """Remove the folders that were not used for longest. Who has loaded from one still has it."""
    import shutil

    kinds = ("library-*", "kernels-*", "ahead")  # the last two are of versions before
    folders = [place for kind in kinds for place in home.glob(kind) if place.is_dir()]
    for place in sorted(folders, key=lambda place: place.stat().st_mtime)[:-KEPT]:
        shutil.rmtree(place, ignore_errors=True)


def _identify(compiler: tuple[str, ...]) -> str:
    """Return a digest of a compiler: asking it for its version would take too long."""
    program = Path(compiler[0]).resolve()
    try:
        state = program.stat()
    except OSError:
        return "unknown"
    machine = os.uname().machine if hasattr(os, "uname") else os.environ.get("PROCESSOR_IDENTIFIER")
    parts = (str(program), state.st_size, state.st_mtime_ns, machine, *_FLAGS)
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:8]


@cache
def _hash_house() -> str:
    return hash_files([*sorted((_ROOT / "pamctl").glob("*.py")), *_list_sources()])


def _list_sources() -> Iterator[str]:
    for source in _SOURCES:
        for place, folders, files in os.walk(_ROOT / source):
            folders[:] = sorted(folder for folder in folders if folder != "__pycache__")
            yield from (os.path.join(place, file) for file in sorted(files))


def hash_files(files: Iterable[Path | str]) -> str:
    """Return a digest of the names and contents of files."""
    digest = hashlib.sha256()
    for path in files:
        with open(path, "rb", buffering=0) as file:
            digest.update(os.path.basename(path).encode() + b"\0" + file.read())
    return digest.hexdigest()


@cache
def hash_package(module: str) -> str:
    """Return a digest of the sources of a module's package; empty for pamctl's own."""
    top = module.partition(".")[0]
    if top in ("pamctl", "hal"):
        return ""
    places = [Path(place) for place in getattr(sys.modules.get(top), "__path__", ())]
    files = [file for place in places for file in sorted(place.rglob("*.py"))]
    alone = getattr(sys.modules.get(module), "__file__", None)
    return hash_files(files or ([Path(alone)] if alone else []))
