"""`pamctl` and `python -m pamctl`."""

from __future__ import annotations

import codecs
import io
import os
import signal
import sys
from collections.abc import Callable
from types import FrameType
from typing import Any

from hal.child import start_light


def main() -> None:
    """Run the command line; Ctrl-C is an exit code, never a traceback."""
    # A closed stream would hand its number to the next file opened.
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115
    out = _never_raise_in_print()
    start_light()
    try:
        from pamctl.report.progress_line import STARTING, WorkProgress

        with WorkProgress(STARTING, is_verb=True):
            app = _import_verb()
        from pamctl.realtime.scheduling import keep_single_threaded

        # The algebra here is small: threads of numpy would mostly wait for each other, and take
        # a CPU from a loop or another worker. This also holds for all processes started from
        # here; each starts with 0.1 s of CPU less.
        keep_single_threaded()
        try:
            app()
        finally:
            _end_output(out)
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:
        # The reader has gone, as `head` does. Python flushes at its end: to nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


class _Stream(io.FileIO):
    """Standard output or error: what cannot be written, as on a full disk, is dropped.

    A verb goes on to its end, and a run keeps its exit code.
    """

    problem = ""

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except BrokenPipeError:
            raise
        except OSError as error:
            self.problem = error.strerror or str(error)
            return len(data)


_BYTES_OR_MARK = "pamctl"


def _write_bytes_or_mark(error: UnicodeError) -> tuple[str | bytes, int]:
    """Write the byte of a file's name that is no text, and `?` for what the terminal lacks."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lacking = error.object[error.start : error.end]
    return b"".join(
        bytes([ord(c) - 0xDC00]) if "\udc80" <= c <= "\udcff" else b"?" for c in lacking
    ), error.end


def _never_raise_in_print() -> _Stream | None:
    """Replace the process's own standard streams; return standard output."""
    codecs.register_error(_BYTES_OR_MARK, _write_bytes_or_mark)
    replaced: dict[str, _Stream] = {}
    for name, number in (("stdout", 1), ("stderr", 2)):
        old = getattr(sys, name)
        if old is not getattr(sys, f"__{name}__") or getattr(old, "buffer", None) is None:
            continue  # somebody captures it
        if old.fileno() != number:
            continue
        replaced[name] = _Stream(number, "wb", closefd=False)
        # The terminal may lack a character: that is no reason to end a verb.
        errors = {"strict": "replace", "surrogateescape": _BYTES_OR_MARK}.get(
            old.errors, old.errors
        )
        new = io.TextIOWrapper(
            io.BufferedWriter(replaced[name]),
            old.encoding,
            errors,
            line_buffering=old.line_buffering or name == "stderr",
        )
        setattr(sys, name, new)
    return replaced.get("stdout")


def _end_output(out: _Stream | None) -> None:
    """Write the rest; what was dropped is an error, unless the verb ended with another."""
    if out is None:
        return
    sys.stdout.flush()
    leaving = sys.exc_info()[1]
    if out.problem:
        print(f"error: cannot write the output: {out.problem}", file=sys.stderr)
        if isinstance(leaving, SystemExit) and not leaving.code:
            leaving.code = 1


def _import_verb() -> Callable[[], None]:
    """Import what the verb needs: half of the start-up, so an early Ctrl-C is likely to come here.

    A `KeyboardInterrupt` while a class is built would become another error.
    """
    may_interrupt = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if may_interrupt:
        signal.signal(signal.SIGINT, _leave_at_once)
    from pamctl.cli.app import build_asked

    app = build_asked(sys.argv[1:])
    if may_interrupt:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return app


def _leave_at_once(number: int, frame: FrameType | None) -> None:
    """Leave: nothing has begun yet."""
    os._exit(130)


if __name__ == "__main__":
    main()
