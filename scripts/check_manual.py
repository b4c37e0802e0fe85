"""Run every command that README and manual show, as it stands there.

    python scripts/check_manual.py [--quick] [--page NAME ...]

Prints a line for each block and leaves with 3 if one of them failed. Blocks of one page share a
temporary directory, and are run in order. A block is a fence of `sh` (a script) or `console`
(lines that begin with `$ ` are run, all else is output). `# exit code N` at the end of a command
says that it leaves with N. A line of output must be among those that the commands print, whatever
numbers are in it; `...` stands for lines left out. A comment in the line above a fence says more:

    <!-- file: lab.yaml -->      the block, of whatever language, is a file of this name
    <!-- run: slow -->           takes more than some seconds: left out by --quick
    <!-- run: card -->           needs the card: runs over the stand-in driver of tests/standin
    <!-- run: checkout -->       runs in a fresh copy of the checkout
    <!-- skip: REASON -->        is never run

`pamctl` and `python` are those of the interpreter that runs this script.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from pamctl.base.errors import ExitCode  # noqa: E402
from pamctl.manual import list_pages  # noqa: E402

_FENCE = re.compile(
    r"(?:^[ ]*<!-- (?P<mark>(?:file|run|skip):[^\n]*?) -->\n)?"
    r"^(?P<indent>[ ]*)```(?P<language>[a-z]*)\n(?P<text>.*?)^(?P=indent)```$",
    re.DOTALL | re.MULTILINE,
)
_EXIT_CODE = re.compile(r"\s+# exit code (\d+)$")
_KNOWN = {"slow", "card", "checkout"}
_NOT_COPIED = shutil.ignore_patterns(".git", ".venv", "__pycache__", ".*_cache", "logs")

QUICK_TIMEOUT_S, SLOW_TIMEOUT_S = 120.0, 1800.0


class Block(NamedTuple):
    """One fence of a page."""

    line: int
    commands: tuple[str, ...]
    """Logical lines of shell: continued lines are one."""
    file_name: str
    """Where the text goes as a file; empty for commands."""
    text: str
    shown: tuple[str, ...]
    """Lines of output."""
    marks: frozenset[str]
    skipped_because: str


class BlockResult(NamedTuple):
    """How a block went."""

    page: str
    line: int
    what: str
    status: str
    seconds: float
    output: str


def read_blocks(text: str) -> list[Block]:
    """Return the fences of a page that are commands or files, in order.

    Raises ValueError for a mark that does not exist.
    """
    blocks = []
    for fence in _FENCE.finditer(text):
        line = text[: fence.start("language")].count("\n") + 1
        body = re.sub(rf"^{fence['indent']}", "", fence["text"], flags=re.MULTILINE)
        kind, _, words = (fence["mark"] or "").partition(": ")
        marks = frozenset(re.split(r",\s*", words)) if kind == "run" else frozenset()
        if marks - _KNOWN:
            raise ValueError(f"line {line}: unknown mark {', '.join(sorted(marks - _KNOWN))}")
        file_name = words if kind == "file" else ""
        commands = () if file_name else split_commands(fence["language"], body)
        if file_name or commands:
            reason = words if kind == "skip" else ""
            shown = list_shown(body) if fence["language"] == "console" and commands else ()
            blocks.append(Block(line, commands, file_name, body, shown, marks, reason))
    return blocks


def split_commands(language: str, body: str) -> tuple[str, ...]:
    """Return the commands of a fence, none where it shows no commands."""
    if language == "sh":
        lines = body.replace("\\\n", " ").splitlines()
        return tuple(line for line in lines if line.strip() and not line.startswith("#"))
    if language == "console":
        lines = body.replace("\\\n", " ").splitlines()
        return tuple(line[2:] for line in lines if line.startswith("$ "))
    return ()


def list_shown(body: str) -> tuple[str, ...]:
    """Return the lines of output of a `console` fence."""
    lines = body.replace("\\\n", " ").splitlines()
    return tuple(line for line in lines if line.strip(" .") and not line.startswith("$ "))


def mask_numbers(line: str) -> str:
    """Return a line without its numbers, columns and edges."""
    return " ".join(re.sub(r"[-+]*\d[\d.]*(e[-+]?\d+)?", "#", line).split())


def find_stale(shown: Sequence[str], output: str) -> str:
    """Return the first line shown that the output does not have; empty if all are there."""
    printed = {mask_numbers(line) for line in output.splitlines()}
    return next((line for line in shown if mask_numbers(line) not in printed), "")


def write_script(commands: Sequence[str]) -> str:
    """Return a shell script that ends at the first command that ends otherwise than stated."""
    lines = ["set -euo pipefail"]
    for command in commands:
        expected = _EXIT_CODE.search(command)
        if expected is None:
            lines.append(command)
        else:
            bare = _EXIT_CODE.sub("", command)
            lines += ["code=0", f"{bare} || code=$?", f"[ $code = {expected[1]} ]"]
    return "\n".join(lines)


@contextmanager
def _page_environment(page_needs_card: bool) -> Iterator[tuple[Path, dict[str, str]]]:
    """Make a directory and an environment of a page's own: no other run can meet its rigs."""
    with tempfile.TemporaryDirectory(prefix="pamctl-page-") as temporary:
        root = Path(temporary)
        for name in ("work", "bin", "run"):
            (root / name).mkdir(mode=0o700)
        # A page may set PYTHONPATH as its reader would, for whom pamctl is installed.
        path = f'PYTHONPATH="{ROOT}${{PYTHONPATH:+:$PYTHONPATH}}"'
        for name, start in {"pamctl": "-P -m pamctl", "python": ""}.items():
            shim = root / "bin" / name
            shim.write_text(f'#!/bin/sh\n{path} exec "{sys.executable}" {start} "$@"\n')
            shim.chmod(0o755)
        memory = Path(tempfile.mkdtemp(prefix="pamctl-page-", dir="/dev/shm"))
        environment = {**os.environ, "PYTHONPATH": ""}
        if page_needs_card:
            from standin.standin import Card

            environment |= Card(root / "registers").environment()
        environment |= {
            "PATH": f"{root / 'bin'}{os.pathsep}{os.environ['PATH']}",
            "PAMCTL_SHARED_MEMORY": str(memory),
            "XDG_RUNTIME_DIR": str(root / "run"),
        }
        try:
            yield root / "work", environment
        finally:
            for left in memory.iterdir():
                left.unlink()
            memory.rmdir()


