"""The manual: its pages, links and words, and each command that it shows."""

import os
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
from check_manual import read_blocks, read_texts, run_page
from generate_reference import PAGES, REFERENCE, walk_verbs

from pamctl.manual import KINDS, UnknownPageError, list_pages, read_page

ROOT = Path(__file__).resolve().parents[2]
FILES = {"README": ROOT / "README.md", **{page.name: page.path for page in list_pages()}}
_LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
_CODE = re.compile(r"^ *```.*?^ *```$|`[^`\n]*`", re.DOTALL | re.MULTILINE)


def anchors_of(path: Path) -> set[str]:
    """Return the anchors of a page's headings, as repository hosts make them."""
    headings = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_every_link_resolves():
    for name, file in FILES.items():
        for link in _LINK.findall(_CODE.sub("", file.read_text(encoding="utf-8"))):
            if re.match(r"https?:", link):
                continue
            target, _, anchor = link.partition("#")
            path = (file.parent / target).resolve() if target else file
            assert path.exists(), (name, link)
            if anchor:
                assert anchor in anchors_of(path), (name, link)


def test_the_list_holds_every_file_of_the_manual_once():
    pages = list_pages()
    files = {path.resolve() for path in (ROOT / "pamctl" / "manual").rglob("*.md")}
    assert {page.path.resolve() for page in pages} == files
    assert len({page.name for page in pages}) == len(pages)
    assert {page.kind for page in pages} == set(KINDS.values())


def test_every_page_can_be_reached_from_the_readme():
    reached, waiting = set(), [FILES["README"]]
    while waiting:
        path = waiting.pop()
        if path in reached:
            continue
        reached.add(path)
        for link in _LINK.findall(path.read_text(encoding="utf-8")):
            target = (path.parent / link.partition("#")[0]).resolve()
            waiting += sorted(target.glob("*.md")) if target.is_dir() else []
            waiting += [target] if target.suffix == ".md" and target.exists() else []
    assert {page.path.resolve() for page in list_pages()} <= reached


def test_the_readme_is_one_page():
    text = FILES["README"].read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 180
    assert len(text.split()) <= 1200


@pytest.mark.parametrize("name", ["first-ran", "First-Run", "first-run.md"])
def test_an_unknown_page_is_refused_with_the_nearest_name(name):
    with pytest.raises(UnknownPageError, match="did you mean 'first-run'"):
        read_page(name)


@pytest.mark.parametrize("name", PAGES)
def test_reference_pages_are_those_that_the_code_makes(name):
    committed = (REFERENCE / f"{name}.md").read_text(encoding="utf-8")
    assert committed == PAGES[name]().rstrip() + "\n", (
        f"{name}.md differs from the code: run `python scripts/generate_reference.py`"
    )


def shown_commands(text: str) -> Iterator[list[str]]:
    """Return the words of every `pamctl` command of a page, in blocks and within sentences."""
    lines = [line for block in read_blocks(text) for line in block.commands]
    prose = re.sub(r"^ *```.*?^ *```$", "", text, flags=re.DOTALL | re.MULTILINE)
    lines += re.findall(r"`(pamctl [^`\n]*)`", prose)
    for line in lines:
        for part in re.split(
            r"\|\||&&|[;|&]|\$\(|\)|\bdo\b|\buntil\b", re.sub(r"'[^']*'", "X", line)
        ):
            words = shlex.split(part, comments=True)
            if words and Path(words[0]).name == "pamctl":
                yield words[1:]


VERBS = {words.removeprefix("pamctl "): command for words, command in walk_verbs()}
GROUPS = {verb.split()[0] for verb in VERBS if " " in verb}


@pytest.mark.parametrize("name", FILES)
def test_every_command_has_a_verb_and_options_that_exist(name):
    for words in shown_commands(FILES[name].read_text(encoding="utf-8")):
        if not words or not re.fullmatch(r"[a-z]+", words[0]):
            continue  # `pamctl VERB`, or `pamctl --help`
        two = " ".join(words[:2])
        verb = two if two in VERBS or words[0] not in VERBS else words[0]
        if words[0] in GROUPS and verb not in VERBS and len(words) == 1:
            continue
        assert verb in VERBS, words
        known = {"--help"} | {name for param in VERBS[verb].params for name in param.opts}
        used = {word.partition("=")[0] for word in words if re.match(r"--[a-z]", word)}
        assert used <= known, words


TEXTS = read_texts()
# The first page of all, two about logs, two that describe a rig. That verbs and options of all
# pages exist: `test_manual_pages.py`.
QUICK_PAGES = ("first-run", "read-a-log", "diagnose-a-log", "describe-your-rig", "add-a-rig")


@pytest.mark.long
@pytest.mark.parametrize("name", QUICK_PAGES)
def test_the_quick_commands_of_a_page_run_as_they_stand(name):
    results = list(run_page(name, TEXTS[name], quick=True))
    assert any(result.status == "ok" for result in results)
    for result in results:
        assert not result.status.startswith("failed"), (
            f"line {result.line}: {result.what}\n{result.output}"
        )


PAGE = """
<!-- file: a.txt -->
```
one
```

```console
$ cat a.txt
one
$ false   # exit code 1
```

```sh
grep two a.txt
echo not reached
```

```sh
echo not tried
```
"""


def test_a_failing_block_is_reported_and_ends_its_page():
    results = list(run_page("made", PAGE, quick=True))
    assert [result.status for result in results] == [
        "ok", "failed: exit code 1", "skipped: after a failure",
    ]  # fmt: skip
    assert "not reached" not in results[1].output


@pytest.mark.parametrize(
    ("command", "status"),
    [
        ("(exit 3)   # exit code 3", "ok"),
        ("(exit 4)   # exit code 3", "failed: exit code 1"),
        ("true   # exit code 3", "failed: exit code 1"),
        ("false | true", "failed: exit code 1"),
    ],
)
def test_a_command_must_end_as_the_page_says(command, status):
    (result,) = run_page("made", f"```sh\n{command}\n```\n", quick=True)
    assert result.status == status


@pytest.mark.parametrize(
    ("shown", "status"),
    [
        ("3.2 um   left", "ok"),
        ("...", "ok"),
        ("4e-05 um right", "failed: it does not print '4e-05 um right'"),
    ],
)
def test_output_that_is_shown_must_be_printed_whatever_its_numbers(shown, status):
    text = f"```console\n$ echo ' 17 um left'\n{shown}\n```\n"
    (result,) = run_page("made", text, quick=True)
    assert result.status == status


def test_marks_that_do_not_exist_are_refused():
    with pytest.raises(ValueError, match="line 2: unknown mark slwo"):
        read_blocks("<!-- run: slwo -->\n```sh\ntrue\n```\n")


def test_processes_of_a_block_end_with_its_page():
    text = "```sh\nsleep 1000 & echo $! > pid\n```\n\n```sh\ncat pid\n```\n"
    _, second = run_page("made", text, quick=True)
    with pytest.raises(ProcessLookupError):
        os.kill(int(second.output), 0)
