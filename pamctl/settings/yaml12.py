"""Read and write YAML 1.2, with the line of every key.

PyYAML implements YAML 1.1: `1e-4` is text, `on` is true, `010` is eight, `1:30` is ninety, and of
two equal keys the last one wins silently. A wrong gain moves a muscle. Here scalars follow the
YAML 1.2 core schema (https://yaml.org/spec/1.2.2/, section 10.3), equal keys are an error, and
each problem of a file becomes one `YamlError` with its place.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, NoReturn

import yaml

from pamctl.base.new_file import describe_irregular_file

KeyPath = tuple[str | int, ...]
"""The path to a value: keys of mappings, indices of lists."""

MAX_BYTES = 256 * 1024
"""Much larger than any settings file; a much larger file would stall the Python scanner."""
MAX_VALUES = 20_000
"""Counted with aliases expanded, so that nine lines cannot become a billion values."""
MAX_DEPTH = 40
"""Levels of nesting, also with aliases expanded."""


class FilePosition(NamedTuple):
    """A place in a file, counted from 1 as editors do."""

    line: int
    column: int


@dataclass(frozen=True)
class YamlDocument:
    """The mapping that a file holds."""

    data: dict[str, object]
    path: Path
    marks: dict[KeyPath, FilePosition]
    """The place of each key or list item; `()` is the start of the mapping itself.

    Values within an alias have their place at its anchor.
    """


class YamlError(Exception):
    """A file is not one valid YAML mapping; the message is one line with the place."""

    def __init__(self, message: str, path: Path, mark: FilePosition | None = None) -> None:
        """`mark` is None if the problem concerns the whole file."""
        self.message = message
        self.where = f"{path}:{mark.line}:{mark.column}" if mark else str(path)
        super().__init__(f"{self.where}: {message}")


def load_yaml(path: Path) -> YamlDocument:
    """Read one file. Raises only `YamlError`, for any content."""
    return parse_yaml(_read_text(path), path)


def parse_yaml(text: str, path: Path) -> YamlDocument:
    """Read YAML text; errors call it `path`."""
    builder = _Builder()
    with _translate_errors(path):
        root = _compose(text)
        if root is None:
            raise YamlError("the file is empty", path)
        data = builder.value(root, ())
        if not isinstance(data, dict):
            found = "a list" if isinstance(data, list) else "a single value"
            _refuse(f"must hold 'key: value' lines, not {found}", root.start_mark)
    return YamlDocument(data, path, builder.marks)


def parse_yaml_value(text: str) -> object:
    """Read one value of any kind: `12`, `1e-4`, `[1, 2]`, `{gain: 3}`; empty text is null."""
    with _translate_errors(Path("value")):
        root = _compose(text)
        return None if root is None else _Builder().value(root, ())


def dump_yaml(data: object) -> str:
    """Write mappings, lists and scalars; `parse_yaml` returns them equal, floats to the bit.

    Texts that YAML 1.1 would misread (`on`, `1e-4`) are quoted for other tools.
    """
    text: str = yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100)
    return text


# --- scalars ---------------------------------------------------------------------------


def _to_int(text: str) -> int:
    return int(text, {"0o": 8, "0x": 16}.get(text[:2], 10))


def _to_float(text: str) -> float:
    return float(text.replace(".", "") if text[-1] in "fFnN" else text)


_TAG = "tag:yaml.org,2002:"
_CORE: dict[str, tuple[re.Pattern[str], Callable[[str], object]]] = {
    f"{_TAG}{name}": (re.compile(rf"(?:{pattern})\Z"), convert)
    for name, pattern, convert in (
        ("null", r"|~|null|Null|NULL", lambda text: None),
        ("bool", r"true|True|TRUE|false|False|FALSE", lambda text: text.lower() == "true"),
        ("int", r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", _to_int),
        (
            "float",
            r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
            r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
            _to_float,
        ),
        ("str", r"[^\ud800-\udfff]*", str),
    )
}
_RESOLVERS = [(tag, pattern) for tag, (pattern, _) in _CORE.items()]


class _Loader(yaml.SafeLoader):
    """PyYAML's scanner and composer with the resolvers of YAML 1.2 and a limit of depth."""

    yaml_implicit_resolvers = {None: _RESOLVERS}  # noqa: RUF012  (PyYAML's own declaration)
    _depth = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        self._depth += 1
        if parent is not None and self._depth > MAX_DEPTH:
            _refuse(f"is nested more than {MAX_DEPTH} deep", parent.start_mark)
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node


class _Dumper(yaml.SafeDumper):
    yaml_implicit_resolvers = {  # noqa: RUF012
        **yaml.SafeDumper.yaml_implicit_resolvers,
        None: _RESOLVERS,
    }

    def ignore_aliases(self, data: object) -> bool:
        return True

    def represent_text(self, text: str) -> yaml.ScalarNode:
        # Other styles would fold line breaks, also U+0085 and U+2028.
        style = None if text.isprintable() else '"'
        return self.represent_scalar(f"{_TAG}str", text, style)


_Dumper.add_representer(str, _Dumper.represent_text)


# --- from nodes to values --------------------------------------------------------------