def run_page(name: str, text: str, *, quick: bool) -> Iterator[BlockResult]:
    """Run the blocks of a page; after a failure the rest of the page is not tried."""
    blocks = read_blocks(text)
    needs_card = any("card" in block.marks and not block.skipped_because for block in blocks)
    with _page_environment(needs_card and not quick) as (work, environment):
        started: list[subprocess.Popen[bytes]] = []
        lacking = ""
        try:
            for block in blocks:
                if block.file_name:
                    file = work / block.file_name
                    file.parent.mkdir(parents=True, exist_ok=True)
                    file.write_text(block.text)
                    continue
                reason = block.skipped_because or lacking
                if quick and block.marks & {"slow", "card"}:
                    reason = "slow"
                    if "checkout" not in block.marks:
                        lacking = "after a slow block"
                if reason:
                    what = block.commands[0]
                    yield BlockResult(name, block.line, what, f"skipped: {reason}", 0.0, "")
                    continue
                result = _run_block(name, block, work, environment, started)
                yield result
                if result.status != "ok":
                    lacking = "after a failure"
        finally:
            for process in started:
                _end(process)


def _run_block(
    name: str,
    block: Block,
    work: Path,
    environment: dict[str, str],
    started: list[subprocess.Popen[bytes]],
) -> BlockResult:
    """Run one block in a session of its own, so that what it leaves running can be ended."""
    begin_s = time.monotonic()
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(
            ["bash", "-c", write_script(block.commands)],
            cwd=_copy_checkout(work) if "checkout" in block.marks else work,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        started.append(process)
        timeout_s = SLOW_TIMEOUT_S if "slow" in block.marks else QUICK_TIMEOUT_S
        try:
            code = process.wait(timeout_s)
            status = "ok" if code == 0 else f"failed: exit code {code}"
        except subprocess.TimeoutExpired:
            _end(process)
            status = f"failed: not done after {timeout_s:.0f} s"
        said.seek(0)
        output = said.read().decode(errors="replace")
    stale = find_stale(block.shown, output) if status == "ok" else ""
    if stale:
        status = f"failed: it does not print {stale.strip()!r}"
    return BlockResult(
        name, block.line, block.commands[0], status, time.monotonic() - begin_s, output
    )


def _copy_checkout(work: Path) -> Path:
    """Return a copy of the checkout beside the page's folder: what a page makes goes with it."""
    copy = work.with_name("checkout")
    if not copy.exists():
        shutil.copytree(ROOT, copy, ignore=_NOT_COPIED)
    return copy


def _end(process: subprocess.Popen[bytes]) -> None:
    """End all that a block left running, as a closing terminal would, then without mercy."""
    for number, patience_s in ((signal.SIGTERM, 10.0), (signal.SIGKILL, 1.0)):
        with suppress(ProcessLookupError):
            os.killpg(process.pid, number)
            deadline_s = time.monotonic() + patience_s
            while time.monotonic() < deadline_s:
                process.poll()
                os.killpg(process.pid, 0)  # raises once the group is empty
                time.sleep(0.05)


def read_texts() -> dict[str, str]:
    """Return README and every page of the manual by name."""
    pages = {page.name: page.path.read_text(encoding="utf-8") for page in list_pages()}
    return {"README": (ROOT / "README.md").read_text(encoding="utf-8"), **pages}


def main() -> int:
    """Check the pages that are asked for; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="leave out blocks that are slow")
    parser.add_argument("--page", action="append", metavar="NAME", help="only this page; repeats")
    options = parser.parse_args()
    texts = read_texts()
    if unknown := set(options.page or ()) - set(texts):
        parser.error(f"no page is named {', '.join(sorted(unknown))}")
    failed = ran = 0
    print(f"{'page':<28} {'line':>4} {'s':>6}  status")
    for name in options.page or texts:
        for result in run_page(name, texts[name], quick=options.quick):
            print(
                f"{name:<28} {result.line:>4} {result.seconds:>6.1f}  {result.status:<8}"
                f"  {result.what[:70]}",
                flush=True,
            )
            ran += result.status == "ok"
            if result.status.startswith("failed"):
                failed += 1
                print("    " + result.output.strip().replace("\n", "\n    "), flush=True)
    print(f"{ran} blocks ran, {failed} failed")
    return ExitCode.CHECK_FAILED if failed else ExitCode.OK


if __name__ == "__main__":
    sys.exit(main())
