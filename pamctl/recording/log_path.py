"""Choose the path of a run's log; refuse it before anything moves if it cannot be created."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from pamctl.exit_codes import ExitCode
from pamctl.log.run_meta import bare_name, make_dated_path

_LOG_DIRECTORY = Path("logs")


class LogPathError(Exception):
    """The log cannot be written at the given path."""

    exit_code = ExitCode.USAGE


def choose_log_path(asked: Path | None, controller: str, experiment: str) -> Path:
    """Return a path that can be created and does not exist; raise `LogPathError`."""
    path = (
        _propose_log_path(f"{bare_name(controller)}-{bare_name(experiment)}")
        if asked is None
        else asked
    )
    try:
        if path.exists():
            raise LogPathError(f"--log {path}: exists, and a log is never overwritten")
        if not path.parent.is_dir():
            raise LogPathError(_explain_no_directory(path, by_default=asked is None))
        path.touch(exist_ok=False)
        path.unlink()
    except OSError as error:
        hint = "; give another place with --log" if asked is None else ""
        raise LogPathError(f"--log {path}: cannot be created: {error.strerror}{hint}") from None
    return path


def _propose_log_path(what: str) -> Path:
    with suppress(OSError):
        _LOG_DIRECTORY.mkdir(exist_ok=True)
    return make_dated_path(_LOG_DIRECTORY, what)


def _explain_no_directory(path: Path, *, by_default: bool) -> str:
    if by_default:
        return f"{path.parent}/ cannot be created here; give another place with --log"
    return f"--log {path}: there is no directory {path.parent}"