class _Builder:
    """Turns nodes into values, and notes the place of each key."""

    def __init__(self) -> None:
        self.marks: dict[KeyPath, FilePosition] = {}
        self._values = 0
        self._open: list[yaml.Node] = []

    def value(self, node: yaml.Node, at: KeyPath) -> object:
        self.marks.setdefault(at, _position_of(node.start_mark))
        self._refuse_endless(node)
        self._open.append(node)
        try:
            if isinstance(node, yaml.MappingNode) and node.tag == f"{_TAG}map":
                return self._build_mapping(node, at)
            if isinstance(node, yaml.SequenceNode) and node.tag == f"{_TAG}seq":
                return [self.value(item, (*at, i)) for i, item in enumerate(node.value)]
            return _read_scalar(node)
        finally:
            self._open.pop()

    def _build_mapping(self, node: yaml.MappingNode, at: KeyPath) -> dict[str, object]:
        mapping: dict[str, object] = {}
        for key_node, value_node in node.value:
            key = _read_key(key_node)
            here = (*at, key)
            if key in mapping:
                first = self.marks[here].line
                _refuse(f"the key '{key}' is already defined in line {first}", key_node.start_mark)
            self.marks[here] = _position_of(key_node.start_mark)
            mapping[key] = self.value(value_node, here)
        return mapping

    def _refuse_endless(self, node: yaml.Node) -> None:
        self._values += 1
        if any(node is one for one in self._open):
            _refuse("an alias refers to a value that contains it", node.start_mark)
        if len(self._open) >= MAX_DEPTH:
            _refuse(f"is nested more than {MAX_DEPTH} deep", node.start_mark)
        if self._values > MAX_VALUES:
            _refuse(f"holds more than {MAX_VALUES} values", node.start_mark)


def _read_scalar(node: yaml.Node) -> object:
    tag = node.tag.replace(_TAG, "!!")
    if node.tag not in _CORE or not isinstance(node, yaml.ScalarNode):
        _refuse(f"the tag {tag!r} is not allowed here", node.start_mark)
    pattern, convert = _CORE[node.tag]
    if not pattern.match(node.value):
        kind = "text of valid characters" if tag == "!!str" else f"of type {tag}"
        _refuse(f"{_shorten(node.value)} is not {kind}", node.start_mark)
    try:
        return convert(node.value)
    except ValueError:  # Python's own limit on the digits of an integer
        _refuse(f"{_shorten(node.value)} has too many digits", node.start_mark)


def _read_key(node: yaml.Node) -> str:
    if isinstance(node, yaml.ScalarNode) and node.value == "<<" and node.style is None:
        _refuse("'<<' is YAML 1.1; write the keys out", node.start_mark)
    key = _read_scalar(node) if isinstance(node, yaml.ScalarNode) else None
    if not isinstance(key, str):
        shown = f"; quote it: {_shorten(node.value)}" if isinstance(node, yaml.ScalarNode) else ""
        _refuse(f"a key must be text{shown}", node.start_mark)
    if not key.isprintable():
        _refuse(f"the key {_shorten(key)} holds unprintable characters", node.start_mark)
    return key


# --- errors ----------------------------------------------------------------------------

_PLAINLY = (
    ("expected <block end>", "the indentation does not fit the lines above"),
    ("'\\t' that cannot start any token", "a tab cannot indent; use spaces"),
    ("that cannot start any token", "a value cannot begin with this character; quote it"),
    ("end of stream", "a quote is never closed"),
    ("<stream end>", "a bracket or brace is never closed"),
    ("second occurrence", "an anchor of this name is already defined above"),
    ("mapping values are not allowed", "a second ':' in one line; quote the value, or indent"),
    ("could not find expected ':'", "a key without ':'"),
    ("but found another document", "a file may hold only one document"),
)
"""PyYAML's message, and the message for users."""


def _read_text(path: Path) -> str:
    if something := describe_irregular_file(path):
        raise YamlError(f"is {something}", path)
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise YamlError("no such file", path) from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise YamlError(f"cannot be read ({reason})", path) from None
    if len(raw) > MAX_BYTES:
        raise YamlError(f"is larger than {MAX_BYTES // 1024} KiB", path)
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        bad = error.object[error.start]
        message = f"line {line} is not UTF-8 text (byte 0x{bad:02x}); save the file as UTF-8"
        raise YamlError(message, path) from None


def _compose(text: str) -> yaml.Node | None:
    loader = _Loader(text)
    try:
        node: yaml.Node | None = loader.get_single_node()
    except (ValueError, OverflowError):  # chr() within the scanner, for "\U00110000"
        _refuse("an escape names no character", loader.get_mark())
    return node


@contextmanager
def _translate_errors(path: Path) -> Iterator[None]:
    """Turn every error of PyYAML into `YamlError`."""
    try:
        yield
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        raise YamlError(
            _explain_plainly(error), path, _position_of(mark) if mark else None
        ) from None
    except yaml.reader.ReaderError as error:
        message = f"character {error.position + 1} is a control character"
        raise YamlError(message, path) from None


def _explain_plainly(error: yaml.MarkedYAMLError) -> str:
    problem = str(error.problem or error.context)
    return next((plain for jargon, plain in _PLAINLY if jargon in problem), problem)


def _refuse(message: str, mark: yaml.Mark) -> NoReturn:
    raise yaml.MarkedYAMLError(problem=message, problem_mark=mark)


def _position_of(mark: yaml.Mark) -> FilePosition:
    return FilePosition(mark.line + 1, mark.column + 1)


def _shorten(text: str) -> str:
    return repr(text if len(text) <= 40 else f"{text[:37]}...")
