"""However a file is damaged: no traceback, and no wrong value that looks right."""

from __future__ import annotations

import os
import random
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from mcap.opcode import Opcode
from support.small_log import CHUNK_TICKS, rewritten, write_small

from pamctl.log import Log, LogError, info, read
from pamctl.log.check import check_log
from pamctl.log.framing import map_log_file
from pamctl.log.record_walk import walk_records
from pamctl.log.recover import Recovery, recover_file


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
    """Found by scripts/fuzz.py, with a summary whose checksum is right."""

    def spoil(record):
        body = bytes(record.body)
        return body.replace(b"protobuf", b"\xc9" * 8) if record.opcode == Opcode.SCHEMA else body

    spoilt = written(tmp_path / "a.mcap", rewritten(whole, spoil))
    assert b"\xc9" * 8 in spoilt.read_bytes()
    recovery = recover_file(spoilt, tmp_path / "saved.mcap")
    assert recovery.messages["/pam/tick"] == len(read(whole))
