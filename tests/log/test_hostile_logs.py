"""Hostile logs: cut, flipped, holed, or made to take all memory; nothing wrong passes as good."""

import os
import random
import sys
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.records import Chunk, DataEnd, Footer
from mcap.writer import MCAP0_MAGIC
from support.command_line import run_process
from support.small_log import CHUNK_TICKS, CHUNKS, require_right_index, rewritten, write_small

from pamctl.base.new_file import create_new_file
from pamctl.log import Log, LogError, info, read
from pamctl.log.check import check_log
from pamctl.log.framing import FRAME, encode_record, map_log_file
from pamctl.log.record_walk import MOST_CHUNK_BYTES, read_chunk_content, walk_records
from pamctl.log.recover import Recovery, recover_file
from pamctl.log.schema import TICK_MESSAGE, TICK_TOPIC, tick_descriptor
from pamctl.log.wire import make_message_records
from pamctl.log.writer import LogWriter
from pamctl.signals import Field


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    return write_small(tmp_path_factory.mktemp("fuzz") / "whole.mcap")


@pytest.fixture(autouse=True)
def _thousands_of_files_need_not_reach_the_disk(monkeypatch):
    monkeypatch.setattr(os, "fsync", lambda fd: None)


def written(path: Path, content: bytes) -> Path:
    """Write a new file: emptying an existing one makes some file systems wait for the disk."""
    path.unlink(missing_ok=True)
    path.write_bytes(content)
    return path


def cuts(whole: Path) -> list[int]:
    """Places around each record's frame, and every 60th within its body."""
    content = whole.read_bytes()
    frames = [record.start for record in walk_records(map_log_file(whole))]
    near = {at + off for at in (*frames, len(content)) for off in (-9, -1, 0, 1, 8, 9, 10, 18)}
    return sorted((near | {*range(0, len(content), 60)}) & {*range(len(content))})


def rows(log: Log) -> dict[int, dict[str, Any]]:
    """Return the ticks of a log by number."""
    columns = [column.tolist() for column in log.columns.values()]
    return {row[0]: dict(zip(log.columns, row, strict=True)) for row in zip(*columns, strict=True)}


def assert_nothing_wrong_is_passed_as_good(
    original: Log, damaged: Path, *, by_all: bool = True
) -> Recovery | None:
    """Give a damaged file to `read` and `recover`, or to all tools; return the recovery."""
    with pytest.raises(LogError):
        read(damaged)
    if by_all:
        with suppress(LogError):
            assert not info(damaged)["complete"]
        with suppress(LogError):
            assert not check_log(damaged).ok
    saved = damaged.with_name("saved.mcap")
    saved.unlink(missing_ok=True)
    try:
        recovery = recover_file(damaged, saved)
    except LogError:
        assert not saved.exists()
        return None
    assert_true_of(original, read(saved, *recovery.messages), recovery)
    if by_all and "/pam/tick" in recovery.messages:
        assert check_log(saved).ok, check_log(saved)
        require_right_index(saved)
    return recovery


def assert_true_of(original: Log, saved: Log, recovery: Recovery) -> None:
    """Check that everything that was saved equals the original."""
    truth = rows(original)
    assert all(row == truth[tick] for tick, row in rows(saved).items())
    assert all(event in original.events for event in saved.events)
    for name, data in saved.attachments.items():
        assert original.attachments[name] == data
    for name, values in saved.metadata.items():
        if name != "recovery" and name not in recovery.unverified:
            assert original.metadata[name] == values
    if recovery.lossless:
        assert rows(saved) == truth
        assert saved.events == original.events


@pytest.mark.long
def test_a_log_cut_anywhere_is_refused_and_what_is_saved_of_it_is_true(whole, tmp_path):
    original, content = read(whole), whole.read_bytes()
    saved = -1
    for end in cuts(whole):
        cut = written(tmp_path / "a.mcap", content[:end])
        recovery = assert_nothing_wrong_is_passed_as_good(original, cut, by_all=end % 7 == 0)
        ticks = recovery.messages.get("/pam/tick", 0) if recovery else 0
        assert ticks >= saved  # a longer prefix never saves less
        saved = ticks
    assert saved == len(original)


