"""Help, advice that can be typed, and verbs that start at once."""

import ast
import re
import shlex
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from support.command_line import build_command, run_process
from support.small_log import write_small
from typer.main import get_command
from typer.testing import CliRunner

import hal
import pamctl
from pamctl.base.errors import ExitCode
from pamctl.cli.app import app, build_app, build_asked
from pamctl.cli.verbs import EXAMPLES
from pamctl.diagnose.audit import find_separating_experiment, find_showing_experiment
from pamctl.diagnose.report.next_experiment import write_command
from pamctl.plant.catalogue import CATALOGUE
from pamctl.settings.config_files import find_config_file
from pamctl.settings.resolve import SECTIONS

PANELS = ("Run", "Daemon", "Analyse", "Tune", "Rig", "Logs", "Other")
FRAGMENT = re.compile(
    r"(^(Of|For|As|Else|And|Or|With|Without|Where|By)\b)|([;:,(]|\.\.\.| of| the)$|repeats"
)
"""Beginnings and ends of help texts that are not full phrases."""


def commands(command: Any, words: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Every verb and group with the words that call it."""
    yield " ".join(words), command
    for name, inner in getattr(command, "commands", {}).items():
        yield from commands(inner, (*words, name))


COMMANDS = dict(commands(get_command(app)))
PARAMETERS = {
    f"{words} {parameter.opts[0]}": parameter
    for words, command in COMMANDS.items()
    for parameter in command.params
    if not parameter.opts[0].endswith("-completion")  # typer's own
}


def test_every_parameter_says_what_it_is_in_a_phrase():
    for name, parameter in PARAMETERS.items():
        told = parameter.help or ""
        # An argument may be one noun beside its name: "New log".
        least = 3 if parameter.param_type_name == "option" else 2
        assert len(told.split()) >= least, name
        assert told[0].isupper(), name
        assert not told.endswith("."), name
        assert not FRAGMENT.search(told), name


def test_every_optional_parameter_shows_its_default():
    for name, parameter in PARAMETERS.items():
        if parameter.required or getattr(parameter, "is_flag", False):
            continue
        if parameter.default is None:  # the verb chooses: the help says what
            assert isinstance(parameter.show_default, str), name
            assert parameter.show_default, name
        else:
            assert parameter.show_default is True, name


def test_every_time_shows_its_range():
    for name, parameter in PARAMETERS.items():
        if parameter.metavar != "SECONDS" or parameter.opts[0] in ("--from", "--to"):
            continue
        told = re.search(r"(at least|more than) [\d.]+( and at most [\d.]+)? s", parameter.help)
        assert told or parameter.min is not None, name


@pytest.mark.parametrize("words", COMMANDS)
def test_every_verb_says_what_it_does_in_a_sentence(words):
    told = COMMANDS[words].help
    assert len(told.split()) >= 4, told
    assert told[0].isupper()
    assert told.rstrip().endswith(".")
    done = CliRunner().invoke(app, [*words.split(), "--help"])
    assert done.exit_code == 0
    assert told.split()[0] in done.output
    if words and not hasattr(COMMANDS[words], "commands"):
        assert "Examples:" in done.output
        assert f"pamctl {words}" in done.output
        assert "Exit codes: 0 ok" in done.output


def test_the_verbs_are_grouped_and_the_end_says_what_is_shipped():
    assert {command.rich_help_panel for command in COMMANDS[""].commands.values()} == set(PANELS)
    told = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "100"}).output
    places = [told.index(f"\u2500 {panel} ") for panel in PANELS]
    assert places == sorted(places)
    for code in ExitCode:
        assert re.search(rf"\b{int(code)}\b", told[told.index("Exit codes") :])
    assert "tracking-2" in told


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_can_complete_verbs(shell):
    environment = {
        "_PAMCTL_COMPLETE": f"complete_{shell}", "COMP_WORDS": "pamctl wat", "COMP_CWORD": "1",
        "_TYPER_COMPLETE_ARGS": "pamctl wat", "_TYPER_COMPLETE_FISH_ACTION": "get-args",
    }  # fmt: skip
    done = CliRunner().invoke(app, [], env=environment, prog_name="pamctl")
    assert "watch" in done.output


@pytest.mark.parametrize(
    ("verb", "shown"),
    [
        ("run", "[default: (tracking-2)]"),
        ("set", "at least 0 and at most 60 s"),
        ("goto", "more than 0 and at most 3600 s"),
        ("daemon", "[default: 600.0]"),
        ("doctor", "at least 0.1 and at most 600 s"),
        ("tune", "2<=x<=1000"),
    ],
)
def test_the_whole_help_text_reaches_the_terminal(verb, shown):
    done = CliRunner().invoke(app, [verb, "--help"], terminal_width=200, env={"COLUMNS": "200"})
    assert shown in " ".join(done.output.replace("│", " ").split())


def test_the_last_word_of_a_verb_of_two_words_is_answered_with_the_whole_verb():
    done = CliRunner().invoke(app, ["import", "data.csv"])
    assert done.exit_code == ExitCode.USAGE
    assert "did you mean `pamctl log import`?" in done.output


# --- a light start -------------------------------------------------------------------------------

HEAVY = {"asyncio", "google", "mcap", "multiprocessing", "numba", "numpy", "pydantic", "rich",
         "scipy", "yaml"}  # fmt: skip
SHOW_IMPORTS = """
import sys
from pamctl.__main__ import main
sys.argv = ["pamctl", *sys.argv[1:]]
try:
    main()
finally:
    print("imported:", *{name.partition(".")[0] for name in sys.modules}, file=sys.stderr)
"""


def list_heavy_imports(*arguments: str) -> set[str]:
    done = run_process([sys.executable, "-c", SHOW_IMPORTS, *arguments])
    assert "Traceback" not in done.stderr
    return HEAVY & set(done.stderr.rpartition("imported:")[2].split())


@pytest.mark.parametrize("arguments", [["--help"], ["nosuch"], ["diagnose", "--help"]])
def test_help_and_advice_import_no_verb(arguments):
    assert list_heavy_imports(*arguments) <= {"rich"}


@pytest.mark.parametrize("verb", ["status", "estop"])
def test_a_verb_of_the_daemon_imports_no_model_and_no_algebra(verb, tmp_path):
    assert list_heavy_imports(verb, "--socket", str(tmp_path / "none.sock")) == set()


def test_a_look_into_a_log_imports_no_settings(tmp_path):
    log = write_small(tmp_path / "small.mcap")
    assert list_heavy_imports("log", "info", str(log)) == {"google", "mcap", "numpy"}


def test_the_help_of_the_whole_says_what_each_verb_says_of_itself():
    wide = {"COLUMNS": "200"}
    by_name = CliRunner().invoke(build_asked(["--help"]), ["--help"], env=wide)
    in_full = CliRunner().invoke(build_app(), ["--help"], env=wide)
    assert by_name.output == in_full.output
    assert "Move the muscle" in by_name.output


def test_a_verb_after_the_end_of_options_is_carried_out():
    done = run_process([sys.executable, "-m", "pamctl", "--", "manual"])
    assert done.returncode == 0
    assert "first-run" in done.stdout


# --- advice --------------------------------------------------------------------------------------

COMMAND = re.compile(r"`pamctl ([^`]*)`|next: pamctl ([^`;#\n]*)")
SHIPPED = {f"--{section}": section for section in SECTIONS} | {"--start": "controller"}


NAMED_ALONE = ("diagnose", "compare", "tune", "health", "plant new", "start")
"""What a text may name without its arguments: `pamctl compare` works on it."""


def texts_of(tree: ast.AST) -> Iterator[str]:
    """Every text of a module but docstrings; what is filled in is the word FILLED."""
    if isinstance(tree, ast.JoinedStr):
        parts = (p.value if isinstance(p, ast.Constant) else "FILLED" for p in tree.values)
        yield "".join(map(str, parts))
    elif isinstance(tree, ast.Constant):
        yield str(tree.value)
    elif not (isinstance(tree, ast.Expr) and isinstance(tree.value, ast.Constant)):
        for part in ast.iter_child_nodes(tree):
            yield from texts_of(part)


def printed_commands() -> Iterator[tuple[str, str]]:
    for package in (pamctl, hal):
        for path in sorted(Path(str(package.__file__)).parent.rglob("*.py")):
            source = path.read_text()
            for text in texts_of(ast.parse(source)) if "pamctl " in source else ():
                for found in COMMAND.finditer(text):
                    command = (found[1] or found[2] or "").strip()
                    if command and command.split()[0].isalpha():
                        yield path.stem, command
    for name, effect in CATALOGUE.items():
        for experiment in (
            find_showing_experiment(name),
            *(find_separating_experiment((name, other)) for other in effect.told_from),
        ):
            if experiment["name"]:
                yield (
                    f"effect {name}",
                    write_command(str(experiment["name"])).removeprefix("pamctl "),
                )


def find_verb(words: list[str]) -> tuple[Any, list[str]]:
    """The verb that words call, and the words after it."""
    command = build_command()
    while hasattr(command, "commands"):
        if command.invoke_without_command and (not words or words[0] not in command.commands):
            break
        assert words, f"{command.name} alone does nothing"
        assert words[0] in command.commands, f"there is no verb {words[0]}"
        command, words = command.commands[words[0]], words[1:]
    return command, words


def check_shipped(words: list[str]) -> None:
    """Check that a name that a command gives to an option is that of a shipped file."""
    for option, value in pairwise(words):
        if option in SHIPPED and not value.endswith((".yaml", ".py")) and "FILLED" not in value:
            assert find_config_file(SHIPPED[option], value).is_file()


def test_an_example_in_the_help_can_be_typed():
    for verb, examples in EXAMPLES.items():
        for words in map(shlex.split, examples):
            assert words[0] == "pamctl"
            found, rest = find_verb(words[1:])
            assert " ".join(words[1 : len(words) - len(rest)]) == verb
            found.make_context(found.name, rest)
            check_shipped(words)


def test_a_printed_command_can_be_typed():
    commands = sorted(set(printed_commands()))
    verbs = {command.split()[0] for _, command in commands}
    assert verbs >= {"run", "tune", "diagnose", "log", "doctor", "calibrate", "safe", "ack"}
    assert len(commands) > 20
    wrong = []
    for where, command in commands:
        words = shlex.split(command, comments=True)
        try:
            verb, rest = find_verb(words)
            if rest or " ".join(words) not in NAMED_ALONE:
                verb.make_context(verb.name, rest)
            check_shipped(words)
        except Exception as error:
            wrong.append(f"{where}: pamctl {command}: {error}")
    assert not wrong


def test_what_to_install_is_a_package_of_the_index_and_never_ours():
    """The name pamctl on the public index is not ours, and `.` is a checkout only by chance."""
    for package in (pamctl, hal):
        for path in sorted(Path(str(package.__file__)).parent.rglob("*")):
            if path.suffix in (".py", ".md"):
                assert not re.search(r"pip install '?(pamctl|\.)\[", path.read_text()), path


@pytest.mark.parametrize("verb", ["diagnose", "health"])
def test_a_verb_that_judges_data_takes_what_its_refusals_advise(verb):
    options = {name for parameter in find_verb([verb])[0].params for name in parameter.opts}
    assert {"--accept", "--noise"} <= options
