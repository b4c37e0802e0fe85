"""`--json` prints one document, for every ending of a verb."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.patience import PATIENCE_S
from typer.main import get_command

from pamctl.__main__ import main
from pamctl.cli import orders
from pamctl.cli.app import app


def verbs(command: Any, words: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Every verb that has `--json`, with the words that call it."""
    for name, inner in getattr(command, "commands", {}).items():
        yield from verbs(inner, (*words, name))
    if any("--json" in parameter.opts for parameter in command.params):
        yield words


VERBS = sorted(verbs(get_command(app)))
STEERED = [
    ("status",), ("start", "tracking-1"), ("stop",), ("estop",), ("ack",), ("disarm",),
    ("goto", "12mm"), ("set", "controller.eta=1"), ("mark", "here"), ("gains", "show"),
    ("gains", "load", "qsmc"),
]  # fmt: skip


class Ended:
    """How a verb ended: its code, the document, and what was on standard error."""

    def __init__(self, capsys: pytest.CaptureFixture[str], *arguments: str) -> None:
        with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as left:
            patch.setattr(sys, "argv", ["pamctl", *arguments])
            main()
        out, self.err = capsys.readouterr()
        self.code, self.document = left.value.code, json.loads(out)


def test_every_verb_that_steers_the_daemon_has_failure_documents() -> None:
    assert len(VERBS) > 25
    assert {verb[0] for verb in STEERED} <= {verb[0] for verb in VERBS}


@pytest.mark.parametrize("verb", VERBS, ids=" ".join)
def test_an_unknown_option_is_one_document(
    capsys: pytest.CaptureFixture[str], verb: tuple[str, ...]
) -> None:
    ended = Ended(capsys, *verb, "--json", "--no-such-option")
    assert ended.document == {
        "exit_code": 2,
        "reason": ended.document["reason"],
    }
    assert "--no-such-option" in ended.document["reason"]
    assert ended.code == 2
    assert "--no-such-option" in ended.err


@pytest.mark.parametrize(
    "arguments",
    [("--nope",), ("lgo",), ("log", "cut"), ("log", "cut", "a.mcap", "--out", "b.mcap"),
     ("run", "--jobs"), ("diagnose", "a.mcap", "--out", "b", "--minutes", "none"),
     ("watch", "--web", "--port", "1", "--every", "nan"), ("replay", "a.mcap", "--from", "-1")],
    ids=" ".join,
)  # fmt: skip
def test_wrong_arguments_are_one_line_like_every_other_error(
    capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...]
) -> None:
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as left:
        patch.setattr(sys, "argv", ["pamctl", *arguments])
        main()
    out, err = capsys.readouterr()
    assert (left.value.code, out) == (2, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1


@pytest.mark.parametrize("verb", STEERED, ids=" ".join)
def test_a_missing_daemon_is_one_document(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, verb: tuple[str, ...]
) -> None:
    ended = Ended(capsys, *verb, "--json", "--socket", str(tmp_path / "none.sock"))
    assert ended.code == ended.document["exit_code"] == 69
    assert "no daemon listens" in ended.document["reason"]
    assert ended.err == f"error: {ended.document['reason']}\n"


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("start", "nonsense"), 2),
        (("gains", "load", "nonsense"), 2),
        (("goto", "far away"), 2),
        (("goto", "1e400"), 2),
        (("goto", "12mm", "--in", "-3"), 2),
        (("config", "show", "--rig", "nonsense"), 2),
        (("run", "--set", "controller.eta=-1"), 78),
        (("doctor", "--rig", "nonsense"), 2),
        (("calibrate", "encoder", "--rig", "nonsense", "--out", "x.yaml"), 2),
    ],
    ids=str,
)
def test_a_wrong_value_is_one_document_with_a_reason(
    capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], code: int
) -> None:
    ended = Ended(capsys, *arguments, "--json")
    assert ended.code == ended.document["exit_code"] == code
    assert ended.document["reason"]


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("replay", "none.mcap"), 65),
        (("replay", "none.mcap", "--controller", "pid"), 65),
        (("compare", "none.mcap"), 65),
        (("report", "none.mcap"), 65),
        (("audit", "none.mcap"), 65),
        (("diagnose", "none.mcap", "--out", "out"), 65),
        (("log", "info", "none.mcap"), 65),
        (("log", "recover", "none.mcap", "new.mcap"), 65),
        (("log", "export", "none.mcap", "new.csv"), 65),
        (("log", "import", "none.csv", "new.mcap"), 65),
        (("log", "import", "none.csv", "new.mcap", "--map", "none.yaml"), 78),
        (("reproduce", "fig9", "--out", "out"), 2),
        (("tune", "--law", "qsmc", "--out", "no/such/place.yaml"), 2),
        (("run", "--fast", "--log", "no/such/place.mcap"), 2),
        (("safe", "--backend", "nidaq"), 69),
        (("calibrate", "valve", "--backend", "nidaq", "--out", "x.yaml", "--yes"), 69),
        (("daemon", "--logs", "/proc/none"), 2),
        (("watch", "--web", "--port", "1"), 2),
    ],
    ids=lambda part: " ".join(part[:2]) if isinstance(part, tuple) else str(part),
)
def test_an_error_of_any_module_is_one_document_and_one_line(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    arguments: tuple[str, ...],
    code: int,
) -> None:
    monkeypatch.chdir(tmp_path)
    ended = Ended(capsys, *arguments, "--json")
    assert ended.code == ended.document["exit_code"] == code
    assert ended.document["reason"]
    assert "Traceback" not in ended.err