def test_a_flipped_bit_is_refused_and_what_is_saved_is_true(whole, tmp_path):
    original, content = read(whole), whole.read_bytes()
    chance = random.Random(7)
    fewest = len(original)
    for count in range(150):
        flipped = bytearray(content)
        flipped[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
        hurt = written(tmp_path / "a.mcap", flipped)
        recovery = assert_nothing_wrong_is_passed_as_good(original, hurt, by_all=count % 4 == 0)
        fewest = min(fewest, recovery.messages.get("/pam/tick", 0) if recovery else 0)
    # One bit costs one chunk: the rest is found after it, wherever the bit was.
    assert fewest == len(original) - CHUNK_TICKS


def test_a_hole_costs_no_more_than_the_chunks_that_it_touches(whole, tmp_path):
    original, content = read(whole), whole.read_bytes()
    chance = random.Random(8)
    for _ in range(40):
        at = chance.randrange(len(content) - 40)
        holed = content[:at] + bytes(40) + content[at + 40 :]
        if holed == content:
            continue
        hurt = written(tmp_path / "a.mcap", holed)
        recovery = assert_nothing_wrong_is_passed_as_good(original, hurt)
        assert recovery is not None
        assert recovery.messages["/pam/tick"] >= len(original) - 2 * CHUNK_TICKS


def test_a_description_that_is_no_text_costs_nothing_where_the_chunks_hold_another(whole, tmp_path):
    """Found by fuzzing, with a summary whose checksum is right."""

    def spoil(record):
        body = bytes(record.body)
        return body.replace(b"protobuf", b"\xc9" * 8) if record.opcode == Opcode.SCHEMA else body

    spoilt = written(tmp_path / "a.mcap", rewritten(whole, spoil))
    assert b"\xc9" * 8 in spoilt.read_bytes()
    recovery = recover_file(spoilt, tmp_path / "saved.mcap")
    assert recovery.messages["/pam/tick"] == len(read(whole))


# --- small files that hide much memory -----------------------------------------------------------

HIDDEN_BYTES = 1 << 28
COSTS_MB = 200
"""Reading alone takes some 60."""


def _pack_zstd_of_unknown_size(content: bytes) -> bytes:
    packer = zstandard.ZstdCompressor().compressobj()
    return packer.compress(content) + packer.flush()


PACKERS = {
    "zstd": zstandard.compress,
    "zstd-of-unknown-size": _pack_zstd_of_unknown_size,
    "lz4": lz4.frame.compress,
}


def _write_packed(path: Path, packer: str, hides: bytes = b"", declared: int = 0) -> None:
    """Write a small log with other packing; its first chunk may hold other bytes than it did."""
    small = write_small(path.with_name(f"small-{path.name}"))
    out = bytearray(MCAP0_MAGIC)
    for record in walk_records(map_log_file(small)):
        if record.opcode == Opcode.CHUNK:
            chunk = Chunk.read(record.stream())
            content = hides or read_chunk_content(chunk)
            chunk.compression = packer.partition("-")[0]
            chunk.data, chunk.uncompressed_crc = PACKERS[packer](content), zlib.crc32(content)
            chunk.uncompressed_size = declared or len(content)
            out += encode_record(chunk)
            hides, declared = b"", 0
        elif record.opcode == Opcode.DATA_END:
            out += encode_record(DataEnd(0))
        elif record.opcode == Opcode.FOOTER:
            out += encode_record(Footer(0, 0, 0))
        else:
            out += FRAME.pack(record.opcode, len(record.body)) + record.body
    path.write_bytes(out + MCAP0_MAGIC)


_MEASURE = """
import resource, sys
from pamctl.log.check import check_log
from pamctl.log.recover import recover_file
for log in sys.argv[1:]:
    print(check_log(log).ok, recover_file(log, log + ".saved.mcap").lossless)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
_STARTER = "import subprocess, sys; sys.exit(subprocess.run(sys.argv[1:]).returncode)"
"""A small process starts the one that is measured: a child begins with its parent's memory."""


def test_a_chunk_that_hides_much_memory_is_damage_and_costs_nothing(tmp_path):
    logs = []
    for packer, declared in (*((packer, 100) for packer in PACKERS), ("zstd", HIDDEN_BYTES)):
        logs.append(tmp_path / f"{packer}-{declared}.mcap")
        _write_packed(logs[-1], packer, bytes(HIDDEN_BYTES), declared)
        assert logs[-1].stat().st_size < 4 << 20
    python = [sys.executable, "-c"]
    command = [*python, _STARTER, *python, _MEASURE, *map(str, logs)]
    done = run_process(command, check=True)
    *told, peak_kb = done.stdout.split()
    assert told == ["False", "False"] * len(logs)
    assert int(peak_kb) < COSTS_MB << 10
    for log in logs:
        assert len(read(f"{log}.saved.mcap")) == (CHUNKS - 1) * CHUNK_TICKS


def _write_chunks(path: Path, content: bytes, count: int) -> None:
    """Write a small log with further chunks of this content at its end."""
    small = map_log_file(write_small(path.with_name(f"small-{path.name}")))
    end = next(r.start for r in walk_records(small) if r.opcode == Opcode.DATA_END)
    chunk = Chunk("zstd", zstandard.compress(content), 0, 0, zlib.crc32(content), len(content))
    tail = encode_record(DataEnd(0)) + encode_record(Footer(0, 0, 0)) + MCAP0_MAGIC
    path.write_bytes(bytes(small[:end]) + count * encode_record(chunk) + tail)


def test_a_small_file_of_many_large_chunks_is_refused_with_its_sizes(tmp_path, monkeypatch):
    monkeypatch.setattr("pamctl.log.record_walk.MOST_SILENT_BYTES", 1 << 27)
    private = FRAME.pack(128, MOST_CHUNK_BYTES - FRAME.size) + bytes(MOST_CHUNK_BYTES - FRAME.size)
    _write_chunks(tmp_path / "few.mcap", private, 1)
    assert len(read(tmp_path / "few.mcap")) == CHUNKS * CHUNK_TICKS
    _write_chunks(tmp_path / "many.mcap", private, 3)
    for use in (read, info, check_log, lambda path: recover_file(path, tmp_path / "saved.mcap")):
        with pytest.raises(LogError, match=r"has 0.\d+ MB and unpacks to more than 134 MB"):
            use(tmp_path / "many.mcap")
    assert not (tmp_path / "saved.mcap").exists()


def _make_message(channel: int, body: bytes) -> bytes:
    head = channel.to_bytes(2, "little") + bytes(20)
    return FRAME.pack(Opcode.MESSAGE, len(head) + len(body)) + head + body


@pytest.mark.parametrize(
    "content",
    [FRAME.pack(128, 0) * 6_000, (_make_message(2, b"{}") + _make_message(2, b"{ }")) * 3_000],
)
def test_countless_tiny_records_in_a_small_file_are_refused(content, tmp_path, monkeypatch):
    monkeypatch.setattr("pamctl.log.record_walk.MOST_PARTS", 5_000)
    _write_chunks(tmp_path / "a.mcap", content, 1)
    for use in (read, info, check_log, lambda path: recover_file(path, tmp_path / "saved.mcap")):
        with pytest.raises(LogError, match="more than 5000 records that differ"):
            use(tmp_path / "a.mcap")


def test_what_does_not_belong_into_a_chunk_costs_none_of_its_messages(tmp_path):
    content = FRAME.pack(Opcode.METADATA, 2) + b"\xff\xff" + _make_message(2, b'{"event":"x"}')
    _write_chunks(tmp_path / "a.mcap", content, 1)
    recovery = recover_file(tmp_path / "a.mcap", tmp_path / "b.mcap")
    again = recover_file(tmp_path / "b.mcap", tmp_path / "c.mcap")
    assert recovery.messages["/pam/event"] == again.messages["/pam/event"] == CHUNKS + 1


def test_ticks_of_many_columns_and_few_bytes_are_refused_before_they_fill_the_memory(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr("pamctl.log.reader.MOST_SILENT_BYTES", 1 << 20)
    fields = [Field(f"a{number}", float, "measurement") for number in range(400)]
    with create_new_file(tmp_path / "a.mcap") as stream:
        writer = LogWriter(stream)
        schema = (TICK_MESSAGE, "protobuf", tick_descriptor(fields))
        channel = writer.channel(TICK_TOPIC, "protobuf", schema)
        ticks = np.zeros(5000, "V2")
        ticks.view("u1").reshape(-1, 2)[:] = 0x78, 1  # an unknown field, and nothing else
        writer.add(channel, make_message_records(ticks, np.arange(5000), np.arange(5000)))
        writer.finish()
    with pytest.raises(LogError, match="more than twice their bytes in the file"):
        read(tmp_path / "a.mcap")
    assert (
        "MB of memory; `pamctl log cut LOG --out SHORTER.mcap --to-s 600` makes"
        in capsys.readouterr().err
    )


def test_messages_of_channels_that_take_turns_take_no_longer_than_others(tmp_path):
    # 40 000 runs of one message: each looked at all that followed, 800 000 000 messages.
    content = (_make_message(2, b"{}") + _make_message(2, b"{ }")) * 20_000
    _write_chunks(tmp_path / "a.mcap", content, 1)
    assert len(read(tmp_path / "a.mcap").events) == CHUNKS + 40_000


@pytest.mark.parametrize(
    ("message", "count", "why"),
    [
        (b'{"event":[' + b"[]," * 400_000 + b"0]}", 1, "a JSON message has 1.2 MB"),
        (b'{"event":1}', 500_000, "more than 21 MB of /pam/event"),
    ],
)
def test_events_that_no_run_writes_are_not_made_into_objects(message, count, why, tmp_path):
    frame = FRAME.pack(Opcode.MESSAGE, 22 + len(message)) + b"\x02\0" + bytes(20) + message
    _write_chunks(tmp_path / "a.mcap", frame * count, 1)
    with pytest.raises(LogError, match=why):
        read(tmp_path / "a.mcap")
