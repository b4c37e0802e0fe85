"""`--json` prints one document, for every ending of a verb."""

import json
import sys
from collections.abc import Iterator
from typing import Any

import pytest
from support.command_line import build_command, run_process

from pamctl.__main__ import main
from pamctl.cli import orders


def verbs(command: Any, words: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Every verb that has `--json`, with the words that call it."""
    for name, inner in getattr(command, "commands", {}).items():
        yield from verbs(inner, (*words, name))
    if any("--json" in parameter.opts for parameter in command.params):
        yield words


VERBS = sorted(verbs(build_command()))
STEERED = (
    "status", "start tracking-1", "stop", "estop", "ack", "disarm", "goto 12mm",
    "set controller.eta=1", "mark here", "gains show", "gains load qsmc",
)  # fmt: skip


class Ended:
    """How a verb ended: its code, the document, and what was on standard error."""

    def __init__(self, capsys: pytest.CaptureFixture[str], *arguments: str) -> None:
        with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as left:
            patch.setattr(sys, "argv", ["pamctl", *arguments])
            main()
        out, self.err = capsys.readouterr()
        assert "Traceback" not in self.err, arguments
        self.code, self.document = left.value.code, json.loads(out)
        assert self.code == self.document["exit_code"], arguments


def test_an_unknown_option_is_one_document(capsys):
    assert len(VERBS) > 25
    for verb in VERBS:
        ended = Ended(capsys, *verb, "--json", "--no-such-option")
        assert ended.document == {"exit_code": 2, "reason": ended.document["reason"]}
        assert "--no-such-option" in ended.document["reason"], verb
        assert "--no-such-option" in ended.err


@pytest.mark.parametrize(
    "arguments",
    [("--nope",), ("lgo",), ("log", "cut"), ("log", "cut", "a.mcap", "--out", "b.mcap"),
     ("run", "--jobs"), ("diagnose", "a.mcap", "--out", "b", "--minutes", "none"),
     ("watch", "--web", "--port", "1", "--every", "nan"), ("replay", "a.mcap", "--from", "-1")],
    ids=" ".join,
)  # fmt: skip
def test_wrong_arguments_are_one_line_like_every_other_error(capsys, arguments):
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as left:
        patch.setattr(sys, "argv", ["pamctl", *arguments])
        main()
    out, err = capsys.readouterr()
    assert (left.value.code, out) == (2, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1


def test_a_missing_daemon_is_one_document(capsys, tmp_path):
    assert {verb.split()[0] for verb in STEERED} <= {verb[0] for verb in VERBS}
    for verb in STEERED:
        ended = Ended(capsys, *verb.split(), "--json", "--socket", str(tmp_path / "none.sock"))
        assert ended.code == 69, verb
        assert "no daemon listens" in ended.document["reason"], verb
        assert ended.err == f"error: {ended.document['reason']}\n", verb


FAILURES = """
2  start nonsense                             'nonsense': there is no such experiment
2  audit nonsense                             'nonsense': there is no such experiment
2  gains load nonsense                        'nonsense': there is no such controller
2  tune --check nonsense                      --check nonsense: there is no such controller
2  goto faraway                               faraway
2  goto 1e400                                 1e400
2  goto 12mm --in -3                          '--in'
2  goto 12mm --in 1e300                       '--in': must be more than 0 and at most 3600 s
2  goto 12mm --in 0                           '--in': must be more than 0 and
2  goto 12mm --in nan                         '--in': must be finite
2  start tracking-1 --duration nan            '--duration': must be finite
2  start tracking-1 --duration 0              '--duration': must be more than 0 s
2  set controller.eta=1 --ramp nan            '--ramp': must be finite
2  gains load qsmc --ramp nan                 '--ramp': must be finite
2  gains load qsmc --ramp 61                  '--ramp': must be at least 0 and at most 60 s
2  daemon --idle-after nan                    '--idle-after': must be finite
2  daemon --idle-after 0.5                    '--idle-after': must be at least 1 s (got 0.5)
2  daemon --logs /proc/none                   /proc/none
2  config show --rig nonsense                 nonsense
78 run --set controller.eta=-1                controller.eta
2  run --fast --log no/such/place.mcap        no/such
2  doctor --rig nonsense                      nonsense
2  calibrate encoder --rig nonsense --out x   nonsense
69 calibrate valve --backend nidaq --out x.yaml --yes
69 safe --backend nidaq
65 replay none.mcap                           none.mcap
65 replay none.mcap --controller pid          none.mcap
65 compare none.mcap                          none.mcap
65 report none.mcap                           none.mcap
65 audit none.mcap                            none.mcap
65 diagnose none.mcap --out out               none.mcap
65 log info none.mcap                         none.mcap
65 log recover none.mcap new.mcap             none.mcap
65 log export none.mcap new.csv               none.mcap
65 log import none.csv new.mcap               none.csv
78 log import none.csv new.mcap --map none.yaml   none.yaml
2  reproduce fig9 --out out                   fig9
2  tune --law qsmc --out no/such/place.yaml   no/such
2  watch --web --port 1
"""
"""Code, verb, and what is said, after two spaces."""


def test_an_error_of_any_module_is_one_document_with_its_reason(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for line in FAILURES.strip().splitlines():
        code, _, rest = line.partition(" ")
        verb, _, told = rest.strip().partition("  ")
        ended = Ended(capsys, *verb.split(), "--json")
        reason = ended.document["reason"]
        assert ended.code == int(code), verb
        assert reason, verb
        assert told.strip() in reason, (verb, reason)
        for option in ("--experiment", "--controller"):  # what was typed is told, no other name
            assert option not in ended.err or option in verb, verb
        assert not list(tmp_path.iterdir()), verb
    for text in ("", "x" * 2001):
        told = f"must have 1 to 2000 characters (got {len(text)})"
        assert told in Ended(capsys, "mark", text, "--json").document["reason"]


def test_ctrl_c_is_a_document(capsys, monkeypatch):
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(orders, "ask", interrupted)
    ended = Ended(capsys, "status", "--json")
    assert ended.document == {"exit_code": 130, "reason": "interrupted"}


IMPATIENT = """
import os, signal, sys

class Typer:
    def find_spec(self, name, *_):
        if name == "typer":  # Ctrl-C here: Python turns it into another error
            class Key:
                def __set_name__(self, owner, name):
                    os.kill(os.getpid(), signal.SIGINT)
            type("Built", (), {"key": Key()})

sys.meta_path.insert(0, Typer())
from pamctl.__main__ import main
main()
"""


def test_ctrl_c_during_the_start_is_an_exit_code_and_no_traceback():
    command = [sys.executable, "-c", IMPATIENT, "status"]
    done = run_process(command)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def test_an_unexpected_error_is_a_document_and_a_traceback(capsys, monkeypatch):
    def broken(*_: object) -> None:
        raise RuntimeError("ours")

    monkeypatch.setattr(orders, "ask", broken)
    monkeypatch.setattr(sys, "argv", ["pamctl", "status", "--json"])
    with pytest.raises(RuntimeError):
        main()
    assert json.loads(capsys.readouterr().out) == {"exit_code": 1, "reason": "RuntimeError: ours"}
