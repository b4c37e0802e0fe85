"""The YAML reader: 1.2 scalars, places, and one clear error for every problem."""

import math
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pamctl.settings import yaml12 as yamlfile
from pamctl.settings.yaml12 import (
    MAX_BYTES,
    YamlError,
    dump_yaml,
    load_yaml,
    parse_yaml,
    parse_yaml_value,
)

HERE = Path("my.yaml")


def written(folder: Path, content: str | bytes) -> Path:
    path = folder / "my.yaml"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def complaint(content: str | bytes, folder: Path) -> str:
    """Return the error of loading `content`, without its folder."""
    with pytest.raises(YamlError) as caught:
        load_yaml(written(folder, content))
    return str(caught.value).replace(f"{folder}/", "")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-4", 1e-4),
        ("2.5e4", 2.5e4),
        ("-1E+3", -1e3),
        (".5", 0.5),
        ("5.", 5.0),
        ("-.inf", -math.inf),
        ("010", 10),
        ("0o17", 15),
        ("0x1F", 31),
        ("-7", -7),
        ("true", True),
        ("FALSE", False),
        ("~", None),
        ("", None),
        ("!!float 1", 1.0),
        ("[1, {a: 2}]", [1, {"a": 2}]),
    ],
)
def test_scalars_follow_the_core_schema_of_yaml_1_2(text, value):
    read = parse_yaml_value(text)
    assert read == value
    assert type(read) is type(value)


def test_every_key_and_item_knows_its_line_and_column(tmp_path):
    document = load_yaml(written(tmp_path, "# gains\nlaw: qsmc\neffects:\n  spool: {hz: 109}\n"))
    assert document.data == {"law": "qsmc", "effects": {"spool": {"hz": 109}}}
    assert document.marks == {
        (): (2, 1),
        ("law",): (2, 1),
        ("effects",): (3, 1),
        ("effects", "spool"): (4, 3),
        ("effects", "spool", "hz"): (4, 11),
    }
    assert parse_yaml("a:\n- 1\n- 2\n", HERE).marks[("a", 1)] == (3, 3)


def test_a_value_below_an_alias_is_placed_where_it_is_written_out():
    document = parse_yaml("a: &shared\n  k: 1\nb: *shared\n", HERE)
    assert document.data == {"a": {"k": 1}, "b": {"k": 1}}
    assert document.marks[("b",)] == (3, 1)
    assert document.marks[("b", "k")] == (2, 3)
    assert document.data["a"] is not document.data["b"]


BOMB = "a0: &a0 [x,x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"a{i}: &a{i} [{','.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 10)
)
LADDER = "a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}]\n" for i in range(1, 99))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("a: 1\nb: 2\na: 3\n", "my.yaml:3:1: the key 'a' is already defined in line 1"),
        ("a: &x [*x]", "my.yaml:1:4: an alias refers to a value that contains it"),
        ("a: !gain 1", "my.yaml:1:4: the tag '!gain' is not allowed here"),
        ("a: !!python/name:os.system", "my.yaml:1:4: the tag '!!python/name:os.system' is not"),
        ("", "my.yaml: the file is empty"),
        ("# only this\n", "my.yaml: the file is empty"),
        ("- a\n- b\n", "my.yaml:1:1: must hold 'key: value' lines, not a list"),
        ("12", "my.yaml:1:1: must hold 'key: value' lines, not a single value"),
        ("a:\n\tb: 1\n", "my.yaml:2:1: a tab cannot indent; use spaces"),
        (b"a: 1\nb: 20 \xb5m\n", "my.yaml: line 2 is not UTF-8 text (byte 0xb5); save"),
        ("a: 1\n".encode("utf-16"), "my.yaml: line 1 is not UTF-8 text (byte 0xff); save"),
        ("a: \x07", "my.yaml: character 4 is a control character"),
        ("a: 1\n---\nb: 2\n", "my.yaml:2:1: a file may hold only one document"),
        ("a: b: 1\n", "my.yaml:1:5: a second ':' in one line"),
        ("a: [1, 2", "my.yaml:1:9: a bracket or brace is never closed"),
        ("a: 'x", "my.yaml:1:6: a quote is never closed"),
        ("1: x", "my.yaml:1:1: a key must be text; quote it: '1'"),
        ("[1]: x", "my.yaml:1:1: a key must be text"),
        ('"a\\e[31m": 1', "my.yaml:1:1: the key 'a\\x1b[31m' holds unprintable characters"),
        ("<<: {a: 1}", "my.yaml:1:1: '<<' is YAML 1.1; write the keys out"),
        ('a: "\\U00110000"', "my.yaml:1:7: an escape names no character"),
        ('a: "\\ud800"', "my.yaml:1:4: '\\ud800' is not text of valid characters"),
        (
            f"a: {'9' * 5000}",
            "my.yaml:1:4: '9999999999999999999999999999999999999...' has too many",
        ),
        ("a: !!int x", "my.yaml:1:4: 'x' is not of type !!int"),
        ("[" * 100_000, "my.yaml:1:40: is nested more than 40 deep"),
        (LADDER, "is nested more than 40 deep"),
        (BOMB, "holds more than 20000 values"),
        (b"a: 1 # " + b"x" * MAX_BYTES, "my.yaml: is larger than 256 KiB"),
    ],
)
def test_a_bad_file_is_one_clear_error(content, message, tmp_path):
    said = complaint(content, tmp_path)
    assert message in said
    assert "\n" not in said


