"""Verbs that read logs write only the requested file, and overwrite no other."""

import os
import shutil
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import openpyxl
import pytest
from mcap.reader import make_reader
from support.command_line import run_process
from typer.testing import CliRunner

import pamctl.log
from pamctl.base.errors import ExitCode
from pamctl.cli.app import app
from pamctl.processes.interrupts import restore_signals
from pamctl.processes.run_once import make_run_meta, run_here
from pamctl.settings.config_files import DEFAULT_NAMES
from pamctl.settings.resolve import resolve

GOLDEN = Path(__file__).parents[1] / "golden" / "qsmc.mcap"


@pytest.fixture
def log(tmp_path):
    return shutil.copy(GOLDEN, tmp_path / "run.mcap")


def refused(*arguments):
    """Run a verb that must exit with 2; return its message in one line."""
    done = CliRunner().invoke(app, [str(word) for word in arguments])
    assert done.exit_code == 2, done.output
    assert not done.stdout
    return " ".join(done.stderr.replace("│", " ").split())


def test_a_folder_in_the_place_of_a_log_is_refused_as_no_log():
    done = CliRunner().invoke(app, ["report", "."])
    assert done.exit_code == 65
    assert "it is a directory, not a file" in done.stderr


@pytest.mark.parametrize("verb", [("report",), ("compare", "--plant", "paper")])
def test_a_page_replaces_an_older_page_and_nothing_else(verb, log):
    option = "--out" if verb[0] == "report" else "--plot"
    before = log.read_bytes()
    assert "is something else" in refused(*verb, log, option, log)
    assert log.read_bytes() == before
    page = log.with_name("page.html")
    page.write_text("<!doctype html>an older one")
    assert CliRunner().invoke(app, [*verb, str(log), option, str(page)]).exit_code == 0
    assert "an older one" not in page.read_text()


def test_a_page_that_cannot_be_written_is_refused(log):
    assert "is a directory" in refused("compare", log, "--plot", log.parent)
    assert "there is no directory" in refused("compare", log, "--plot", log.parent / "a" / "b.html")
    assert "there is no directory" in refused("report", log, "--out", log.parent / "a" / "b.html")
    assert not (log.parent / "a").exists()
    assert "is not a folder" in refused("reproduce", "fig3", "--out", log)
    assert "Not a directory" in refused("reproduce", "fig3", "--out", log / "inside")


def test_the_table_of_a_what_if_is_never_written_over_a_file(log):
    table = log.with_name("table.csv")
    what_if = ("replay", log, "--set", "controller.eta=0", "--csv", table)
    assert CliRunner().invoke(app, [str(word) for word in what_if]).exit_code == 0
    before = table.read_bytes()
    assert "never overwritten" in refused(*what_if)
    assert table.read_bytes() == before


@pytest.mark.parametrize("seconds", ["nan", "inf", "-1"])
def test_a_replay_refuses_a_start_time_that_is_not_possible(seconds, log):
    assert f"at least 0 s (got {seconds})" in refused("replay", log, "--from", seconds)


@pytest.mark.parametrize("options", [(), ("--set", "controller.eta=0")])
def test_a_replay_from_after_the_end_is_a_wrong_option_not_a_bad_log(options, log):
    assert "there is nothing from 1e+09 s on" in refused("replay", log, "--from", "1e9", *options)


