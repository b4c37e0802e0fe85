"""How a verb says that it failed: one line for people, and with `--json` one document.

A verb that has more to tell than a reason prints its own document, and leaves with a bare
`typer.Exit`.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NoReturn, Protocol, runtime_checkable

import typer

from pamctl.exit_codes import ExitCode


class VerbFailure(typer.Exit):
    """The end of a verb, with its reason."""

    def __init__(self, code: ExitCode, reason: str) -> None:
        """`reason` is for people, without a full stop."""
        super().__init__(int(code))
        self.reason = reason


def fail(code: ExitCode, reason: str) -> NoReturn:
    """Say why, and leave with `code`."""
    print(f"error: {reason}", file=sys.stderr)
    raise VerbFailure(code, reason)


@contextmanager
def document_failures(arguments: Sequence[str]) -> Iterator[None]:
    """Where `--json` is among the arguments, a failure is a document: wrong usage too."""
    try:
        yield
    except SystemExit as leaving:
        reason = _reason_of(leaving.__context__)
        if reason is not None and "--json" in arguments:
            print(json.dumps({"exit_code": leaving.code, "reason": reason}))
        raise
    except Exception as error:
        if "--json" in arguments:
            reason = f"{type(error).__name__}: {error}"
            print(json.dumps({"exit_code": int(ExitCode.UNEXPECTED), "reason": reason}))
        raise


@runtime_checkable
class _WrongUsage(Protocol):
    """What typer raises for arguments that make no sense; it has no public name."""

    def format_message(self) -> str: ...


def _reason_of(why: BaseException | None) -> str | None:
    match why:
        case VerbFailure():
            return why.reason
        case _WrongUsage():
            return why.format_message()
        case typer.Exit() if isinstance(why.__cause__, KeyboardInterrupt):
            return "interrupted"
    return None
