"""Files of all verbs: what may be read, and how a new one is written.

Only regular files are read: others may never end, or wait for a writer. A file that is written here
is complete under another name first: it is whole or not there, and never overwrites another one
unless asked.
"""

from __future__ import annotations

import errno
import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from io import BufferedWriter
from itertools import count
from pathlib import Path
from stat import S_IFIFO, S_IFMT, S_IFSOCK, S_ISDIR, S_ISREG

from pamctl.base.errors import ExitCode

_TRIAL_BYTES = 64 * 1024
_DISK = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO}
"""What the disk does; everything else is the path that was given."""


def describe_irregular_file(path: Path) -> str:
    """Describe a path that is not a regular file; empty for regular and missing files.

    Call it before opening: opening a pipe waits for its other end, and `/dev/zero` never ends.
    """
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):  # a NUL in the path; opening it gives a better message
        return ""
    if S_ISREG(mode):
        return ""
    if S_ISDIR(mode):
        return "a directory, not a file"
    kind = {S_IFIFO: "a pipe", S_IFSOCK: "a socket"}.get(S_IFMT(mode), "a device")
    return f"{kind}, not a file; copy its content into a file first"


class NewFileError(Exception):
    """A file cannot be written. The message holds the path, the reason, and what to do."""

    def __init__(self, path: Path, reason: str, fix: str, code: ExitCode = ExitCode.USAGE) -> None:
        """`reason` and `fix` are clauses without a full stop."""
        super().__init__(f"cannot write {path}: {reason}; {fix}")
        self.path = path
        self.reason = reason
        self.fix = fix
        self.exit_code = code


@contextmanager
def create_new_file(path: Path, *, replaces: str | None = None) -> Iterator[BufferedWriter]:
    """Open a file for writing; it appears at `path` when the block ends well, and is on the disk.

    An existing file is refused, unless it is empty or begins with `replaces`. If the block fails,
    nothing is left. Raises NewFileError.
    """
    path = Path(path)
    with _translate_errors(path):
        _require_place(path, replaces)
        if _is_device(path):
            with path.open("wb") as device:
                yield device
            return
        target = Path(os.path.realpath(path)) if path.is_symlink() else path
        draft = target.with_name(f".{target.name[:100]}.{secrets.token_hex(4)}.part")
        try:
            with draft.open("xb") as stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            _put_in_place(draft, target, replace=replaces is not None)
        finally:
            with suppress(OSError):
                draft.unlink(missing_ok=True)


def write_files(texts: Mapping[Path, str], *, replaces: str | None = None) -> None:
    """Write texts as UTF-8 files, all or none; make their folders. Raises NewFileError."""
    made: list[Path] = []
    try:
        with ExitStack() as drafts:  # none is put in place before all are written
            for path, text in texts.items():
                with _translate_errors(path):
                    made += _make_folder(path.parent)
                stream = drafts.enter_context(create_new_file(path, replaces=replaces))
                with _translate_errors(path):
                    stream.write(text.encode())
                    stream.flush()
    except BaseException:
        for folder in reversed(made):
            with suppress(OSError):
                folder.rmdir()
        raise


def require_place(path: Path, *, replaces: str | None = None) -> None:
    """Raise NewFileError now if `create_new_file` would, and the reason is there already.

    A file of some size is written and removed: a full disk is noticed before the work.
    """
    path = Path(path)
    with _translate_errors(path):
        _require_place(path, replaces)
        if not _is_device(path):
            _try_to_write(path.parent)


def require_empty_folder(path: Path) -> None:
    """Raise NewFileError if the folder holds anything, or nothing can be written into it.

    It may be missing: then `write_files` makes it.
    """
    with _translate_errors(path):
        if os.path.lexists(path) and (not path.is_dir() or any(path.iterdir())):
            raise NewFileError(path, "it exists and is not an empty folder", "give another name")
    require_folder(path)


def require_folder(path: Path) -> None:
    """Raise NewFileError if no files can be written into a folder, which may be missing."""
    with _translate_errors(path):
        if os.path.lexists(path) and not path.is_dir():
            raise NewFileError(path, "it exists and is not a folder", "give another name")
        made = _make_folder(path)
        try:
            _try_to_write(path)
        finally:
            for folder in reversed(made):
                with suppress(OSError):  # another run writes there by now
                    folder.rmdir()


@contextmanager
def _translate_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:  # the output is a pipe, and its reader is gone
        raise
    except OSError as error:
        reason = error.strerror or str(error)
        if error.errno in _DISK:
            fix = "make room there, or choose another place"
            raise NewFileError(path, reason, fix, ExitCode.UNEXPECTED) from error
        raise NewFileError(path, reason, "choose another place") from error
    except ValueError as error:
        if "\0" not in str(path):
            raise
        raise NewFileError(path, str(error), "give another name") from error


def _require_place(path: Path, replaces: str | None) -> None:
    if not path.parent.is_dir():
        raise NewFileError(path, f"there is no directory {path.parent}", "make it first")
    if not os.path.lexists(path):
        return
    if path.is_dir():
        raise NewFileError(path, "it is a directory", "give another name")
    if replaces is None:
        free = next(name for k in count(2) if not os.path.lexists(name := _number(path, k)))
        fix = f"give another name, such as {free}"
        raise NewFileError(path, "it exists and is never overwritten", fix)
    with suppress(FileNotFoundError):  # a link to a file that is not there yet
        if S_ISREG(path.stat().st_mode) and path.stat().st_size:
            with path.open("rb") as file:
                if file.read(len(replaces.encode())) != replaces.encode():
                    raise NewFileError(path, "it exists and is something else", "give another name")


def _number(path: Path, k: int) -> Path:
    return path.with_name(f"{path.stem}-{k}{path.suffix}")


def _is_device(path: Path) -> bool:
    """Tell whether the path is a pipe or a device, such as /dev/stdout: it is not replaced."""
    with suppress(FileNotFoundError):
        mode = path.stat().st_mode
        return not S_ISREG(mode) and not S_ISDIR(mode)
    return False


def _put_in_place(draft: Path, target: Path, *, replace: bool) -> None:
    if replace:
        draft.replace(target)
    else:
        try:
            os.link(draft, target)  # unlike a rename, this overwrites nothing
        except FileExistsError:
            reason = "it exists by now and is never overwritten"
            raise NewFileError(target, reason, "give another name") from None
        except OSError:  # the file system has no links
            _require_place(target, None)
            draft.rename(target)
    _sync_folder(target.parent)


def _sync_folder(folder: Path) -> None:
    """Bring the new name to the disk, where folders can be opened."""
    with suppress(OSError):
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)


def _make_folder(folder: Path) -> list[Path]:
    """Make a folder and those above it; return the new ones, outermost first."""
    missing = [place for place in (folder, *folder.parents) if not place.is_dir()]
    if missing and os.path.lexists(missing[-1]):
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(missing[-1]))
    made: list[Path] = []
    try:
        for place in reversed(missing):
            place.mkdir()
            made.append(place)
    except OSError:
        for place in reversed(made):
            place.rmdir()
        raise
    return made


def _try_to_write(folder: Path) -> None:
    from tempfile import NamedTemporaryFile  # few verbs write

    with NamedTemporaryFile(dir=folder, prefix=".", suffix=".part") as file:
        file.write(bytes(_TRIAL_BYTES))
        file.flush()
        os.fsync(file.fileno())
