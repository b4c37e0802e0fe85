"""Every way to read a log finds what was written, and what is said of it afterwards."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer
from support.small_log import require_right_index, write_small
from typer.testing import CliRunner

from pamctl.cli.app import app
from pamctl.log import Log, LogError, columns, info, read
from pamctl.log.check import check_log
from pamctl.log.edit import append_metadata, cut_log, read_annotation, write_annotation
from pamctl.log.framing import map_log_file
from pamctl.log.reader import read_paged, read_some
from pamctl.log.record_walk import walk_records
from pamctl.log.recover import recover_file
from pamctl.log.run_meta import ANNOTATION, Annotation, AnnotationError, make_annotation
from pamctl.log.schema import EVENT_TOPIC, TICK_TOPIC, tick_descriptor
from pamctl.signals import Field

NEEDED = (
    Field("tick", int, "timing"),
    Field("t_s", float, "timing"),
    Field("dt_s", float, "timing"),
    Field("missed", int, "timing"),
)
EXTRA = {"position_m": float, "valve_v": float, "encoder_counts": int, "saturated": bool}
PACKING = {
    "compression": st.sampled_from(CompressionType),
    "use_chunking": st.booleans(),
    "chunk_size": st.sampled_from((1, 300, 5000)),
    "enable_crcs": st.booleans(),
    "enable_data_crcs": st.booleans(),
    "use_statistics": st.booleans(),
    "use_summary_offsets": st.booleans(),
    "repeat_channels": st.booleans(),
    "index_types": st.sampled_from((IndexType.NONE, IndexType.MESSAGE, IndexType.ALL)),
}


@dataclass
class Written:
    """What was put into a log."""

    path: Path
    columns: dict[str, list[Any]]
    kinds: dict[str, type]
    events: list[dict[str, Any]]
    packing: dict[str, Any]

    def equals(self, log: Log, rows: slice = slice(None)) -> None:
        for name, values in self.columns.items():
            found = np.asarray(log[name])
            assert found.dtype == np.dtype(self.kinds[name]), name
            np.testing.assert_array_equal(found, np.array(values[rows], self.kinds[name]), name)


@pytest.fixture(autouse=True)
def small_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a small log have many pages."""
    monkeypatch.setattr(columns, "PAGE_TICKS", 7)
    monkeypatch.setattr(columns, "_KEPT_PAGES", 2)


