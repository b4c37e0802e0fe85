"""How a verb fails: one line for people, and one document with `--json`. Written here only.

Rooms raise their own errors. An error that a user can cause carries its `exit_code`; a verb
raises `Failed` where there is no such error.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from functools import partial, wraps
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import typer
from typer.core import TyperGroup

from pamctl.base.errors import ConfigError, ExitCode
from pamctl.base.texts import PlainStream, clean_lines
from pamctl.cli.verbs import EXAMPLES, SLOW_VERBS, write_epilog
from pamctl.report.progress_line import WorkProgress
from pamctl.session.pamctl_error import explain_error


class Failed(typer.Exit):
    """The end of a verb that failed, with its reason."""

    def __init__(self, code: int, reason: str, **details: object) -> None:
        """`reason` is for people, without a full stop; `details` go into the document too."""
        super().__init__(int(code))
        self.reason = reason
        self.details = details


class Verbs(TyperGroup):
    """All verbs. Whatever one of them raises is reported here."""

    panels: Sequence[str] = ()
    """The groups of the help, in their order."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the verbs, group by group."""
        names = super().list_commands(ctx)
        groups = {name: str(getattr(self.commands[name], "rich_help_panel", "")) for name in names}
        order = {panel: place for place, panel in enumerate(self.panels)}
        return sorted(groups, key=lambda name: order.get(groups[name], len(order)))

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Take the verbs; the help shows no type beside a flag, which takes no value."""
        super().__init__(*arguments, **options)
        for words, command in list(_walk(self)):
            _word_help(command, " ".join(words))
            is_group = getattr(command, "commands", {}) and not command.invoke_without_command
            if command.callback is not None and not is_group:
                command.callback = print_plainly(command.callback, " ".join(words))
            command.get_params = partial(_list_readers, command.get_params)

    def main(self, args: Sequence[str] | None = None, *rest: Any, **extra: Any) -> Any:
        """Run the verb that the arguments name; report its failure."""
        as_json = "--json" in (sys.argv[1:] if args is None else args)
        try:
            return super().main(args, *rest, **extra)
        except SystemExit as leaving:
            match leaving.__context__:
                case Failed() as failed:
                    _report_failure(failed, as_json=as_json)
                case typer.Exit(__cause__=KeyboardInterrupt()) if as_json:
                    _print_document(leaving.code, "interrupted")
            raise
        except Exception as error:
            if as_json:
                _print_document(ExitCode.UNEXPECTED, f"{type(error).__name__}: {error}")
            raise

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the verb; raise `Failed` for the last word of one that has two, such as `import`."""
        whole = [words for words in EXAMPLES if words.endswith(f" {args[0]}")]
        if args[0] not in self.commands and whole:
            meant = " or ".join(f"`{ctx.command_path} {words}`" for words in whole)
            raise Failed(ExitCode.USAGE, f"there is no verb {args[0]!r}; did you mean {meant}?")
        return super().resolve_command(ctx, args)

    def make_context(self, *arguments: Any, **options: Any) -> Any:
        """Read the options before the verb; turn wrong ones into `Failed`."""
        try:
            return super().make_context(*arguments, **options)
        except Exception as error:
            if (wrong := _word_wrong_usage(error)) is None:
                raise
            raise wrong from error

    def invoke(self, ctx: Any) -> Any:
        """Run the verb; turn the errors that a user can cause into `Failed`."""
        try:
            return super().invoke(ctx)
        except typer.Exit:
            raise
        except ConfigError as error:
            problems = [problem.as_dict() for problem in error.problems]
            raise Failed(error.exit_code, str(error), problems=problems) from error
        except Exception as error:
            if (known := explain_error(error)) is not None:
                raise Failed(*known) from error
            if (wrong := _word_wrong_usage(error)) is None:
                raise
            raise wrong from error


def _word_wrong_usage(error: Exception) -> Failed | None:
    """Return what typer raises for arguments that make no sense as `Failed`; None for the rest."""
    # A verb without any arguments shows its help, which is no line.
    if not isinstance(error, _WrongUsage) or type(error).__name__ == "NoArgsIsHelpError":
        return None
    reason = " ".join(error.format_message().split()).rstrip(".")
    verb = f"; see `{error.ctx.command_path} --help`" if error.ctx is not None else ""
    return Failed(error.exit_code, f"{reason}{verb}")


def _walk(command: Any, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield a command with its words, and all commands in it."""
    yield words, command
    for name, inner in getattr(command, "commands", {}).items():
        yield from _walk(inner, (*words, name))


def _word_help(command: Any, words: str) -> None:
    """Complete the help of a verb by examples, and keep it plain."""
    for told in (command, *command.params):
        if getattr(told, "help", None):  # rich takes `[mm]` for markup
            told.help = re.sub(r"(?<!\\)\[", r"\\[", told.help)
        if getattr(told, "is_flag", False):
            told.metavar = ""
    if words in EXAMPLES:
        command.epilog = write_epilog(words)


def print_plainly(verb: Callable[..., None], words: str) -> Callable[..., None]:
    """Let a verb print no control characters: what it shows may be somebody else's log.

    While it is silent, the terminal says what it does, as `SLOW_VERBS` has it for these words.
    """

    @wraps(verb)
    def carry_out(*arguments: Any, **options: Any) -> None:
        with WorkProgress(SLOW_VERBS.get(words, ""), is_verb=True) as told:
            out, err = PlainStream(sys.stdout, told.end), PlainStream(sys.stderr, told.end)
            with redirect_stdout(out), redirect_stderr(err):
                verb(*arguments, **options)

    return carry_out


@runtime_checkable
class _WrongUsage(Protocol):
    """What typer raises for arguments that make no sense; it has no public name."""

    exit_code: int
    ctx: Any

    def format_message(self) -> str: ...


def print_error(reason: str) -> None:
    """Print the line for people, on standard error."""
    print(f"error: {clean_lines(reason)}", file=sys.stderr)


def _report_failure(failed: Failed, *, as_json: bool) -> None:
    if as_json:
        _print_document(failed.exit_code, failed.reason, **failed.details)
    if "problems" in failed.details:
        print(clean_lines(failed.reason), file=sys.stderr)  # each line begins with its place
    else:
        print_error(failed.reason)


def _print_document(exit_code: object, reason: str, **details: object) -> None:
    # One line: it may end a stream of lines, as of `pamctl watch --json`.
    print(json.dumps({"exit_code": exit_code, "reason": reason, **details}))


# --- values of options that need no check: typer would load pydantic to read any value ---------


def _list_readers(list_parameters: Callable[[Any], list[Any]], ctx: Any) -> list[Any]:
    parameters = list_parameters(ctx)
    for parameter in parameters:
        if not isinstance(parameter.get_runtime_param, _Reader):
            parameter.get_runtime_param = _Reader(parameter.get_runtime_param)
    return parameters


class _Reader:
    """Reads what is given for one parameter."""

    def __init__(self, build: Callable[[], Any]) -> None:
        """`build` makes the reader of typer."""
        self._build = build

    def __call__(self) -> _Reader:
        """Return what typer asks for a value."""
        return self

    def coerce(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the value of an option that was not given, of a text or a path.

        Typer reads all others, and a path that it will refuse.
        """
        kind = param.type_descriptor.annotation
        if value is None and not param.multiple and param.nargs == 1:
            return None
        if isinstance(value, str) and kind is str:
            return value
        is_path = isinstance(value, str) and kind is Path
        if is_path and (not os.path.exists(value) or os.access(value, os.R_OK)):
            return Path(value)
        return self._build().coerce(value, param=param, ctx=ctx)