@pytest.fixture
def impatient():
    """An alarm that ends a test that waits or reads without end."""
    before = signal.signal(signal.SIGALRM, lambda *_: pytest.fail("it hangs"))
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize(
    ("verb", "code", "kind"),
    [
        ("log info {}", 65, "a directory"), ("config check {}", 78, "a device"),
        *((verb, 65, kind) for kind in ("a pipe", "a device") for verb in (
            "replay {}", "compare {}", "report {}", "diagnose {} --out out", "log info {}",
            "log check {}", "log recover {} out.mcap", "log export {} out.csv",
            "log import {} out.mcap",
        )),
        *((verb, 78, "a pipe") for verb in (
            "audit {}", "log import {} out.mcap --map {}", "run --dry-run --rig {}",
            "config check {}",
        )),
    ],
)  # fmt: skip
def test_every_file_that_is_not_regular_is_refused_without_waiting(
    verb, code, kind, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "input"
    match kind:
        case "a directory":
            path.mkdir()
        case "a pipe":
            os.mkfifo(path)
        case "a device":
            path = Path("/dev/zero")
    done = CliRunner().invoke(app, verb.format(*2 * [path]).split())
    assert done.exit_code == code, done.output
    assert f"{kind}, not a file" in done.output
    assert list(tmp_path.iterdir()) in ([], [path])


@pytest.mark.parametrize("options", [(), ("--json",)])
def test_info_of_a_damaged_log_exits_with_3_and_names_the_fix(log, options):
    whole = CliRunner().invoke(app, ["log", "info", str(log), *options])
    assert (whole.exit_code, whole.stderr) == (0, "")
    log.write_bytes(log.read_bytes()[:-1000])
    cut = CliRunner().invoke(app, ["log", "info", str(log), *options])
    assert cut.exit_code == 3
    assert f"pamctl log recover {log}" in cut.stderr
    assert "qsmc" in cut.stdout, "what is whole is told nevertheless"


ELSEWHERE = """
import mmap, os, select, signal, socket, sys
import subprocess, asyncio, multiprocessing.pool  # the standard library knows where it is

for name in ("fcntl", "grp", "pwd", "resource", "syslog", "termios"):
    sys.modules[name] = None
hidden = {
    os: ["sched_", "SCHED_", "eventfd", "P_PID", "waitid", "get", "fch", "O_NOFOLLOW", "O_CLOEXEC",
         "fork", "pread", "pwrite", "posix_", "setsid", "kill", "fdatasync", "memfd"],
    signal: ["SIGHUP", "SIGSTOP", "SIGTSTP", "SIGKILL", "SIGCONT", "SIGALRM", "pthread", "setit"],
    select: ["poll", "epoll"], socket: ["AF_UNIX"], mmap: ["MAP_", "PROT_"],
}
kept = ("getpid", "getcwd", "getcwdb", "getenv", "getenvb", "get_terminal_size", "get_exec_path")
for module, beginnings in hidden.items():
    for name in [n for n in dir(module) if n.startswith(tuple(beginnings)) and n not in kept]:
        delattr(module, name)

system = sys.argv[1]
if system != "elsewhere":
    # Packages know by their own means where they are; ours must ask for what it uses.
    import numpy, scipy.io, scipy.optimize, scipy.signal, pydantic, typer, rich.console
    import mcap.writer, google.protobuf.message_factory, yaml, zstandard, openpyxl
    import multiprocessing.connection, concurrent.futures.process
    sys.platform = system

from pamctl.cli.app import app
for verb in sys.argv[2:]:
    try:
        app(verb.split())
    except SystemExit as end:
        assert not end.code, (verb, end.code)
"""
"""Several calls of `pamctl` without the modules and names that only Linux has."""


def run_elsewhere(system: str, folder: Path, *verbs: str) -> None:
    command = [sys.executable, "-c", ELSEWHERE, system, *verbs]
    done = run_process(command, cwd=folder)
    assert done.returncode == 0, done.stderr


@pytest.mark.long
def test_verbs_that_drive_no_rig_run_without_linux(log):
    verbs = [
        "replay {} --tolerance default-for-other-cpu", "log info {}", "log check {}",
        "log recover {} saved.mcap", "log export {} out.csv", "log import out.csv again.mcap",
        "config check", "run --dry-run",
    ]  # fmt: skip
    run_elsewhere("elsewhere", log.parent, *(verb.format(log) for verb in verbs))


@pytest.mark.long
def test_files_go_in_and_out_and_a_run_is_the_same_where_the_system_has_another_name(log):
    book = openpyxl.Workbook()
    for row in (["Time [s]", "Position [mm]"], [0, 1], [0.001, 2], [0.002, 2]):
        book.worksheets[0].append(row)
    book.save(log.with_name("lab.xlsx"))
    run = "run --fast --quiet --duration 0.5 --seed 7 --log"
    run_elsewhere(
        "win32", log.parent, "log export run.mcap out.parquet", "log import lab.xlsx lab.mcap",
        "log cut run.mcap --out part.mcap --from-s 1 --to-s 1.2",
        "report part.mcap --out page.html",
        "plant new --actuator muscle --out plant.yaml", "config check plant.yaml",
        "plant export plant.yaml plant.fmu --sources-only", "compare part.mcap", "manual",
        f"{run} elsewhere.mcap",
    )  # fmt: skip
    assert CliRunner().invoke(app, [*run.split(), str(log.with_name("here.mcap"))]).exit_code == 0
    there, here = (read_messages(log.with_name(f"{name}.mcap")) for name in ("elsewhere", "here"))
    assert len(here) > 2000
    assert there == here
    checked = CliRunner().invoke(app, ["log", "check", str(log.with_name("elsewhere.mcap"))])
    assert checked.exit_code == 0


def read_messages(path: Path) -> list[tuple[str, int, int, bytes]]:
    with path.open("rb") as file:
        return sorted(
            (channel.topic, message.sequence, message.log_time, message.data)
            for _, channel, message in make_reader(file).iter_messages()
        )


@pytest.mark.parametrize("count", [1, 2])
def test_ctrl_c_ends_a_run_in_one_process_with_a_whole_log(count, tmp_path):
    """One ends it smoothly, two at once; the log says so."""
    settings = resolve(fast=True)
    path = tmp_path / "run.mcap"
    meta = make_run_meta(settings, DEFAULT_NAMES, path)
    told = []

    def interrupt(tick):
        told.append(tick["tick"])
        if len(told) == 1:
            for _ in range(count):
                signal.raise_signal(signal.SIGINT)

    with restore_signals():
        report = run_here(meta, settings, interrupt)
    assert report.ending.code == ExitCode.SIGINT
    assert report.log_is_whole
    assert CliRunner().invoke(app, ["log", "check", str(path)]).exit_code == 0
    log = pamctl.log.read(path)
    after = log["tick"][-1] - told[0]
    assert after <= 1 if count == 2 else 100 < after < 5000


@pytest.mark.parametrize(
    "verb",
    ["run", "safe", "doctor", "daemon", "watch", "status", "calibrate pressure --out a.yaml"],
)
def test_a_verb_that_drives_a_rig_says_that_it_needs_linux(verb, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("pamctl.cli.options.sys", SimpleNamespace(platform="elsewhere"))
    done = CliRunner().invoke(app, verb.split())
    assert done.exit_code == 69, done.output
    assert done.stderr.startswith("error: this verb needs Linux")
    assert not list(tmp_path.iterdir())
