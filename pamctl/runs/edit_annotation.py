"""Tag logs and write notes into them, one process at a time in a folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from pamctl.log.annotate import read_annotation, write_annotation
from pamctl.log.annotation import Annotation
from pamctl.runs.run_index import RunIndex
from pamctl.runs.run_row import read_row


def edit_annotations(
    paths: Sequence[Path], edit: Callable[[Annotation], Annotation]
) -> list[tuple[Path, Annotation]]:
    """Change what is said of runs; return what is said of each now.

    Every log is read before the first one is written. Raise LogError where one is not a finished
    log, NewFileError where it cannot be written, AnnotationError where a text cannot be used.
    """
    for path in paths:
        edit(read_annotation(path))
    return [(path, _edit_one(path, edit)) for path in dict.fromkeys(paths)]


def _edit_one(path: Path, edit: Callable[[Annotation], Annotation]) -> Annotation:
    with RunIndex(path.absolute().parent) as index, index.hold():
        before = read_annotation(path)
        said = edit(before)
        if said != before:
            write_annotation(path, said)
            index.put([read_row(path)])
        return said
