"""Laws of another package or from a file work like the shipped laws.

The package is `support/super_twisting.py` with an entry point; every process of a run must find it.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from support import super_twisting
from support.command_line import run_pamctl
from support.outside_law import HOUSE, SOURCE, install_law, path_with
from support.processes.daemons import TRACKING, Daemon, daemon, parked

from pamctl.control.law import Law
from pamctl.daemon.client import DaemonDeclinedError
from pamctl.log import read

SHORT = ("--fast", "--duration", "3", "--set", "rig.homing.enabled=false")


def pamctl(*words: object, sites: tuple[Path, ...] = ()) -> subprocess.CompletedProcess[str]:
    """Run a verb; in a process of its own where it finds a law that others shall not see."""
    if not sites and "--controller-from" not in words:
        return run_pamctl(*words)
    command = [sys.executable, "-m", "pamctl", *map(str, words)]
    environment = {**os.environ, "PYTHONPATH": path_with(*sites)}
    return subprocess.run(command, capture_output=True, text=True, env=environment)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    install_law(folder)
    return folder


@pytest.fixture(scope="module")
def gains(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("gains") / "twisting.yaml"
    path.write_text("law: super_twisting\nk1: 0.3\n")
    return path


@pytest.fixture(scope="module")
def log(site: Path, gains: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    done = pamctl("run", *SHORT, "--controller", gains, "--log", path, sites=(site,))
    assert done.returncode == 0, done.stderr
    return path


def test_the_log_of_an_outside_law_names_package_and_version_and_source(log: Path) -> None:
    ran = read(log)
    record = ran.metadata["law"]
    assert record["package"] == "super-twisting-law"
    assert record["version"] == "1.2"
    assert record["sha256"] == hashlib.sha256(SOURCE.read_bytes()).hexdigest()
    assert ran.config["controller"]["k1"] == 0.3
    assert {"law.twist_v", "law.surface"} <= ran.keyframes[0]["state"].keys()


@pytest.mark.long
def test_the_log_of_an_outside_law_replays_to_the_bit_from_any_keyframe(
    log: Path, site: Path
) -> None:
    for begin in ([], ["--from", "2.5"]):
        done = pamctl("replay", log, "--json", *begin, sites=(site,))
        assert done.returncode == 0, done.stderr
        found = json.loads(done.stdout)
        assert found["equal"]
        assert "keyframe.law.twist_v" in found["fields"]
        assert found["law_change"] is None


def test_a_replay_without_the_package_names_it(log: Path) -> None:
    done = pamctl("replay", log)
    assert done.returncode == 65
    assert "install the package super-twisting-law 1.2" in done.stderr


def test_a_replay_warns_where_the_source_has_changed(log: Path, tmp_path: Path) -> None:
    install_law(tmp_path)
    with (tmp_path / SOURCE.name).open("a") as file:
        file.write("# another version\n")
    done = pamctl("replay", log, "--plain", sites=(tmp_path,))
    assert done.returncode == 0, done.stderr
    assert "warning: the source of the law 'super_twisting' is not the one" in done.stdout


def test_the_report_names_its_terms_with_and_without_the_package(
    log: Path, site: Path, tmp_path: Path
) -> None:
    for page, sites in ((tmp_path / "with.html", (site,)), (tmp_path / "without.html", ())):
        done = pamctl("report", log, "--out", page, sites=sites)
        assert done.returncode == 0, done.stderr
        text = page.read_text()
        for words in ("Super-twisting: u = -k_1", "u_root", "v_twist, integral of the sign"):
            assert words in text
        assert "u_eq" not in text


@pytest.mark.long
def test_tune_finds_gains_of_an_outside_law_and_writes_its_equation(
    site: Path, tmp_path: Path
) -> None:
    out = tmp_path / "sought.yaml"
    small = ("--plant", "paper", "--generations", "1", "--jobs", "1", "--out", out)
    done = pamctl("tune", "--law", "super_twisting", *small, sites=(site,))
    assert done.returncode == 0, done.stderr
    assert "# Super-twisting: u = -k_1 |s|^(1/2) sign(s) + v" in out.read_text()
    assert pamctl("config", "check", out, sites=(site,)).returncode == 0


def test_a_law_without_a_search_space_is_not_tuned(tmp_path: Path) -> None:
    file = tmp_path / "plain.py"
    file.write_text(SOURCE.read_text() + "\nLAW = LAW.__class__(**{**vars(LAW), 'search': None})\n")
    done = pamctl("tune", "--controller-from", file, "--out", tmp_path / "gains.yaml")
    assert done.returncode == 2
    assert "defines no search space" in done.stderr


def test_a_law_without_default_gains_says_how_to_give_them(tmp_path: Path) -> None:
    file = tmp_path / "bare.py"
    bare = SOURCE.read_text().replace("Field(gt=0, le=440)] = 400.0", "Field(gt=0, le=440)]")
    file.write_text(bare)
    done = pamctl("run", "--dry-run", "--controller-from", file)
    assert done.returncode != 0
    assert "give the gains with --controller GAINS.yaml" in done.stderr


@pytest.mark.long
def test_gains_of_an_outside_law_change_during_a_run_and_its_unit_does_not(
    site: Path, gains: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", path_with(site))
    with daemon(tmp_path, "twisting", options=["--controller", str(gains)]) as made:
        path = Path(made.ask("start", experiment=slow(), name="slow")["log"])
        made.wait_for("running")
        change(made, "controller.k1=0.4")
        with pytest.raises(DaemonDeclinedError, match="another length_unit takes effect with"):
            change(made, "controller.length_unit=inch")
        parked(made)
    assert [said["k1"] for said in read(path).gains] == [0.3, 0.4]
    replayed = pamctl("replay", path, "--plain", sites=(site,))
    assert replayed.returncode == 0, replayed.stderr
    assert ": equal," in replayed.stdout


def slow() -> dict[str, Any]:
    return {**TRACKING, "cycles": 3}


def change(made: Daemon, setting: str) -> None:
    made.ask("set", changes=[setting], ramp_s=0.1)


def test_keys_of_an_outside_law_are_checked_like_those_of_a_shipped_law(
    site: Path, tmp_path: Path
) -> None:
    file = tmp_path / "wrong.yaml"
    file.write_text("law: super_twisting\nk_1: 0.3\nk2_v_per_s: -1\n")
    done = pamctl("run", "--controller", file, sites=(site,))
    assert done.returncode == 78
    assert f"{file}:2:1: controller.k_1: unknown key; did you mean 'k1'?" in done.stderr
    assert f"{file}:3:1: controller.k2_v_per_s: must be at least 0 (got -1)" in done.stderr


def test_without_its_package_a_gains_file_is_refused_with_the_laws_there_are(gains: Path) -> None:
    done = pamctl("run", "--controller", gains)
    assert done.returncode == 78
    assert "must be 'qsmc', 'smc' or 'pid' (got 'super_twisting')" in done.stderr


def test_a_broken_package_removes_only_its_own_law(gains: Path, tmp_path: Path) -> None:
    install_law(tmp_path, "super_twisting = super_twisting:MISSING")
    assert pamctl("config", "check", sites=(tmp_path,)).returncode == 0
    done = pamctl("run", "--controller", gains, sites=(tmp_path,))
    assert done.returncode == 78
    assert "the package super-twisting-law offers it, but cannot be used" in done.stderr


# --- a law from a file ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def file_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("file")
    shutil.copy(SOURCE, folder / "my_law.py")
    path = folder / "run.mcap"
    done = pamctl("run", *SHORT, "--controller-from", folder / "my_law.py:LAW", "--log", path)
    assert done.returncode == 0, done.stderr
    return path


@pytest.mark.long
def test_a_law_from_a_file_runs_with_its_defaults_and_replays(file_log: Path) -> None:
    ran, file = read(file_log), file_log.with_name("my_law.py")
    assert ran.metadata["law"]["file"] == str(file)
    assert ran.metadata["law"]["sha256"] == hashlib.sha256(SOURCE.read_bytes()).hexdigest()
    assert ran.metadata["run"]["controller"] == "super_twisting"
    assert ran.config["controller"]["k1"] == 0.25
    done = pamctl("replay", file_log, "--plain", "--controller-from", file)
    assert done.returncode == 0, done.stderr
    assert ": equal," in done.stdout


def test_a_replay_does_not_load_the_file_of_a_law_by_itself_and_names_it(file_log: Path) -> None:
    done = pamctl("replay", file_log)
    assert done.returncode == 65
    assert f"it was loaded from {file_log.with_name('my_law.py')}" in done.stderr
    assert "name that file with --controller-from" in done.stderr


@pytest.mark.long
def test_an_outside_law_can_be_compared_on_a_log_of_a_shipped_law(file_log: Path) -> None:
    gains = file_log.with_name("gains.yaml")
    gains.write_text("law: super_twisting\nlpf1_hz: 200\nlpf2_hz: 200\n")
    done = pamctl(
        *("replay", HOUSE / "tests/golden/qsmc.mcap", "--controller", gains, "--json"),
        *("--controller-from", file_log.with_name("my_law.py")),
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["law"]["law"] == "super_twisting"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "must define one Law, and defines none"),
        ("1 / 0", "cannot be loaded: ZeroDivisionError"),
        ("from pamctl.control.pid import LAW", "must define one Law, and defines none"),
    ],
)
def test_a_file_without_a_law_is_refused(text: str, says: str, tmp_path: Path) -> None:
    file = tmp_path / "law.py"
    file.write_text(text)
    done = pamctl("config", "show", "--controller-from", file)
    assert done.returncode == 2
    assert says in done.stderr


def test_gains_of_another_law_are_refused(file_log: Path) -> None:
    file = file_log.with_name("my_law.py")
    done = pamctl("config", "show", "--controller-from", file, "--controller", "pid")
    assert done.returncode == 2
    assert "defines the law 'super_twisting', but the gains file is for 'pid'" in done.stderr


# --- the record itself ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parts", "says"),
    [
        ({"name": "twist"}, "law: Literal"),
        ({"blended": frozenset({"k3"})}, "k3"),
        ({"armed": (0.0, 0.0)}, "armed"),
        ({"gains": tuple}, "gains"),
    ],
)
def test_a_record_whose_parts_do_not_fit_is_refused(parts: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        Law(**{**vars(super_twisting.LAW), **parts})
