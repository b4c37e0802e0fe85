"""A long log: time and memory of the log tools, and the recovery after a killed recorder.

Prints one JSON document. Anonymous memory is a process's own; the mapped pages of the file belong
to the kernel's cache and are counted separately.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from bench_log import make_up_ticks, put_when_there_is_room

from pamctl.log import read
from pamctl.log.framing import Damage, map_log_file
from pamctl.log.reading.record_walk import walk_records
from pamctl.log.recover import recover_file
from pamctl.log.run_meta import RunMeta
from pamctl.log.schema import TICK_TOPIC
from pamctl.log.wire import TickLayout, make_message_records
from pamctl.log.writer import LogWriter, begin_log
from pamctl.recording.recorder import await_recorder, spawn_recorder
from pamctl.recording.ring import Ring
from pamctl.signals import TICK_FIELDS

CHUNK_TICKS = 250
CHUNK = 6

TOOLS = {
    "info": "from pamctl.log import info; info({path!r})",
    "check": "from pamctl.log.check import check_log; check_log({path!r})",
    "read, all columns": "from pamctl.log import read; read({path!r})",
    "read, four columns": (
        "from pamctl.log import read;"
        "read({path!r}, fields=('t_s', 'applied_v', 'pressure_pa', 'position_m'))"
    ),
    "recover": (
        "from pamctl.log.recover import recover_file;recover_file({path!r}, {path!r} + '.saved')"
    ),
}


def write_long(path: Path, ticks: int) -> None:
    """Write ticks of noise, as hard to compress as a real run's, in the recorder's chunks."""
    chance = np.random.default_rng(1)
    layout = TickLayout.of_fields(TICK_FIELDS)
    kinds = {field.name: field.kind for field in TICK_FIELDS}
    with path.open("wb") as stream:
        writer = LogWriter(stream)
        channel = begin_log(writer, RunMeta(str(path)))[TICK_TOPIC]
        for start in range(0, ticks, CHUNK_TICKS):
            tick = np.arange(start, min(start + CHUNK_TICKS, ticks))
            table = np.zeros(len(tick), layout.dtype)
            for name in layout.names:
                noise = chance.normal(1e-3 * tick, 1e-4)
                table[name] = noise if kinds[name] is float else np.zeros(len(tick))
            table["tick"], table["t_s"], table["dt_s"] = tick, tick * 1e-3, 1e-3
            messages = make_message_records(layout.encode(table), tick * 1_000_000, tick)
            writer.add(channel, messages)
            writer.end_chunk()
        writer.finish()


def measure(code: str) -> dict[str, float]:
    """Run a tool in a separate process; sample its memory while it runs."""
    began = time.perf_counter()
    anonymous = mapped_file = 0
    with subprocess.Popen([sys.executable, "-c", code]) as process:
        while process.poll() is None:
            held = _memory_kb(process.pid)
            anonymous = max(anonymous, held.get("RssAnon", 0))
            mapped_file = max(mapped_file, held.get("RssFile", 0))
            time.sleep(0.02)
    if process.returncode:
        raise SystemExit(f"failed: {code}")
    took = time.perf_counter() - began
    return {"s": took, "anonymous_mb": anonymous / 1e3, "file_pages_mb": mapped_file / 1e3}


def _memory_kb(pid: int) -> dict[str, int]:
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return {}
    lines = (line.split() for line in status.splitlines() if line.startswith("Rss"))
    return {name.rstrip(":"): int(value) for name, value, _ in lines}


def kill_recorder(directory: Path, rings: Path) -> dict[str, Any]:
    """Kill a recorder during a run, and recover its file alone, without the ring."""
    path, saved = directory / "killed.mcap", directory / "saved.mcap"
    with (
        Ring.create(rings / "kill.ring", RunMeta(str(path))) as ring,
        spawn_recorder(ring.path) as process,
    ):
        await_recorder(ring, process)
        for tick in make_up_ticks(20_000):
            put_when_there_is_room(ring, tick)
        process.send_signal(signal.SIGKILL)
        process.wait()
        ring.unlink()
    began = time.perf_counter()
    recovery = recover_file(path, saved)
    took = time.perf_counter() - began
    return {
        "chunks_in_file": _whole_chunks(path),
        "chunks_saved": _whole_chunks(saved),
        "ticks_saved": len(read(saved)),
        "bytes_lost": recovery.bytes_lost,
        "s": took,
    }


def _whole_chunks(path: Path) -> int:
    count = 0
    with suppress(Damage):  # where the file ends
        for record in walk_records(map_log_file(path)):
            count += record.opcode == CHUNK
    return count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ticks", type=int, default=3_600_000)
    parser.add_argument("--rings", type=Path, default=Path("/dev/shm"), help="folder for rings")
    arguments = parser.parse_args()
    with (
        tempfile.TemporaryDirectory() as directory,
        tempfile.TemporaryDirectory(dir=arguments.rings) as rings,
    ):
        path = Path(directory) / "long.mcap"
        write_long(path, arguments.ticks)
        result = {
            "ticks": arguments.ticks,
            "file_mb": path.stat().st_size / 1e6,
            "tools": {name: measure(code.format(path=str(path))) for name, code in TOOLS.items()},
            "killed_recorder": kill_recorder(Path(directory), Path(rings)),
        }
    json.dump(result, sys.stdout, indent=2)
    print()


if __name__ == "__main__":
    main()
