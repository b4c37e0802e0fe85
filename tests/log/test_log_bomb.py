"""A small file that unpacks to a large one costs neither memory nor time."""

from __future__ import annotations

import subprocess
import sys
import zlib
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.records import Chunk, DataEnd, Footer
from mcap.writer import MCAP0_MAGIC
from support.small_log import CHUNK_TICKS, CHUNKS, write_small

from pamctl.log import read
from pamctl.log.framing import FRAME, encode_record, map_log_file, read_chunk_content, walk_records

HIDDEN_BYTES = 1 << 29
COSTS_MB = 300
"""The verb alone takes some 60."""


def _pack_zstd(content: bytes) -> bytes:
    return zstandard.compress(content)


def _pack_zstd_of_unknown_size(content: bytes) -> bytes:
    packer = zstandard.ZstdCompressor().compressobj()
    return packer.compress(content) + packer.flush()


def _pack_lz4(content: bytes) -> bytes:
    return lz4.frame.compress(content)


PACKERS = {
    "zstd": _pack_zstd,
    "zstd-of-unknown-size": _pack_zstd_of_unknown_size,
    "lz4": _pack_lz4,
}


def _write_packed(path: Path, packer: str, hides: bytes = b"", declared: int = 0) -> None:
    """Write a small log with other packing; its first chunk may hold other bytes than it did."""
    small = write_small(path.with_name("small.mcap"))
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
import resource, subprocess, sys
code = subprocess.run(sys.argv[1:]).returncode
print(code, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""
"""A small process measures: a child begins with the memory of who starts it."""


@pytest.mark.parametrize("declared", [100, HIDDEN_BYTES])
@pytest.mark.parametrize("packer", PACKERS)
def test_a_chunk_that_hides_half_a_gigabyte_is_damage_and_costs_nothing(packer, declared, tmp_path):
    log, saved = tmp_path / "bomb.mcap", tmp_path / "saved.mcap"
    _write_packed(log, packer, bytes(HIDDEN_BYTES), declared)
    assert log.stat().st_size < 4 << 20
    for words in (["check", log], ["recover", log, saved]):
        command = [sys.executable, "-m", "pamctl", "log", *map(str, words)]
        done = subprocess.run(
            [sys.executable, "-c", _MEASURE, *command], capture_output=True, text=True, check=False
        )
        code, peak_kb = map(int, done.stdout.splitlines()[-1].split())
        assert code == 3, done
        assert peak_kb < COSTS_MB << 10
    assert len(read(saved)) == (CHUNKS - 1) * CHUNK_TICKS


@pytest.mark.parametrize("packer", PACKERS)
def test_a_chunk_that_holds_what_it_declares_is_read_however_it_is_packed(packer, tmp_path):
    log = tmp_path / "log.mcap"
    _write_packed(log, packer)
    assert len(read(log)) == CHUNKS * CHUNK_TICKS
