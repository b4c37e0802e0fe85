"""The layout of the source: small folders, unique names, verbs for functions."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
from collections import defaultdict
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MODULES = sorted(path for room in ("pamctl", "hal") for path in (ROOT / room).rglob("*.py"))
PACKAGES = [path for path in MODULES if path.name == "__init__.py"]
MOST_MODULES_IN_A_FOLDER = 16
TOP_LEVEL = {
    ".ci", ".gitignore", ".readme", "LICENSE", "README.md", "config", "hal", "pamctl",
    "pyproject.toml", "scripts", "tests",
}  # fmt: skip
PARTICIPLES = {
    "asked", "begun", "built", "chosen", "composed", "concluded", "corrected", "described",
    "done", "drawn", "driven", "examined", "extended", "fed", "fitted", "forgotten", "found",
    "given", "handed", "heard", "held", "kept", "known", "laid", "logged", "looked", "made",
    "measured", "named", "noted", "opened", "ordered", "paired", "parsed", "picked", "planned",
    "ranked", "recorded", "refused", "rounded", "said", "seen", "sent", "settled", "shown",
    "simulated", "stored", "taken", "told", "tried", "turned", "unpacked", "walked", "weighed",
    "written",
}  # fmt: skip
"""What a function returned was once its name; a function is named by what it does."""


@pytest.mark.skipif(
    shutil.which("git") is None or not (ROOT / ".git").exists(), reason="needs a git clone"
)
def test_nothing_stray_lies_at_the_top_level() -> None:
    command = ["git", "-C", str(ROOT), "ls-files"]
    listed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    assert {line.split("/")[0] for line in listed.splitlines()} == TOP_LEVEL


def _name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


@cache
def _trees() -> list[tuple[Path, ast.Module]]:
    return [(path, ast.parse(path.read_text(encoding="utf-8"))) for path in MODULES]


def _require_unique(places: dict[str, list[str]]) -> None:
    doubled = {name: where for name, where in places.items() if len(where) > 1}
    assert not doubled


def test_no_folder_holds_too_many_modules() -> None:
    folders: dict[str, int] = defaultdict(int)
    for path in MODULES:
        folders[_name_of(path.parent)] += path.name != "__init__.py"
    crowded = {name: count for name, count in folders.items() if count > MOST_MODULES_IN_A_FOLDER}
    assert not crowded


def test_no_two_modules_share_a_name() -> None:
    """A verb of the command line may be called as the room that does its work.

    `kernel.build` builds machine code, `settings.build` what settings ask for.
    """
    places: dict[str, list[str]] = defaultdict(list)
    for path in MODULES:
        if path.stem == "build":
            continue
        if not path.name.startswith("__") and (ROOT / "pamctl" / "cli") not in path.parents:
            places[path.stem].append(_name_of(path))
    _require_unique(places)


def test_no_two_public_types_share_a_name() -> None:
    places: dict[str, list[str]] = defaultdict(list)
    for path, tree in _trees():
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(_name_of(path))
    _require_unique(places)


def test_each_folder_says_what_it_is_and_where_to_begin() -> None:
    for path in PACKAGES:
        text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        advice = re.search(r"Read `([^`]+)`", text)
        assert advice, f"{_name_of(path)}: add the line: Read `FILE` first."
        assert (path.parent / advice[1]).exists(), f"{_name_of(path)}: there is no {advice[1]}"


def test_public_functions_are_verbs() -> None:
    wrong = [
        f"{_name_of(path)}: {node.name}"
        for path, tree in _trees()
        for room in (tree, *(node for node in tree.body if isinstance(node, ast.ClassDef)))
        for node in room.body
        if isinstance(node, ast.FunctionDef)
        and not any(isinstance(d, ast.Name) and "property" in d.id for d in node.decorator_list)
        and node.name in PARTICIPLES
    ]
    assert not wrong
