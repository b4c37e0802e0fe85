"""Whatever a log holds and whichever writer packed it: every way to read it finds the same."""

from __future__ import annotations

import json
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
from mcap.writer import CompressionType, IndexType, Writer

from pamctl.log import Log, columns, info, read
from pamctl.log.check import check_log
from pamctl.log.edit import append_metadata, cut_log
from pamctl.log.reader import read_paged, read_some
from pamctl.log.recover import recover_file
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
def test_every_way_to_read_a_log_finds_what_was_written(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
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
    if written.packing["enable_data_crcs"]:
        recovery = recover_file(written.path, folder / "saved.mcap")
        assert (recovery.lossless, recovery.damage) == (True, ())
        written.equals(read(folder / "saved.mcap"))
        assert read(folder / "saved.mcap").counts == log.counts
