"""Every command that the program prints can be typed: it parses, and names what there is."""

from __future__ import annotations

import ast
import re
import shlex
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from support.command_line import build_command

import hal
import pamctl
from pamctl.cli.verbs import EXAMPLES
from pamctl.diagnose.audit import find_separating_experiment, find_showing_experiment
from pamctl.diagnose.report.next_experiment import write_command
from pamctl.plant.catalogue import CATALOGUE
from pamctl.settings.config_files import find_config_file
from pamctl.settings.resolve import SECTIONS

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


def test_an_example_in_the_help_can_be_typed() -> None:
    for verb, examples in EXAMPLES.items():
        for words in map(shlex.split, examples):
            assert words[0] == "pamctl"
            found, rest = find_verb(words[1:])
            assert " ".join(words[1 : len(words) - len(rest)]) == verb
            found.make_context(found.name, rest)
            check_shipped(words)


def test_a_printed_command_can_be_typed() -> None:
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


def test_what_to_install_is_a_package_of_the_index_and_never_ours() -> None:
    """The name pamctl on the public index is not ours, and `.` is a checkout only by chance."""
    for package in (pamctl, hal):
        for path in sorted(Path(str(package.__file__)).parent.rglob("*")):
            if path.suffix in (".py", ".md"):
                assert not re.search(r"pip install '?(pamctl|\.)\[", path.read_text()), path


@pytest.mark.parametrize("verb", ["diagnose", "health"])
def test_a_verb_that_judges_data_takes_what_its_refusals_advise(verb: str) -> None:
    options = {name for parameter in find_verb([verb])[0].params for name in parameter.opts}
    assert {"--accept", "--noise"} <= options
