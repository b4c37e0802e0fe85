"""Tags and notes in a log: the data stay to the byte, and every other reader still reads it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import IndexType, Writer
from support.small_log import write_small
from typer.testing import CliRunner

from pamctl.cli.app import app
from pamctl.log import LogError, info
from pamctl.log.annotation import ANNOTATION, Annotation, AnnotationError, make_annotation
from pamctl.log.check import check_log
from pamctl.log.edit import append_metadata, cut_log, read_annotation, write_annotation
from pamctl.log.framing import map_log_file
from pamctl.log.record_walk import walk_records
from pamctl.log.recover import recover_file

GOLDEN = Path(__file__).parents[1] / "golden" / "qsmc.mcap"


def copy_golden(tmp_path: Path) -> Path:
    return Path(shutil.copy(GOLDEN, tmp_path / "run.mcap"))


def data_of(path: Path) -> bytes:
    """Return all bytes before the end of the data section."""
    file = map_log_file(path)
    return bytes(file[: next(r.start for r in walk_records(file) if r.opcode == Opcode.DATA_END)])


def test_an_annotation_leaves_every_byte_of_the_data_and_passes_the_check(tmp_path: Path) -> None:
    path = copy_golden(tmp_path)
    before, when_ns = data_of(path), path.stat().st_mtime_ns
    for number in range(3):
        write_annotation(path, read_annotation(path).add_tag(f"tag{number}"))
    assert data_of(path).startswith(before)
    assert path.stat().st_mtime_ns == when_ns
    report = check_log(path)
    assert report.ok, report.findings
    assert read_annotation(path).tags == ("tag0", "tag1", "tag2")
    assert info(path)["tags"] == ["tag0", "tag1", "tag2"]
    assert list(tmp_path.iterdir()) == [path]


def test_the_readers_of_the_mcap_package_read_what_they_read_before(tmp_path: Path) -> None:
    path = copy_golden(tmp_path)
    write_annotation(path, make_annotation(["good"], "new hose", "Ann", "M3"))
    with path.open("rb") as changed, GOLDEN.open("rb") as golden:
        new, old = make_reader(changed), make_reader(golden)
        assert [(c.topic, m.sequence, m.data) for _, c, m in new.iter_messages()] == [
            (c.topic, m.sequence, m.data) for _, c, m in old.iter_messages()
        ]
        found = {record.name: record.metadata for record in new.iter_metadata()}
        assert found[ANNOTATION].items() >= {
            "tags": '["good"]', "note": "new hose", "operator": "Ann", "sample": "M3",
        }.items()  # fmt: skip
        assert found.keys() - {ANNOTATION} == {record.name for record in old.iter_metadata()}
        summary, before = new.get_summary(), old.get_summary()
        assert summary is not None
        assert before is not None
        assert summary.statistics.metadata_count == before.statistics.metadata_count + 1
        assert summary.attachment_indexes == before.attachment_indexes
        changed.seek(0)
        records = list(StreamReader(changed, validate_crcs=True).records)
        assert len(records) > len(found)


@settings(max_examples=15)
@given(steps=st.lists(st.tuples(st.booleans(), st.sampled_from("abc")), max_size=6))
def test_the_newest_annotation_counts_also_after_a_recovery(
    steps: list[tuple[bool, str]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = write_small(tmp_path_factory.mktemp("steps") / "log.mcap")
    said = Annotation()
    for adds, tag in steps:
        said = said.add_tag(tag) if adds else said.drop_tag(tag)
        write_annotation(path, said)
    assert read_annotation(path) == said
    recovered = path.with_name("recovered.mcap")
    assert recover_file(path, recovered).lossless
    assert read_annotation(recovered) == said


def test_a_piece_of_a_log_keeps_what_is_said_of_it(tmp_path: Path) -> None:
    path = copy_golden(tmp_path)
    write_annotation(path, make_annotation(["good"]))
    cut_log(path, tmp_path / "piece.mcap", from_row=0, to_row=100)
    assert read_annotation(tmp_path / "piece.mcap").tags == ("good",)


def test_no_index_is_added_behind_what_follows_its_chunk(tmp_path: Path) -> None:
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1, index_types=IndexType.NONE)
        writer.start()
        channel = writer.register_channel("/x", "json", 0)
        writer.add_message(channel, 0, b"{}", 0)
        writer.add_metadata("end", {"a": "b"})
        writer.finish()
    append_metadata(path, "remark", {"c": "d"})
    data = data_of(path)
    assert [r.opcode for r in walk_records(map_log_file(path)) if r.start < len(data)] == [
        Opcode.HEADER, Opcode.CHUNK, Opcode.METADATA, Opcode.METADATA,
    ]  # fmt: skip


def test_damage_from_before_is_found_and_stays(tmp_path: Path) -> None:
    path = copy_golden(tmp_path)
    octets = bytearray(path.read_bytes())
    octets[len(octets) // 2] ^= 1
    path.write_bytes(octets)
    with pytest.raises(LogError, match=f"is damaged.*pamctl log recover {path}"):
        append_metadata(path, "remark", {"a": "b"})
    assert path.read_bytes() == octets


@pytest.mark.parametrize("keep", [8, 5000, -30])
def test_a_log_that_is_not_finished_is_refused_and_stays(tmp_path: Path, keep: int) -> None:
    path = tmp_path / "half.mcap"
    path.write_bytes(GOLDEN.read_bytes()[:keep])
    before = path.read_bytes()
    with pytest.raises(LogError, match="not finished"):
        write_annotation(path, make_annotation(["good"]))
    assert path.read_bytes() == before
    assert read_annotation(path) == Annotation()


def test_a_file_that_is_no_log_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "text.mcap"
    path.write_text("some text")
    with pytest.raises(LogError, match="not a log"):
        read_annotation(path)
    with pytest.raises(LogError):
        write_annotation(path, Annotation())


@pytest.mark.parametrize("tag", ["", "two words", "a,b", "x" * 65, "-a", "\x1b[31m", "a\u202eb c"])
def test_a_tag_is_one_word(tag: str) -> None:
    with pytest.raises(AnnotationError, match="one word"):
        make_annotation([tag])


def test_texts_of_a_foreign_record_are_cleaned_when_read(tmp_path: Path) -> None:
    path = write_small(tmp_path / "log.mcap")
    hostile = {"tags": json.dumps(["good", "b\x1b[2Jad", 3, "no tag"]), "note": "a\x1b]0;x\x07b"}
    append_metadata(path, ANNOTATION, hostile)
    assert read_annotation(path) == Annotation(("good", "bad"), "ab")
    append_metadata(path, ANNOTATION, {"tags": "{"})
    assert read_annotation(path) == Annotation()


def test_a_run_carries_what_is_said_of_it(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    words = ["run", "--fast", "--quiet", "--duration", "0.1", "--log", str(log), "--tag", "first"]
    words += ["--set", "rig.homing.enabled=false", "--note", "new \x1b[1mhose", "--operator", "Ann"]
    done = CliRunner().invoke(app, [*words, "--sample", "M3"])
    assert done.exit_code == 0, done.output
    assert read_annotation(log) == Annotation(("first",), "new hose", "Ann", "M3")
    assert list(tmp_path.iterdir()) == [log]
    page = log.with_suffix(".html")
    assert CliRunner().invoke(app, ["report", str(log)]).exit_code == 0
    for text in ("new hose", "Ann", "M3", "first"):
        assert f"<dd>{text}</dd>" in page.read_text()
    shown = CliRunner().invoke(app, ["log", "info", str(log)]).stdout
    assert "new hose" in shown
    assert CliRunner().invoke(app, [*words, "--tag", "two words"]).exit_code == 2