@pytest.mark.parametrize(
    ("arguments", "typed"),
    [
        (("audit", "nope"), "'nope': there is no such experiment"),
        (("start", "nope"), "'nope': there is no such experiment"),
        (("gains", "load", "nope"), "'nope': there is no such controller"),
        (("tune", "--check", "nope"), "--check nope: there is no such controller"),
    ],
    ids=str,
)
def test_an_unknown_name_is_reported_as_it_was_typed(
    capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], typed: str
) -> None:
    ended = Ended(capsys, *arguments, "--json")
    assert ended.code == 2
    assert typed in ended.document["reason"]
    assert "--experiment" not in ended.err
    assert "--controller" not in ended.err


@pytest.mark.parametrize(
    ("arguments", "option", "told"),
    [
        (("goto", "12mm", "--in", "1e300"), "--in", "must be more than 0 and at most 3600 s"),
        (("goto", "12mm", "--in", "0"), "--in", "must be more than 0 and"),
        (("goto", "12mm", "--in", "nan"), "--in", "must be finite"),
        (("start", "tracking-1", "--duration", "nan"), "--duration", "must be finite"),
        (("start", "tracking-1", "--duration", "0"), "--duration", "must be more than 0 s"),
        (("set", "controller.eta=1", "--ramp", "nan"), "--ramp", "must be finite"),
        (("gains", "load", "qsmc", "--ramp", "nan"), "--ramp", "must be finite"),
        (
            ("gains", "load", "qsmc", "--ramp", "61"),
            "--ramp",
            "must be at least 0 and at most 60 s",
        ),
        (("daemon", "--idle-after", "nan"), "--idle-after", "must be finite"),
        (("daemon", "--idle-after", "0.5"), "--idle-after", "must be at least 1 s (got 0.5)"),
        (("mark", ""), "text", "must have 1 to 2000 characters (got 0)"),
        (("mark", "x" * 2001), "text", "must have 1 to 2000 characters (got 2001)"),
    ],
    ids=lambda part: part[0] if isinstance(part, tuple) else str(part),
)
def test_a_value_out_of_its_limits_is_refused_before_the_daemon_is_asked(
    capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], option: str, told: str
) -> None:
    ended = Ended(capsys, *arguments, "--json")
    assert ended.code == 2
    assert f"'{option}'" in ended.document["reason"].lower()
    assert told in ended.document["reason"]


def test_ctrl_c_is_a_document(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_ctrl_c_during_the_start_is_an_exit_code_and_no_traceback() -> None:
    command = [sys.executable, "-c", IMPATIENT, "status"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def test_an_unexpected_error_is_a_document_and_a_traceback(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("ours")

    monkeypatch.setattr(orders, "ask", broken)
    monkeypatch.setattr(sys, "argv", ["pamctl", "status", "--json"])
    with pytest.raises(RuntimeError):
        main()
    assert json.loads(capsys.readouterr().out) == {"exit_code": 1, "reason": "RuntimeError: ours"}
