"""Cost of the log: the loop's put, the recorder's throughput, bytes of a tick, reading.

Prints one JSON document. Compare ratios within a run, not numbers between machines.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_type_hints

from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from pamctl.recording.rows import PLAIN_TICK, TickRow, make_rows

from pamctl.log.importing.pipeline import import_log
from pamctl.log.reader import read
from pamctl.log.run_meta import RunMeta
from pamctl.log.schema import TICK_TOPIC
from pamctl.recording.recorder import await_recorder, spawn_recorder
from pamctl.recording.ring import Ring, RingFull
from pamctl.signals import TICK_STAGES, TickRecord


def make_up_ticks(count: int) -> list[TickRecord]:
    """Return ticks whose floats are noise on a trend: as hard to compress as a real run's."""
    chance = random.Random(1)
    stages = [(signals, get_type_hints(signals).values()) for signals in _stage_types()]

    def value(kind: type, index: int) -> Any:
        return chance.gauss(1e-3 * index, 1e-4) if kind is float else kind(index)

    return [
        TickRecord(
            *(signals._make(value(kind, index) for kind in kinds) for signals, kinds in stages)
        )
        for index in range(count)
    ]


def pack_ticks(ticks: list[TickRecord]) -> list[bytearray]:
    """Return ticks as rows of the ring, as a kernel leaves them."""
    rows = make_rows(False, 1)
    packed = []
    for tick in ticks:
        rows[0] = TickRow(PLAIN_TICK, tick.timing.tick, tick.raw.encoder_t_ns, tick)
        packed.append(bytearray(rows.buffer))
    return packed


def _stage_types() -> list[Any]:
    return list(TICK_STAGES.values())


def put_cost(directory: Path, ticks: list[TickRecord]) -> dict[str, float]:
    """Time each put into a ring with room, without the cost of the timer itself."""
    clock = time.perf_counter_ns
    costs, empty = [], []
    with Ring.create(directory / "put.ring", RunMeta("unused.mcap"), len(ticks)) as ring:
        for row in pack_ticks(ticks):
            before = clock()
            ring.put_row(row)
            costs.append(clock() - before)
            before = clock()
            empty.append(clock() - before)
        ring.unlink()
    own = quantile(empty, 0.5)
    return {f"p{q * 100:g}_us": (quantile(costs, q) - own) / 1e3 for q in (0.5, 0.99, 0.999)}


def import_text(directory: Path, rows: int) -> dict[str, float]:
    """Import a CSV file of measured rows at 1 kHz."""
    chance = random.Random(1)
    source = directory / "bench.csv"
    with source.open("w") as file:
        file.write("Time [s],Valve command [V],Pressure [kPa gauge],Position [mm]\n")
        for row in range(rows):
            t_s = 1e-3 * row
            pressure = 200.0 + 50.0 * math.sin(t_s) + chance.gauss(0.0, 0.3)
            motion = 12.0 + 4.0 * math.sin(t_s)
            file.write(f"{t_s:.3f},{math.sin(2.0 * t_s):.4f},{pressure:.4f},{motion:.5f}\n")
    began = time.perf_counter()
    import_log(source, directory / "imported.mcap")
    return {"rows_per_s": rows / (time.perf_counter() - began)}


def quantile(values: list[int], share: float) -> int:
    return sorted(values)[int(share * (len(values) - 1))]


def record(directory: Path, ticks: list[TickRecord], log: Path) -> dict[str, float]:
    """Log ticks as fast as a real recorder process takes them."""
    with (
        Ring.create(directory / "record.ring", RunMeta(str(log))) as ring,
        spawn_recorder(ring.path) as rec,
    ):
        await_recorder(ring, rec)
        began = time.perf_counter()
        for row in pack_ticks(ticks):
            put_when_there_is_room(ring, row)
        ring.loop_done = 1
        rec.wait()
        took = time.perf_counter() - began
        ring.unlink()
    return {"ticks_per_s": len(ticks) / took, "bytes_per_tick": log.stat().st_size / len(ticks)}


def put_when_there_is_room(ring: Ring, row: bytearray) -> None:
    while True:
        try:
            return ring.put_row(row)
        except RingFull:
            time.sleep(2e-4)


def stock_reader(log: Path, *, decoded: bool) -> None:
    """Read the ticks with the plain reader of the mcap package."""
    with log.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        read_all = reader.iter_decoded_messages if decoded else reader.iter_messages
        for _ in read_all(topics=[TICK_TOPIC]):
            pass


def ticks_per_s(read_all: Callable[[], object], ticks: int) -> float:
    began = time.perf_counter()
    read_all()
    return ticks / (time.perf_counter() - began)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ticks", type=int, default=60_000)
    parser.add_argument("--rings", type=Path, default=Path("/dev/shm"), help="folder for rings")
    arguments = parser.parse_args()
    ticks = make_up_ticks(arguments.ticks)
    with (
        tempfile.TemporaryDirectory(dir=arguments.rings) as rings,
        tempfile.TemporaryDirectory() as logs,
    ):
        log = Path(logs) / "bench.mcap"
        result = {
            "ticks": len(ticks),
            "ring_put": put_cost(Path(rings), ticks),
            "recorder": record(Path(rings), ticks, log),
            "import": import_text(Path(logs), len(ticks)),
            "reader_ticks_per_s": {
                "pamctl": ticks_per_s(lambda: read(log), len(ticks)),
                "mcap": ticks_per_s(lambda: stock_reader(log, decoded=False), len(ticks)),
                "mcap, protobuf decoded": ticks_per_s(
                    lambda: stock_reader(log, decoded=True), len(ticks)
                ),
            },
        }
    json.dump(result, sys.stdout, indent=2)
    print()


if __name__ == "__main__":
    main()
