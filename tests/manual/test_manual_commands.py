"""Commands of the manual run as they stand: a few pages here, all of them by the script."""

from __future__ import annotations

import os

import pytest
from check_manual import read_blocks, read_texts, run_page

TEXTS = read_texts()
# The first page of all, two about logs, two that describe a rig. That verbs and options of all
# pages exist: `test_manual_pages.py`.
PAGES = ("first-run", "read-a-log", "diagnose-a-log", "describe-your-rig", "add-a-rig")


@pytest.mark.long
@pytest.mark.parametrize("name", PAGES)
def test_the_quick_commands_of_a_page_run_as_they_stand(name: str) -> None:
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


def test_a_failing_block_is_reported_and_ends_its_page() -> None:
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
def test_a_command_must_end_as_the_page_says(command: str, status: str) -> None:
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
def test_output_that_is_shown_must_be_printed_whatever_its_numbers(shown: str, status: str) -> None:
    text = f"```console\n$ echo ' 17 um left'\n{shown}\n```\n"
    (result,) = run_page("made", text, quick=True)
    assert result.status == status


def test_marks_that_do_not_exist_are_refused() -> None:
    with pytest.raises(ValueError, match="line 2: unknown mark slwo"):
        read_blocks("<!-- run: slwo -->\n```sh\ntrue\n```\n")


def test_processes_of_a_block_end_with_its_page() -> None:
    text = "```sh\nsleep 1000 & echo $! > pid\n```\n\n```sh\ncat pid\n```\n"
    _, second = run_page("made", text, quick=True)
    with pytest.raises(ProcessLookupError):
        os.kill(int(second.output), 0)
