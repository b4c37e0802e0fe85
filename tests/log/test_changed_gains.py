"""Gains that were changed are shown as changed wherever they have the file's name."""

import json

from support.command_line import run_pamctl

from pamctl.live.feed import format_status
from pamctl.log import read
from pamctl.log.run_meta import describe_changes, describe_running_changes
from pamctl.session.simulated_rig import simulate

CHANGED = "qsmc*, lambda_per_s 60 (file 37.82)"


def test_only_what_differs_is_named():
    assert describe_changes({"a": 1.0, "b": "x"}, {"a": 1.0, "b": "x"}) == ""
    assert describe_changes({"a": 2.0, "b": "x", "c": 3}, {"a": 1.0, "b": "x"}) == (
        "a 2 (file 1), c 3 (file none)"
    )
    beside = {"tick": 1, "from_t_s": 0.1, "ramp_s": 0.5}
    assert describe_running_changes([{"a": 1.0}, {"a": 2.0, **beside}]) == "a 1 to 2"
    assert describe_running_changes([{"a": 1.0}, {"a": 1.0, **beside}]) is None


def test_a_run_with_changed_gains_says_so_in_info_and_report(tmp_path):
    log = tmp_path / "a.mcap"
    options = ["--fast", "--duration", "1", "--set", "rig.homing.enabled=false"]
    pamctl("run", *options, "--log", str(log), "--set", "controller.lambda_per_s=60")
    assert CHANGED in pamctl("log", "info", str(log))
    told = json.loads(pamctl("log", "info", str(log), "--json"))
    assert (told["controller"], told["controller_changes"]) == (
        "qsmc",
        "lambda_per_s 60 (file 37.82)",
    )
    pamctl("report", str(log), "--out", str(tmp_path / "a.html"))
    assert CHANGED in (tmp_path / "a.html").read_text(encoding="utf-8")
    plain = tmp_path / "b.mcap"
    pamctl("run", *options, "--log", str(plain))
    assert "*" not in pamctl("log", "info", str(plain))


def test_a_session_says_what_was_set_until_a_file_is_loaded(tmp_path):
    with simulate(logs=tmp_path, overrides=["rig.homing.enabled=false"]) as rig:
        rig.set(lambda_per_s=60, ramp_s=0.1)
        assert CHANGED in format_status(rig.status())
        rig.goto(8e-3, within_s=0.5)
        log = rig.status()["log"]
        gains = rig.set(lambda_per_s=50, ramp_s=0.2)
        assert "lambda_per_s 50 (file 37.82)" in format_status(rig.status())
        rig._ask("load", controller=gains, name="mine", ramp_s=0.1)
        assert "controller: mine\n" in format_status(rig.status())
    ran = read(log)
    assert ran.metadata["run"]["controller_changes"] == "lambda_per_s 60 (file 37.82)"
    told = pamctl("log", "info", log)
    assert CHANGED in told
    assert "lambda_per_s 60 to 50" in told
    pamctl("report", log, "--out", str(tmp_path / "page.html"))
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    changed = page[page.index("gains changed while it ran") :].partition("</tr>")[0]
    assert "lambda_per_s 60 to 50" in changed
    assert "ramp_s" not in changed


def pamctl(*arguments: str) -> str:
    done = run_pamctl(*arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout
