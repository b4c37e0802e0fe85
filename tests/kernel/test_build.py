"""Machine code is built once, whole or not at all; where it cannot be, plain Python computes."""

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from array import array
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
import small_kernels
from support.command_line import start_process
from support.patience import PATIENCE_S

import pamctl
from pamctl.kernel import build, calls

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")

ROOT = Path(pamctl.__file__).parents[1]
RIGHT = "2.0 4.0 6.0"
IS_ROOT = os.name == "posix" and os.getuid() == 0


class Place:
    """A user's cache, a compiler that notes when it is called, and processes that use both."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.cache = folder, folder / "cache"
        self.calls = folder / "calls"
        self.path = folder / "bin"
        self.path.mkdir()
        self.write_compiler('exec "$REAL" "$@"')
        self.environment = {
            "PATH": str(self.path),
            "XDG_CACHE_HOME": str(self.cache),
            "REAL": str(shutil.which("cc")),
            "PYTHONPATH": os.pathsep.join((str(Path(__file__).parent), str(ROOT))),
        }

    def write_compiler(self, text: str) -> None:
        compiler = self.path / "cc"
        made = self.path / "made"
        paths = "PATH=/usr/bin:/bin; export PATH"
        made.write_text(f'#!/bin/sh\n{paths}\necho called >> "{self.calls}"\n{text}\n')
        made.chmod(0o755)
        made.replace(compiler)

    def start(self, code: str = "", **more: str) -> subprocess.Popen[str]:
        given = ["-c", code] if code else ["-m", "small_kernels"]
        return start_process(
            [sys.executable, *given], env={**self.environment, **more}, cwd=self.folder
        )

    def run(self, code: str = "", **more: str) -> tuple[str, str]:
        """Return what a process computed with what, and what it said."""
        process = self.start(code, **more)
        out, err = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0, err
        return out.splitlines()[0], err

    def count_calls(self) -> int:
        return len(self.calls.read_text().split()) if self.calls.exists() else 0

    def list_files(self) -> list[str]:
        """List all that is in the folders of the cache."""
        return sorted(str(p.relative_to(p.parents[1])) for p in self.cache.glob("pamctl/*/*"))

    def find_library(self) -> Path:
        (library,) = self.cache.glob("pamctl/*/*.so")
        return library


@pytest.fixture
def place(tmp_path: Path) -> Place:
    return Place(tmp_path)


def wait_until(is_so: Callable[[], object]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not is_so():
        assert time.monotonic() < end_s
        time.sleep(0.01)


# --- once ------------------------------------------------------------------------------------


def test_a_process_builds_and_the_next_one_only_loads(place):
    for _ in range(2):
        process = place.start()
        out, err = process.communicate(timeout=PATIENCE_S)
        assert (out.splitlines()[0], err) == (f"{RIGHT} native", "")
    assert place.count_calls() == 1
    imported = out.splitlines()[1].split()
    assert "ast" not in imported, "what only a build needs takes long"
    assert "subprocess" not in imported
    assert "inspect" not in imported


def test_processes_that_need_the_same_build_it_once(place):
    place.write_compiler('sleep 0.5; exec "$REAL" "$@"')
    processes = [place.start() for _ in range(3)]
    said = [process.communicate(timeout=PATIENCE_S) for process in processes]
    assert {out.splitlines()[0] for out, _ in said} == {f"{RIGHT} native"}
    assert place.count_calls() == 1
    assert place.list_files() == [f"{place.find_library().parent.name}/{place.find_library().name}"]


def test_other_sources_are_built_anew(place, tmp_path):
    own = tmp_path / "own"
    own.mkdir()
    source = (Path(__file__).parent / "small_kernels.py").read_text()
    paths = {"PYTHONPATH": os.pathsep.join((str(own), str(ROOT)))}
    for factor, expected in (("2.0", RIGHT), ("5.0", "5.0 10.0 15.0"), ("2.0", RIGHT)):
        changed = source.replace("FACTOR = 2.0", f"FACTOR = {factor}")
        (own / "small_kernels.py").write_text(changed)
        shutil.rmtree(own / "__pycache__", ignore_errors=True)
        assert place.run(**paths) == (f"{expected} native", "")
    assert place.count_calls() == 2


@pytest.mark.long
def test_another_pamctl_has_machine_code_of_its_own(place, tmp_path):
    own = tmp_path / "own"
    for package in ("pamctl", "hal"):
        skipped = shutil.ignore_patterns("__pycache__", "manual")
        shutil.copytree(ROOT / package, own / package, ignore=skipped)
    paths = {"PYTHONPATH": os.pathsep.join((str(own), str(Path(__file__).parent)))}
    place.run(**paths)
    with (own / "pamctl" / "plant" / "paper.py").open("a") as file:
        file.write("\nMORE = 1\n")
    for _ in range(2):
        assert place.run(**paths) == (f"{RIGHT} native", "")
    assert place.count_calls() == 2
    assert len([*place.cache.glob("pamctl/library-*")]) == 2


def test_another_compiler_builds_anew(place):
    place.run()
    place.write_compiler('# newer\nexec "$REAL" "$@"')
    assert place.run() == (f"{RIGHT} native", "")
    assert place.count_calls() == 2


def test_a_compiler_that_was_removed_leaves_what_it_built(place):
    place.run()
    (place.path / "cc").unlink()
    assert place.run() == (f"{RIGHT} native", "")


# --- builds that end early -------------------------------------------------------------------


def test_what_a_killed_build_left_is_removed_by_the_next(place):
    place.write_compiler('[ -e "$XDG_CACHE_HOME/../second" ] || sleep 30; exec "$REAL" "$@"')
    process = place.start()
    wait_until(place.count_calls)
    process.kill()
    process.communicate(timeout=PATIENCE_S)
    (place.folder / "second").touch()
    assert place.run() == (f"{RIGHT} native", "")
    library = place.find_library()
    assert place.list_files() == [f"{library.parent.name}/{library.name}"]


def test_a_killed_compiler_means_plain_python_and_a_new_build_next_time(place):
    place.write_compiler("kill -9 $$")
    computed, said = place.run()
    assert computed == f"{RIGHT} plain"
    assert said.count("plain Python") == 1
    assert not place.list_files()
    place.write_compiler('exec "$REAL" "$@"')
    assert place.run() == (f"{RIGHT} native", "")


def test_a_compiler_that_fails_is_quoted_once(place):
    place.write_compiler("echo 'kernel.c:6: fatal error: math.h: no such file' >&2; exit 1")
    code = (
        "import subprocess, sys, small_kernels\n"
        "small_kernels.main()\n"
        "from pamctl.kernel.calls import PlainCall, prepare\n"
        "from array import array\n"
        "one = array('d', (1.0,))\n"
        "call = prepare(small_kernels.fill_multiples, {'values': one, 'multiples': one})\n"
        "assert not call.is_native\n"
        "subprocess.run([sys.executable, '-m', 'small_kernels'], check=True)\n"
    )
    computed, said = place.run(code)
    assert computed == f"{RIGHT} plain"
    assert said.count("plain Python") == 1, "also for the processes that it starts"
    assert "math.h: no such file" in said
    assert "gcc" in said
    assert not place.list_files()


@pytest.mark.parametrize("how", ["sleep 30", "sleep 30 & wait", "trap '' TERM; sleep 30"])
def test_a_compiler_that_hangs_is_ended(place, how, tmp_path):
    place.write_compiler(how)
    code = (
        "import small_kernels, pamctl.kernel.build as build\n"
        "build.LONGEST_BUILD_S = 0.3\n"
        "small_kernels.main()"
    )
    computed, said = place.run(code)
    assert computed == f"{RIGHT} plain"
    assert said.count("plain Python") == 1
    assert not place.list_files()


def test_a_library_that_cannot_be_loaded_is_built_again(place):
    place.run()
    library = place.find_library()
    size = library.stat().st_size
    for count, broken in enumerate((b"", b"\0" * size, b"\x7fELF" + b"\1" * 60), start=2):
        library.write_bytes(broken)
        assert place.run() == (f"{RIGHT} native", "")
        assert place.count_calls() == count


# --- where it cannot be kept -----------------------------------------------------------------


def test_without_a_compiler_plain_python_computes_and_names_both_remedies(place):
    if find_spec("ziglang") is not None:
        pytest.skip("ziglang is installed: there is always a compiler")
    (place.path / "cc").unlink()
    computed, said = place.run()
    assert computed == f"{RIGHT} plain"
    assert said.count("\n") == 1
    assert "install gcc" in said
    assert "pip install ziglang" in said
    assert not place.list_files()


def test_the_compiler_of_ziglang_is_used_where_there_is_no_other(place):
    if find_spec("ziglang") is None:
        pytest.skip("ziglang is not installed (pip install ziglang)")
    (place.path / "cc").unlink()
    assert place.run() == (f"{RIGHT} native", "")


def test_plain_python_can_be_asked_for(place):
    assert place.run(PAMCTL_PLAIN_PYTHON="1") == (f"{RIGHT} plain", "")
    assert not place.calls.exists()
    assert not place.cache.exists()


def test_on_a_system_of_32_bits_plain_python_computes(place):
    on_32_bits = "import ctypes; ctypes.sizeof = lambda kind: 4"
    computed, said = place.run(f"{on_32_bits}; import small_kernels; small_kernels.main()")
    assert computed == f"{RIGHT} plain"
    assert "this is a system of 32 bits" in said
    assert not place.calls.exists()


def find_unwritable(place: Place) -> Iterator[str]:
    yield "/proc/self/nothing"
    file = place.folder / "file"
    file.touch()
    yield str(file)
    locked = place.folder / "locked"
    locked.mkdir(mode=0o500)
    if not IS_ROOT:  # whom no mode keeps out
        yield str(locked)


def test_without_a_cache_each_process_builds_and_says_so_once(place):
    for count, unwritable in enumerate(find_unwritable(place), start=1):
        temporary = place.folder / f"tmp-{count}"
        temporary.mkdir()
        computed, said = place.run(XDG_CACHE_HOME=unwritable, TMPDIR=str(temporary))
        assert computed == f"{RIGHT} native"
        assert said.count("\n") == 1
        assert unwritable in said
        assert "XDG_CACHE_HOME" in said
        assert not [*temporary.iterdir()], "its code is removed with the process"
        assert place.count_calls() == count


@pytest.mark.skipif(not IS_ROOT, reason="only root can give a folder to another user")
@pytest.mark.parametrize("whose", ["home", "folder", "link"])
def test_code_in_a_folder_of_another_user_is_not_loaded(place, whose):
    place.run()
    home = place.cache / "pamctl"
    library = place.find_library()
    # What they planted would give other numbers.
    planted = place.folder / "planted.c"
    planted.write_text("int run(void *words) { return 0; }")
    make = [place.environment["REAL"], "-shared", "-fPIC", str(planted), "-o", str(library)]
    subprocess.run(make, check=True)
    if whose == "link":
        moved = place.folder / "theirs"
        shutil.move(library.parent, moved)
        library.parent.symlink_to(moved)
        os.chown(moved, 65534, 65534)
    else:
        os.chown(home if whose == "home" else library.parent, 65534, 65534)
    computed, said = place.run()
    assert computed == f"{RIGHT} native"
    assert "another user" in said


@pytest.mark.skipif(not IS_ROOT, reason="only root can make a small disk")
@pytest.mark.parametrize("bytes_free", [0, 8192, 16384])
def test_on_a_full_disk_plain_python_computes(place, bytes_free):
    place.cache.mkdir()
    options = "size=64k,nr_inodes=100"
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", place.cache])
    if mounted.returncode:
        pytest.skip("this machine lets root mount nothing")
    try:
        (place.cache / "filler").write_bytes(bytes(65536 - 2 * 4096 - bytes_free))
        computed, said = place.run()
        assert computed.startswith(RIGHT)
        if computed.endswith("plain"):
            assert said.count("plain Python") == 1
            assert "space" in said.lower()
        (place.cache / "filler").unlink()
        assert place.run() == (f"{RIGHT} native", "")
    finally:
        subprocess.run(["umount", "-l", place.cache], check=True)


# --- the folders -----------------------------------------------------------------------------


def test_old_folders_are_removed_but_for_those_used_last(place):
    home = place.cache / "pamctl"
    for k in range(20):
        old = home / f"library-{k:02d}"
        old.mkdir(parents=True)
        (old / "a.so").touch()
        os.utime(old, (10**9 + k, 10**9 + k))
    for name in ("kernels-0123", "ahead"):  # of versions that compiled otherwise
        (home / name).mkdir()
        os.utime(home / name, (1, 1))
    (home / "logs").mkdir()
    place.run()
    kept = sorted(path.name for path in home.iterdir())
    assert kept[-1] == "logs"
    assert [name for name in kept if len(name) == len("library-00")] == [
        f"library-{k}" for k in range(21 - build.KEPT, 20)
    ]
    assert len(kept) == build.KEPT + 1, "with the new one, and what is no machine code"


def test_a_folder_that_was_removed_meanwhile_is_made_again(place):
    code = (
        "import shutil, small_kernels, pamctl.kernel.build as build\n"
        "shutil.rmtree(build._find_folder())\n"
        "small_kernels.main()"
    )
    assert place.run(code) == (f"{RIGHT} native", "")


# --- threads and processes that share a kernel -----------------------------------------------


@pytest.fixture
def fresh_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty cache for this process."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    build._find_folder.cache_clear()
    yield tmp_path
    build._find_folder.cache_clear()


def test_two_threads_may_call_a_kernel_at_once(fresh_cache):
    machine = calls.Machine(small_kernels.fill_multiples)
    wrong: list[str] = []
    together = threading.Barrier(4)

    def call(first: int) -> None:
        values = array("d", range(first, first + 1000))
        together.wait()
        for _ in range(200):
            multiples = array("d", bytes(8000))
            machine(values, multiples)
            if [*multiples] != [2.0 * value for value in values]:
                wrong.append("other numbers")

    threads = [threading.Thread(target=call, args=(1000 * k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE_S)
    assert not wrong
    assert {function is not None for _, function in machine._variants} == {True}


def test_a_forked_process_calls_what_its_parent_built(fresh_cache):
    machine = calls.Machine(small_kernels.fill_multiples)
    values, multiples = array("d", (1.0, 2.0)), array("d", bytes(16))
    machine(values, multiples)
    pid = os.fork()
    if pid == 0:
        multiples = array("d", bytes(16))
        machine(values, multiples)
        calls.Machine(small_kernels.fill_multiples)(values, multiples)
        os._exit(0 if [*multiples] == [2.0, 4.0] else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


def test_a_process_forked_during_a_build_does_not_keep_the_others_from_it(place):
    """The child inherits the lock, and lives on."""
    place.write_compiler('sleep 0.5; exec "$REAL" "$@"')
    code = (
        "import os, sys, threading, time, small_kernels\n"
        "build = threading.Thread(target=small_kernels.main); build.start(); time.sleep(0.25)\n"
        "pid = os.fork()\n"
        "if pid == 0: sys.stdin.read(); os._exit(0)\n"
        "build.join(); print(pid)"
    )
    first = place.start(code)
    wait_until(place.count_calls)
    second = place.start()
    out, _ = second.communicate(timeout=PATIENCE_S)
    assert out.splitlines()[0] == f"{RIGHT} native"
    assert place.count_calls() == 1
    out, _ = first.communicate(timeout=PATIENCE_S)
    assert out.splitlines()[0] == f"{RIGHT} native"


def test_a_killed_process_frees_the_lock_for_one_that_waits(place):
    place.write_compiler('[ -e "$XDG_CACHE_HOME/../second" ] || sleep 30; exec "$REAL" "$@"')
    first = place.start()
    wait_until(place.count_calls)
    (place.folder / "second").touch()
    second = place.start()
    time.sleep(0.2)
    first.send_signal(signal.SIGKILL)
    out, _ = second.communicate(timeout=PATIENCE_S)
    assert out.splitlines()[0] == f"{RIGHT} native"
    first.communicate(timeout=PATIENCE_S)


def test_every_folder_that_machine_code_is_made_of_is_there():
    """A folder that is missing would let changes of its kernels go unnoticed."""
    assert [at for at in build._SOURCES if not (build._ROOT / at).is_dir()] == []