@st.composite
def logs(draw: st.DrawFn, path: Path) -> Written:
    """Write ticks of any columns, some events and a foreign topic, packed in any way."""
    extra = draw(st.lists(st.sampled_from(sorted(EXTRA)), unique=True))
    fields = draw(st.permutations([*NEEDED, *(Field(n, EXTRA[n], "x") for n in extra)]))
    count = draw(st.integers(1, 40))
    steps = draw(st.lists(st.integers(1, 3), min_size=count, max_size=count))
    tick = np.cumsum(steps, dtype=int).tolist()
    chance = np.random.default_rng(draw(st.integers(0, 9)))
    values: dict[str, list[Any]] = {
        "tick": tick,
        "t_s": [0.25 * number for number in tick],
        "dt_s": [0.25 * step for step in steps],
        "missed": [step - 1 for step in steps],
        "position_m": chance.choice([0.5, np.nan, -np.inf, 1e-300], count).tolist(),
        "valve_v": chance.normal(size=count).tolist(),
        "encoder_counts": chance.integers(-(2**62), 2**62, count).tolist(),
        "saturated": chance.choice([True, False], count).tolist(),
    }
    described = FileDescriptorSet.FromString(tick_descriptor(fields))
    if draw(st.booleans()):  # a field whose width is not fixed: ticks of any length
        (number,) = (f for f in described.file[0].message_type[0].field if f.name == "missed")
        number.type = FieldDescriptorProto.TYPE_INT32
    pool = DescriptorPool()
    pool.Add(described.file[0])
    message = GetMessageClass(pool.FindMessageTypeByName("pamctl.Tick"))
    packing = {name: draw(option) for name, option in PACKING.items()}
    events = [{"event": "mark", "text": f"mark {n}", "tick": n} for n in tick[::5]]
    with path.open("wb") as stream:
        writer = Writer(stream, **packing)
        writer.start()
        schema = writer.register_schema("pamctl.Tick", "protobuf", described.SerializeToString())
        ticks = writer.register_channel(TICK_TOPIC, "protobuf", schema)
        marks = writer.register_channel(EVENT_TOPIC, "json", 0)
        foreign = writer.register_channel("/camera", "raw", 0)
        writer.add_metadata("run", {"law": "qsmc"})
        for row, number in enumerate(tick):
            kept = {f.name: values[f.name][row] for f in fields}
            kept = {name: v for name, v in kept.items() if not (name == "position_m" and v != v)}
            payload = message(**kept).SerializeToString()
            at_ns = 250_000_000 * number
            writer.add_message(ticks, at_ns, payload, at_ns, number)
            if row % 5 == 0:
                text = json.dumps(events[row // 5]).encode()
                writer.add_message(marks, at_ns, text, at_ns, number)
                writer.add_message(foreign, at_ns, b"\xff\x00", at_ns)
        writer.add_metadata("end", {"reason": "done"})  # behind a chunk that may have no index
        writer.finish()
    names = [field.name for field in fields]
    kinds = {field.name: field.kind for field in fields}
    return Written(path, {name: values[name] for name in names}, kinds, events, packing)


@settings(max_examples=30)
@given(data=st.data())
def test_every_way_to_read_a_log_finds_what_was_written(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("any")
    written = data.draw(logs(folder / "a.mcap"))
    count = len(written.columns["tick"])
    log, paged = read(written.path), read_paged(written.path)
    for one in (log, paged):
        written.equals(one)
        assert list(one.columns) == list(written.columns)
        assert (len(one), one.events) == (count, written.events)
        assert np.asarray(one.time_ns).tolist() == [
            250_000_000 * n for n in written.columns["tick"]
        ]
        for part in ("gains", "keyframes", "config", "attachments", "metadata", "counts", "units"):
            assert getattr(one, part) == getattr(log, part)
        for row in range(0, count, 3):
            np.testing.assert_equal(one["t_s"][row : row + 9], log["t_s"][row : row + 9])
    some = read_some(written.path, ("t_s", "position_m", "force_n"))
    assert set(some.columns) == {"t_s", "position_m"} & set(written.columns)
    np.testing.assert_equal(some["t_s"], log["t_s"])

    told = info(written.path)
    assert (told["ticks"], told["complete"], told["law"]) == (count, True, "qsmc")
    missed = written.columns["missed"][1:]
    assert (told["missed_ticks"], told["gaps"]) == (sum(missed), sum(n > 0 for n in missed))
    report = check_log(written.path)
    assert report.ticks == count
    # Of what this writer leaves out, nothing is wrong; the log is no run of pamctl.
    wrong = {f.key for f in report.findings if f.level == "error"}
    assert wrong <= {"version", "units", "columns", "config", "empty"}, report.findings

    for remark in ("first", "second"):
        append_metadata(written.path, remark, {"a": "b"})
        written.equals(read(written.path))
        again = {f.key for f in check_log(written.path).findings if f.level == "error"}
        assert again <= wrong, remark

    if count > 2:
        first = data.draw(st.integers(0, count - 2))
        cut_log(written.path, folder / "piece.mcap", from_row=first)
        written.equals(read(folder / "piece.mcap"), slice(first, None))
        require_right_index(folder / "piece.mcap")
    if written.packing["enable_data_crcs"]:
        recovery = recover_file(written.path, folder / "saved.mcap")
        assert (recovery.lossless, recovery.damage) == (True, ())
        written.equals(read(folder / "saved.mcap"))
        require_right_index(folder / "saved.mcap")
        assert read(folder / "saved.mcap").counts == log.counts


# --- annotations ---------------------------------------------------------------------------------

GOLDEN = Path(__file__).parents[1] / "golden" / "qsmc.mcap"


def copy_golden(tmp_path: Path) -> Path:
    return Path(shutil.copy(GOLDEN, tmp_path / "run.mcap"))


def data_of(path: Path) -> bytes:
    """Return all bytes before the end of the data section."""
    file = map_log_file(path)
    return bytes(file[: next(r.start for r in walk_records(file) if r.opcode == Opcode.DATA_END)])


def test_an_annotation_leaves_every_byte_of_the_data_and_passes_the_check(tmp_path):
    path = copy_golden(tmp_path)
    before, when_ns = data_of(path), path.stat().st_mtime_ns
    for number in range(3):
        write_annotation(path, read_annotation(path).add_tag(f"tag{number}"))
    assert data_of(path).startswith(before)
    assert path.stat().st_mtime_ns == when_ns
    report = check_log(path)
    assert report.ok, report.findings
    require_right_index(path)
    assert read_annotation(path).tags == ("tag0", "tag1", "tag2")
    assert info(path)["tags"] == ["tag0", "tag1", "tag2"]
    assert list(tmp_path.iterdir()) == [path]


def test_the_readers_of_the_mcap_package_read_what_they_read_before(tmp_path):
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
def test_the_newest_annotation_counts_also_after_a_recovery(steps, tmp_path_factory):
    path = write_small(tmp_path_factory.mktemp("steps") / "log.mcap")
    said = Annotation()
    for adds, tag in steps:
        said = said.add_tag(tag) if adds else said.drop_tag(tag)
        write_annotation(path, said)
    assert read_annotation(path) == said
    recovered = path.with_name("recovered.mcap")
    assert recover_file(path, recovered).lossless
    assert read_annotation(recovered) == said


def test_a_piece_of_a_log_keeps_what_is_said_of_it(tmp_path):
    path = copy_golden(tmp_path)
    write_annotation(path, make_annotation(["good"]))
    cut_log(path, tmp_path / "piece.mcap", from_row=0, to_row=100)
    assert read_annotation(tmp_path / "piece.mcap").tags == ("good",)


def test_no_index_is_added_behind_what_follows_its_chunk(tmp_path):
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


def test_damage_from_before_is_found_and_stays(tmp_path):
    path = copy_golden(tmp_path)
    octets = bytearray(path.read_bytes())
    octets[len(octets) // 2] ^= 1
    path.write_bytes(octets)
    with pytest.raises(LogError, match=f"is damaged.*pamctl log recover {path}"):
        append_metadata(path, "remark", {"a": "b"})
    assert path.read_bytes() == octets


@pytest.mark.parametrize("keep", [8, 5000, -30])
def test_a_log_that_is_not_finished_is_refused_and_stays(tmp_path, keep):
    path = tmp_path / "half.mcap"
    path.write_bytes(GOLDEN.read_bytes()[:keep])
    before = path.read_bytes()
    with pytest.raises(LogError, match="not finished"):
        write_annotation(path, make_annotation(["good"]))
    assert path.read_bytes() == before
    assert read_annotation(path) == Annotation()


@pytest.mark.parametrize("tag", ["", "two words", "a,b", "x" * 65, "-a", "\x1b[31m", "a\u202eb c"])
def test_a_tag_is_one_word(tag):
    with pytest.raises(AnnotationError, match="one word"):
        make_annotation([tag])


def test_texts_of_a_foreign_record_are_cleaned_when_read(tmp_path):
    path = write_small(tmp_path / "log.mcap")
    hostile = {"tags": json.dumps(["good", "b\x1b[2Jad", 3, "no tag"]), "note": "a\x1b]0;x\x07b"}
    append_metadata(path, ANNOTATION, hostile)
    assert read_annotation(path) == Annotation(("good", "bad"), "ab")
    append_metadata(path, ANNOTATION, {"tags": "{"})
    assert read_annotation(path) == Annotation()


def test_a_run_carries_what_is_said_of_it(tmp_path):
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
