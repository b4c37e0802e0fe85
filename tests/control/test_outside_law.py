"""Laws of another package or from a file work like the shipped laws.

The package is `support/super_twisting.py` with an entry point; every process of a run must find it.
"""

import hashlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from support import super_twisting
from support.command_line import run_pamctl
from support.outside_law import HOUSE, SOURCE, Elsewhere, install_law

from pamctl.control.law import Law
from pamctl.log import read

SHORT = ("--fast", "--set", "rig.homing.enabled=false")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Elsewhere]:
    folder = tmp_path_factory.mktemp("site")
    install_law(folder)
    with Elsewhere(folder) as process:
        yield process


@pytest.fixture(scope="module")
def gains(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("gains") / "twisting.yaml"
    path.write_text("law: super_twisting\nk1: 0.3\n")
    return path


@pytest.fixture(scope="module")
def log(site: Elsewhere, gains: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    parts = [
        {"kind": "move", "to_mm": 3, "duration_s": 1},
        {"kind": "gains", "set": {"k1": 0.4}, "ramp_s": 0.2},
        {"kind": "pause", "duration_s": 2},
    ]
    motion = path.with_name("motion.yaml")
    motion.write_text(json.dumps({"kind": "sequence", "parts": parts}))
    done = site("run", *SHORT, "--controller", gains, "--experiment", motion, "--log", path)
    assert done.returncode == 0, done.stderr
    return path


def test_the_log_of_an_outside_law_names_package_and_version_and_source(log):
    ran = read(log)
    record = ran.metadata["law"]
    assert record["package"] == "super-twisting-law"
    assert record["version"] == "1.2"
    assert record["sha256"] == hashlib.sha256(SOURCE.read_bytes()).hexdigest()
    assert ran.config["controller"]["k1"] == 0.3
    assert {"law.twist_v", "law.surface"} <= ran.keyframes[0]["state"].keys()


def test_gains_of_an_outside_law_change_during_a_run_and_its_unit_does_not(log, site, gains):
    assert [said["k1"] for said in read(log).gains] == [0.3, 0.4]
    motion, unit = log.with_name("motion.yaml"), "experiment.parts.1.set={length_unit: inch}"
    done = site("run", "--dry-run", "--controller", gains, "--experiment", motion, "--set", unit)
    assert done.returncode == 78
    assert "another length_unit takes effect with" in done.stderr


@pytest.mark.long
def test_the_log_of_an_outside_law_replays_to_the_bit_from_any_keyframe(log, site):
    for begin in ([], ["--from", "2.5"]):
        done = site("replay", log, "--json", *begin)
        assert done.returncode == 0, done.stderr
        found = json.loads(done.stdout)
        assert found["equal"]
        assert "keyframe.law.twist_v" in found["fields"]
        assert found["law_change"] is None


def test_a_replay_without_the_package_names_it(log):
    done = run_pamctl("replay", log)
    assert done.returncode == 65
    assert "install the package super-twisting-law 1.2" in done.stderr


def test_a_replay_warns_where_the_source_has_changed(log, tmp_path):
    install_law(tmp_path)
    with (tmp_path / SOURCE.name).open("a") as file:
        file.write("# another version\n")
    with Elsewhere(tmp_path) as site:
        done = site("replay", log, "--plain", "--from", "2.5")
    assert done.returncode == 0, done.stderr
    assert "warning: the source of the law 'super_twisting' is not the one" in done.stdout


def test_the_report_names_its_terms_with_and_without_the_package(log, site, tmp_path):
    for page, pamctl in ((tmp_path / "with.html", site), (tmp_path / "without.html", run_pamctl)):
        done = pamctl("report", log, "--out", page)
        assert done.returncode == 0, done.stderr
        text = page.read_text()
        for words in ("Super-twisting: u = -k_1", "u_root", "v_twist, integral of the sign"):
            assert words in text
        assert "u_eq" not in text


@pytest.mark.long
def test_tune_finds_gains_of_an_outside_law_and_writes_its_equation(site, tmp_path):
    out = tmp_path / "sought.yaml"
    motion = tmp_path / "motion.yaml"
    motion.write_text("kind: hold\nposition_mm: 3\ntransition_s: 1\nhold_s: 1\n")
    small = ("--plant", "paper", "--experiment", motion, "--generations", "1", "--jobs", "1")
    done = site("tune", "--law", "super_twisting", *small, "--out", out)
    assert done.returncode == 0, done.stderr
    assert "# Super-twisting: u = -k_1 |s|^(1/2) sign(s) + v" in out.read_text()
    assert site("config", "check", out).returncode == 0


def test_keys_of_an_outside_law_are_checked_like_those_of_a_shipped_law(site, tmp_path):
    file = tmp_path / "wrong.yaml"
    file.write_text("law: super_twisting\nk_1: 0.3\nk2_v_per_s: -1\n")
    done = site("run", "--controller", file)
    assert done.returncode == 78
    assert f"{file}:2:1: controller.k_1: unknown key; did you mean 'k1'?" in done.stderr
    assert f"{file}:3:1: controller.k2_v_per_s: must be at least 0 (got -1)" in done.stderr


def test_without_its_package_a_gains_file_is_refused_with_the_laws_there_are(gains):
    done = run_pamctl("run", "--controller", gains)
    assert done.returncode == 78
    assert "must be 'qsmc', 'smc' or 'pid' (got 'super_twisting')" in done.stderr


def test_a_broken_package_removes_only_its_own_law(gains, tmp_path):
    install_law(tmp_path, "super_twisting = super_twisting:MISSING")
    with Elsewhere(tmp_path) as site:
        assert site("config", "check").returncode == 0
        done = site("run", "--controller", gains)
    assert done.returncode == 78
    assert "the package super-twisting-law offers it, but cannot be used" in done.stderr


# --- a law from a file ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def other() -> Iterator[Elsewhere]:
    """A process that loads laws from files."""
    with Elsewhere() as process:
        yield process


@pytest.fixture(scope="module")
def file_log(other: Elsewhere, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("file")
    shutil.copy(SOURCE, folder / "my_law.py")
    path = folder / "run.mcap"
    done = other(
        "run",
        *SHORT,
        "--duration",
        "1",
        "--controller-from",
        f"{folder}/my_law.py:LAW",
        "--log",
        path,
    )
    assert done.returncode == 0, done.stderr
    return path


@pytest.mark.long
def test_a_law_from_a_file_runs_with_its_defaults_and_replays(other, file_log):
    ran, file = read(file_log), file_log.with_name("my_law.py")
    assert ran.metadata["law"]["file"] == str(file)
    assert ran.metadata["law"]["sha256"] == hashlib.sha256(SOURCE.read_bytes()).hexdigest()
    assert ran.metadata["run"]["controller"] == "super_twisting"
    assert ran.config["controller"]["k1"] == 0.25
    done = other("replay", file_log, "--plain", "--controller-from", file)
    assert done.returncode == 0, done.stderr
    assert ": equal," in done.stdout


def test_a_replay_does_not_load_the_file_of_a_law_by_itself_and_names_it(file_log):
    done = run_pamctl("replay", file_log)
    assert done.returncode == 65
    assert f"it was loaded from {file_log.with_name('my_law.py')}" in done.stderr
    assert "name that file with --controller-from" in done.stderr


@pytest.mark.long
def test_an_outside_law_can_be_compared_on_a_log_of_a_shipped_law(other, file_log):
    gains = file_log.with_name("gains.yaml")
    gains.write_text("law: super_twisting\nlpf1_hz: 200\nlpf2_hz: 200\n")
    done = other(
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
def test_a_file_without_a_law_is_refused(text, says, tmp_path):
    file = tmp_path / "law.py"
    file.write_text(text)
    done = run_pamctl("config", "show", "--controller-from", file)
    assert done.returncode == 2
    assert says in done.stderr


def test_gains_of_another_law_are_refused(other, file_log):
    file = file_log.with_name("my_law.py")
    done = other("config", "show", "--controller-from", file, "--controller", "pid")
    assert done.returncode == 2
    assert "defines the law 'super_twisting', but the gains file is for 'pid'" in done.stderr


def test_a_law_without_a_search_space_is_not_tuned(other, tmp_path):
    file = tmp_path / "plain.py"
    named = SOURCE.read_text().replace('"super_twisting"', '"plain_twisting"')
    file.write_text(named + "\nLAW = LAW.__class__(**{**vars(LAW), 'search': None})\n")
    done = other("tune", "--controller-from", file, "--out", tmp_path / "gains.yaml")
    assert done.returncode == 2
    assert "defines no search space" in done.stderr


def test_a_law_without_default_gains_says_how_to_give_them(other, tmp_path):
    file = tmp_path / "bare.py"
    bare = SOURCE.read_text().replace("Field(gt=0, le=440)] = 400.0", "Field(gt=0, le=440)]")
    file.write_text(bare.replace('"super_twisting"', '"bare_twisting"'))
    done = other("run", "--dry-run", "--controller-from", file)
    assert done.returncode != 0
    assert "give the gains with --controller GAINS.yaml" in done.stderr


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
def test_a_record_whose_parts_do_not_fit_is_refused(parts, says):
    with pytest.raises(ValueError, match=says):
        Law(**{**vars(super_twisting.LAW), **parts})
