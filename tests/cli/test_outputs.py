"""Outputs that cannot be written: the reason in one line, the exit code, and nothing half-made."""

import json
import os
import random
import resource
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.command_line import run_pamctl
from support.patience import PATIENCE_S

from pamctl.base.new_file import NewFileError, write_files
from pamctl.cli.output import Saving

GOLDEN = Path(__file__).parents[1] / "golden"
LOG = str(GOLDEN / "readonly.mcap")
PAMCTL = [sys.executable, "-m", "pamctl"]
CSV = "t_s,position_m\n" + "".join(f"{n * 1e-3},{0.01 + n * 1e-6}\n" for n in range(3000))

VERBS = {
    "log export": ["log", "export", LOG, "{}/new.csv"],
    "log export mat": ["log", "export", LOG, "{}/new.mat"],
    "log recover": ["log", "recover", LOG, "{}/new.mcap"],
    "log import": ["log", "import", "table.csv", "{}/new.mcap"],
    "report": ["report", LOG, "--out", "{}/new.html"],
    "compare": ["compare", LOG, "--plot", "{}/new.html"],
    "replay": ["replay", str(GOLDEN / "qsmc.mcap"), "--set", "controller.eta=0", "--csv",
               "{}/new.csv"],
    "diagnose": ["diagnose", LOG, "--out", "{}/new"],
    "tune": ["tune", "--law", "pid", "--plant", "paper", "--generations", "1", "--out",
             "{}/new.yaml"],
    "calibrate": ["calibrate", "valve", "--backend", "sim", "--yes", "--out", "{}/new.yaml"],
    "reproduce": ["reproduce", "fig3", "--out", "{}/new"],
}  # fmt: skip


def pamctl(*words: str, cwd: Path, stdout: int) -> subprocess.CompletedProcess[str]:
    """Run a verb that writes into a file."""
    return subprocess.run(
        [*PAMCTL, *words],
        cwd=cwd,
        text=True,
        stdout=stdout,
        stderr=subprocess.PIPE,
        timeout=PATIENCE_S,
        check=False,
    )


