"""How a process of pamctl starts another one: the same code, whatever the working directory holds.

`python -m` looks for modules in the working directory first. A `json.py` beside somebody's data
would run in place of the library's, and another checkout of pamctl would guard this one's loop.
So Python starts with `-P`, which leaves that directory out, and runs this file, which takes `hal`
and `pamctl` from the folder that it lies in itself.
"""

from __future__ import annotations

import gc
import os
import runpy
import select
import shlex
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module


def child_command(module: str, *arguments: object) -> list[str]:
    """Return the command that runs a module of `hal` or `pamctl` in a process of its own."""
    return [sys.executable, "-P", os.path.abspath(__file__), module, *map(str, arguments)]


def advise_install(package: str) -> str:
    """Say what to type for a package that is missing: into this Python, and no other."""
    return f"install it with {shlex.quote(sys.executable)} -m pip install {package}"


class ParentPipe:
    """The process that started this one, seen through the pipe that it holds open."""

    def __init__(self, fd: int) -> None:
        """`fd` is the reading end, such as that of standard input."""
        self._poll = select.poll()
        self._poll.register(fd, select.POLLHUP | select.POLLERR)
        self.gone = False
        """The end of the pipe has been seen: the parent is dead, or has let go."""

    def wait(self, seconds: float = 0.0) -> bool:
        """Sleep, but wake up at the end of the parent; return whether it has come."""
        if self.gone:
            time.sleep(seconds)
        else:
            self.gone = bool(self._poll.poll(seconds * 1e3))
        return self.gone


@contextmanager
def without_working_directory() -> Iterator[None]:
    """Let the processes that Python itself starts within the block leave that directory out."""
    name = "PYTHONSAFEPATH"
    before = os.environ.get(name)
    os.environ[name] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


def start_light() -> None:
    """Save a tenth of what the start of this process costs; call it before anything is imported."""
    # What is imported stays: a collection after every 700 new objects finds nothing.
    gc.set_threshold(20_000)
    # Pydantic would look for plugins in every installed package; pamctl has none.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")


def _run_module() -> None:
    """Run the module that the first argument names, as `python -m` does."""
    start_light()
    sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    for package in ("hal", "pamctl"):  # their modules are now found there, and nothing else is
        import_module(package)
    del sys.path[0], sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    _run_module()