def test_an_unreadable_file_is_reported(tmp_path, monkeypatch):
    with pytest.raises(YamlError, match="no such file"):
        load_yaml(tmp_path / "none.yaml")
    with pytest.raises(YamlError, match="is a directory, not a file"):
        load_yaml(tmp_path)
    with pytest.raises(YamlError, match="cannot be read"):
        load_yaml(tmp_path / "nul\0.yaml")

    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(yamlfile.Path, "open", refuse)  # root may read what chmod forbids
    with pytest.raises(YamlError, match=r"cannot be read \(Permission denied\)"):
        load_yaml(tmp_path / "secret.yaml")


def test_a_byte_order_mark_and_windows_line_ends_do_no_harm(tmp_path):
    document = load_yaml(written(tmp_path, b"\xef\xbb\xbfa: 1\r\nb: 2\r\n"))
    assert document.data == {"a": 1, "b": 2}
    assert document.marks[("b",)] == (2, 1)


YAML_LIKE = st.lists(
    st.sampled_from(
        [
            *"ab:- \n\t[]{}&*!|>'\"%#?,01.e\\~<@=\u2028\ufeff",
            "!!",
            "k: ",
            "\n  ",
            "&a ",
            "*a",
            "---",
            "\\U",
        ]
    ),
    max_size=30,
).map("".join)


@given(YAML_LIKE | st.text(st.characters(), max_size=30))
@settings(max_examples=60, deadline=None)
def test_no_text_raises_anything_but_a_yaml_error(text):
    with suppress(YamlError):
        assert isinstance(parse_yaml(text, HERE).data, dict)


@given(content=st.binary(max_size=60))
@settings(max_examples=60, deadline=None)
def test_no_bytes_raise_anything_but_a_yaml_error(content, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "bytes.yaml"
    path.write_bytes(content)
    with suppress(YamlError):
        assert isinstance(load_yaml(path).data, dict)


TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
TRICKY = st.sampled_from(
    ["1e-4", "on", "010", "0o7", "null", "~", "", "<<", "1:30", ".inf", " a ", "a: b"]
)
SCALARS = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | TEXT | TRICKY
KEYS = TEXT.filter(str.isprintable) | TRICKY
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner, max_size=4),
    max_leaves=10,
)


@given(st.dictionaries(KEYS, VALUES, max_size=5))
@settings(max_examples=60, deadline=None)
def test_dumped_values_are_read_back_equal(data):
    assert parse_yaml(dump_yaml(data), HERE).data == data


@given(st.floats(allow_nan=False))
@settings(deadline=None)
def test_floats_come_back_to_the_bit(value):
    read = parse_yaml(dump_yaml({"x": value}), HERE).data["x"]
    assert isinstance(read, float)
    assert read.hex() == value.hex()