@contextmanager
def files_end_at(largest_bytes: int) -> Iterator[None]:
    """Forbid this process to write files beyond a size."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (largest_bytes, hard))
    kept, sys.dont_write_bytecode = sys.dont_write_bytecode, True  # no module is cut off
    try:
        yield
    finally:
        sys.dont_write_bytecode = kept
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def assert_said(done: subprocess.CompletedProcess[str], code: int, reason: str) -> None:
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith("error: cannot write")
    assert reason in last


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("outputs")
    (folder / "table.csv").write_text(CSV)
    return folder


@pytest.fixture(scope="module", params=["full", "read-only"])
def disk(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Path, int, str]]:
    """A file system on which nothing can be written, with the code and reason of a refusal."""
    folder = tmp_path_factory.mktemp("disk")
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("only root may mount a small file system")
    try:
        if request.param == "full":
            (folder / "ballast").write_bytes(bytes(60 * 1024))
            yield folder, 1, "No space left on device"
        else:
            again = ["mount", "-o", "remount,ro", str(folder)]
            subprocess.run(again, capture_output=True, check=True)
            yield folder, 2, "Read-only file system"
    finally:
        subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.parametrize("verb", VERBS)
def test_a_disk_that_takes_nothing_is_noticed_before_the_work(verb, disk, place):
    folder, code, reason = disk
    before = sorted(folder.iterdir())
    done = run_pamctl(*(word.format(folder) for word in VERBS[verb]), cwd=place)
    assert_said(done, code, reason)
    assert not done.stdout
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ("log info loop", 65), ("log check loop", 65), ("log recover loop new.mcap", 65),
        ("log export loop new.csv", 65), ("log import loop new.mcap", 65), ("replay loop", 65),
        ("report loop", 65), ("compare loop", 65), ("diagnose loop --out new", 65),
        ("diagnose {} --holdout loop --out new", 65), ("tune --check loop.yaml", 78),
        ("run --dry-run --rig loop.yaml", 78), ("config check loop.yaml", 78),
        ("log import {} new.mcap --map loop.yaml", 78),
        ("log export {} loop.csv", 2), ("log recover {} loop", 2), ("report {} --out loop", 2),
        ("compare {} --plot loop", 2), ("diagnose {} --out loop", 2),
        ("tune --law pid --out loop.yaml", 2), ("reproduce fig3 --out loop", 2),
        ("calibrate valve --yes --out loop.yaml", 2), ("run --fast --log loop.mcap", 2),
    ],
)  # fmt: skip
def test_a_link_to_itself_is_an_error_and_no_traceback(words, code, tmp_path):
    names = ["loop", "loop.csv", "loop.mcap", "loop.yaml"]
    for name in names:
        (tmp_path / name).symlink_to(name)
    done = run_pamctl(*words.format(LOG).split(), cwd=tmp_path)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    assert (done.stderr or done.stdout).strip()
    assert sorted(path.name for path in tmp_path.iterdir()) == names


@pytest.mark.parametrize("verb", ["log export", "log export mat", "log recover", "log import"])
def test_a_disk_that_fills_while_a_file_is_written_leaves_nothing(
    verb: str, place: Path, tmp_path: Path
) -> None:
    # More than the trial before the work, less than the file.
    words = [word.format(tmp_path).replace(LOG, str(GOLDEN / "card.mcap")) for word in VERBS[verb]]
    if verb == "log import":
        noise = random.Random(1)
        rows = (f"{n * 1e-3},{0.01 + 1e-4 * noise.random()}\n" for n in range(20_000))
        (place / "large.csv").write_text("t_s,position_m\n" + "".join(rows))
        words[2] = "large.csv"
    with files_end_at(66_000):
        done = run_pamctl(*words, cwd=place)
    assert_said(done, 1, "File too large")
    assert not [*tmp_path.iterdir()]


def test_a_comparison_whose_page_finds_no_room_is_printed(place: Path, tmp_path: Path) -> None:
    # The disk fills between the trial and the page. Nothing is compiled: the cache of machine
    # code would be the first to find no room.
    start = "import pamctl.base.new_file as n; n._TRIAL_BYTES = 9; from pamctl.__main__ import main"
    words = [word.format(tmp_path) for word in VERBS["compare"]]
    done = subprocess.run(
        [sys.executable, "-c", f"{start}; main()", *words, "--json"],
        cwd=place,
        text=True,
        capture_output=True,
        timeout=PATIENCE_S,
        # A compiled module that is cut off would fail every test after this one.
        env={**os.environ, "PAMCTL_PLAIN_PYTHON": "1", "PYTHONDONTWRITEBYTECODE": "1"},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000)),
        check=False,
    )
    assert_said(done, 1, "File too large")
    assert not [*tmp_path.iterdir()]
    document = json.loads(done.stdout)
    assert (document["exit_code"], document["plot"]) == (1, None)
    assert document["plants"]


def test_only_a_failure_to_write_is_kept_until_the_result_is_printed(tmp_path):
    with Saving() as saving:
        write_files({tmp_path: "a folder is there"})
    assert isinstance(saving.failure, NewFileError)
    with pytest.raises(KeyError), Saving():
        raise KeyError


@pytest.mark.parametrize("words", ["log info {}", "run --fast --duration 0.3 --log new.mcap"])
def test_standard_output_on_a_full_disk_is_an_error_after_the_work(words, tmp_path):
    full = os.open("/dev/full", os.O_WRONLY)
    done = pamctl(*words.format(LOG).split(), cwd=tmp_path, stdout=full)
    os.close(full)
    assert_said(done, 1, "the output: No space left on device")
    if words.startswith("run"):
        whole = run_pamctl("log", "check", "new.mcap", cwd=tmp_path)
        assert whole.returncode == 0, whole.stdout


def test_a_verb_keeps_its_own_exit_code_where_its_output_is_lost(tmp_path):
    shutil.copy(LOG, tmp_path / "cut.mcap")
    os.truncate(tmp_path / "cut.mcap", 30_000)
    full = os.open("/dev/full", os.O_WRONLY)
    done = pamctl("log", "info", "cut.mcap", cwd=tmp_path, stdout=full)
    os.close(full)
    assert done.returncode == 3
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("same", ["a link", "a copy"])
def test_a_log_that_is_fitted_cannot_be_the_held_out_one(same, tmp_path):
    other = tmp_path / "other.mcap"
    match same:
        case "a link":
            other.symlink_to(LOG)
        case "a copy":
            shutil.copy(LOG, other)
    out = tmp_path / "out"
    done = run_pamctl("diagnose", LOG, "--holdout", str(other), "--out", str(out), cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert f"--holdout {other} holds the same run as {LOG}" in done.stderr
    assert not out.exists()


def test_a_run_that_is_given_twice_does_not_count_twice(tmp_path):
    other = shutil.copy(LOG, tmp_path / "other.mcap")
    for logs in ([LOG, LOG], [LOG, str(other)]):
        done = run_pamctl("diagnose", *logs, "--out", str(tmp_path / "out"), cwd=tmp_path)
        assert done.returncode == 2, done.stderr
        assert f"{logs[1]} holds the same run as {LOG}: a run that counts twice" in done.stderr
