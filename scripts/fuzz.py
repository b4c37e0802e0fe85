"""Coverage-guided fuzzing of everything that reads what others wrote. Needs `pip install atheris`.

    python scripts/fuzz.py --corpus DIR [--minutes 5] [read recover csv mat yaml protocol]

Each target runs for some minutes. Inputs that reach new code are kept in DIR/TARGET, so the next
call goes on from there; an input that does harm is kept in DIR/found. Exit code 3 if there is one.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any

HOUSE = Path(__file__).resolve().parent.parent
LONGEST_S = 10
"""A single input that takes longer is harm too."""
LARGEST_BYTES = 20_000
MOST_MEMORY_MB = 512

Harness = Callable[[bytes], object]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"of {', '.join(TARGETS)}")
    parser.add_argument("--corpus", type=Path, required=True, help="folder that keeps the inputs")
    parser.add_argument("--minutes", type=float, default=5.0, help="for each target")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    unknown = {*asked.targets} - {*TARGETS}
    if unknown:
        parser.error(f"there is no target {', '.join(sorted(unknown))}")
    if asked.inside:
        _fuzz(asked.targets[0], asked.corpus, asked.minutes)
    return max(_run_apart(name, asked) for name in asked.targets or TARGETS)


def _run_apart(name: str, asked: argparse.Namespace) -> int:
    """Fuzz one target in a process of its own: a crash of an extension ends that process only."""
    began_s = time.monotonic()
    command = [sys.executable, __file__, "--inside", "--corpus", str(asked.corpus)]
    command += ["--minutes", str(asked.minutes), name]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
    runs = [line for line in done.stderr.splitlines() if line.startswith("Done ")]
    found = sorted((asked.corpus / "found").glob(f"{name}-*"))
    kept = len([*(asked.corpus / name).iterdir()]) if (asked.corpus / name).is_dir() else 0
    took_min = (time.monotonic() - began_s) / 60.0
    print(
        f"{name}: {runs[-1] if runs else 'stopped early'}, {took_min:.1f} min, {kept} inputs kept"
    )
    for path in found:
        print(f"  {path}")
    if not runs:
        print(done.stderr[-3000:], file=sys.stderr)
    return 3 if found or not runs else 0


def _fuzz(name: str, corpus: Path, minutes: float) -> None:
    import atheris

    packages = ["pamctl", "yaml", "mcap", "csv", "json"]
    with atheris.instrument_imports(include=packages):
        harness = TARGETS[name][0]()
    known: set[str] = set()
    found, kept = corpus / "found", corpus / name
    found.mkdir(parents=True, exist_ok=True)
    kept.mkdir(exist_ok=True)
    for number, seed in enumerate(TARGETS[name][1]()):
        (kept / f"seed-{number}").write_bytes(seed)

    def try_input(data: bytes) -> None:
        try:
            harness(data)
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            what = f"{type(error).__name__}-{Path(place.filename).name}-{place.lineno}"
            if what not in known:  # go on: others may hide behind it
                known.add(what)
                path = found / f"{name}-{what}-{hashlib.sha256(data).hexdigest()[:8]}"
                path.write_bytes(data)
                path.with_suffix(".txt").write_text(traceback.format_exc())

    warnings.simplefilter("ignore")
    options = [
        f"-max_total_time={int(minutes * 60)}", f"-timeout={LONGEST_S}",
        f"-rss_limit_mb={MOST_MEMORY_MB}", f"-max_len={LARGEST_BYTES}",
        f"-artifact_prefix={found}/{name}-", "-len_control=0",
    ]  # fmt: skip
    atheris.Setup([sys.argv[0], *options, str(kept)], try_input)
    atheris.Fuzz()


# --- what is fuzzed: each raises only for what it must not do ------------------------


def _in_file(harness: Callable[[Path], object], suffix: str) -> Harness:
    """Give the input as a file, in memory."""
    place = "/dev/shm" if Path("/dev/shm").is_dir() else None
    folder = tempfile.TemporaryDirectory(prefix="fuzz-", dir=place)
    os.fsync = lambda fd: None  # nothing here need reach a disk

    def use(data: bytes, keep: Any = folder) -> None:
        path = Path(folder.name, f"input{suffix}")
        path.unlink(missing_ok=True)
        path.write_bytes(data)
        harness(path)

    return use


def _read() -> Harness:
    from pamctl.errors import ConfigError
    from pamctl.log import LogError, info, read, signals
    from pamctl.log.check import check_log
    from pamctl.log.measured_signals import judge_ticks
    from pamctl.log.reader import read_paged
    from pamctl.offline.replay_source import read_replay_source

    def look(path: Path) -> None:
        for tool in (
            info,
            check_log,
            lambda path: signals(read(path)),
            lambda path: judge_ticks(read(path)),
            lambda path: [column[:] for column in read_paged(path).columns.values()],
        ):
            with suppress(LogError):
                tool(path)
        with suppress(LogError, ConfigError):
            log = read(path)
            try:
                read_replay_source(log)
            except Exception as error:
                if getattr(error, "exit_code", None) is None:
                    raise

    use = _in_file(look, ".mcap")

    def both(data: bytes) -> None:
        use(data)
        use(_with_right_checksums(data))

    return both


def _recover() -> Harness:
    from pamctl.log import LogError, read
    from pamctl.log.recover import recover_file

    def save(path: Path) -> None:
        saved = path.with_name("saved.mcap")
        saved.unlink(missing_ok=True)
        try:
            recovery = recover_file(path, saved)
        except LogError:
            assert not saved.exists(), "a refused file leaves a log behind"
            return
        again = saved.with_name("again.mcap")
        again.unlink(missing_ok=True)
        whole = recover_file(saved, again)
        assert whole.lossless, "what was recovered is damaged"
        assert whole.messages == recovery.messages, "a recovered log lost messages"
        with suppress(LogError):
            read(saved)

    use = _in_file(save, ".mcap")

    def both(data: bytes) -> None:
        use(data)
        use(_with_right_checksums(data))

    return both


def _with_right_checksums(data: bytes) -> bytes:
    """Return the file with every checksum as its content wants it: else no change gets past one."""
    magic, frame = b"\x89MCAP0\r\n", struct.Struct("<BQ")
    out, at, summary_at = bytearray(data[:8]), 8, 0
    while at + frame.size <= len(data):
        opcode, length = frame.unpack_from(data, at)
        body = bytearray(data[at + frame.size : at + frame.size + length])
        if len(body) < length or data[at:] == magic:
            break
        at += frame.size + length
        if opcode == 6 and length >= 40:
            named = int.from_bytes(body[28:32], "little")
            content = bytes(body[40 + named :])
            if not named:
                body[16:24] = struct.pack("<Q", len(content))
                body[24:28] = struct.pack("<I", zlib.crc32(content))
        elif opcode == 9 and length >= 4:
            body[-4:] = struct.pack("<I", zlib.crc32(body[:-4]))
        elif opcode == 15 and length == 4:
            body[:] = struct.pack("<I", zlib.crc32(out))
            summary_at = len(out) + frame.size + length
        elif opcode == 2 and length == 20:
            head = frame.pack(opcode, length) + bytes(body[:16])
            body[16:] = struct.pack("<I", zlib.crc32(out[summary_at:] + head))
        out += frame.pack(opcode, length) + body
    return bytes(out + data[at:])


def _logs() -> Iterator[bytes]:
    sys.path.insert(0, str(HOUSE / "tests"))
    import zstandard
    from support.small_log import write_small

    with tempfile.TemporaryDirectory() as folder:
        small = write_small(Path(folder, "small.mcap")).read_bytes()
    golden = (HOUSE / "tests/golden/readonly.mcap").read_bytes()
    yield small
    frame = struct.Struct("<BQ")
    for data in (small, golden):
        # Chunks without compression, of the golden log only the first: a change means something.
        out, at, chunks = bytearray(data[:8]), 8, 0
        while at + frame.size <= len(data) and data[at:] != data[:8]:
            opcode, length = frame.unpack_from(data, at)
            body = data[at + frame.size : at + frame.size + length]
            at += frame.size + length
            if opcode == 6:
                chunks += 1
                named = int.from_bytes(body[28:32], "little")
                packed = body[40 + named :]
                content = zstandard.decompress(packed) if named else packed
                if chunks > 1 and data is golden:
                    continue
                content = content[: LARGEST_BYTES // 2] if data is golden else content
                head = body[:16] + struct.pack("<QI", len(content), zlib.crc32(content))
                body = head + struct.pack("<IQ", 0, len(content)) + content
            out += frame.pack(opcode, len(body)) + body
        yield _with_right_checksums(bytes(out + data[:8]))


def _import(suffix: str) -> Callable[[], Harness]:
    def make() -> Harness:
        from pamctl.log import LogError, read
        from pamctl.log.importing.measured_table import ImportRefused
        from pamctl.log.importing.pipeline import import_log

        def bring_in(path: Path) -> None:
            log = path.with_suffix(".mcap")
            for how in ({}, {"resample_hz": 50.0}, {"accept_units": True}):
                log.unlink(missing_ok=True)
                try:
                    done = import_log(path, log, **how)
                except (ImportRefused, LogError):
                    assert not log.exists(), "a refused file leaves a log behind"
                    continue
                assert done.written == log.exists()
                if done.written:
                    assert len(read(log)) == done.ticks

        return _in_file(bring_in, suffix)

    return make


def _tables() -> Iterator[bytes]:
    rows = [(0.001 * n, 5.0 + 0.1 * (n % 7), 2e5 + 10.0 * n, 0.01 + 1e-4 * n) for n in range(40)]
    heads = ("t_s,valve_v,pressure_pa,position_m", "time_ms,valve_v,pressure_gauge_kpa,position_mm")
    for head in heads:
        for mark in ",;\t":
            lines = [mark.join(map(repr, row)) for row in rows]
            yield "\r\n".join([head.replace(",", mark), *lines]).encode()
    yield b'sep=;\n"t_s";"position_m"\n0,0;0,01\n0,001;\n0,002;0,012\n'
    yield b"# a remark\nt_s,position_m\n0,1e400\n0.001,nan\n1e999,inf\n"


def _mats() -> Iterator[bytes]:
    import numpy as np
    from scipy.io import savemat

    t_s = np.arange(20) * 1e-3
    arrays = {"t_s": t_s, "position_m": 0.01 + t_s, "valve_v": 5.0 + t_s}
    signal = {"values": t_s[:, None], "label": "position_m"}
    for content, form in (
        (arrays, "4"),
        (arrays, "5"),
        ({"run": arrays}, "5"),
        ({"scope": {"time": t_s, "signals": signal}}, "5"),
        ({"tout": t_s, "yout": np.column_stack([t_s, t_s]), "name": "text"}, "5"),
    ):
        stream = BytesIO()
        savemat(stream, content, format=form)
        yield stream.getvalue()


def _yaml() -> Harness:
    from pamctl.errors import ConfigError
    from pamctl.settings.resolve import SECTIONS, RawSettings, settings_to_data, validate_settings
    from pamctl.settings.yaml12 import dump_yaml, parse_yaml

    def parse(path: Path) -> None:
        try:
            raw = RawSettings.read(path)
        except ConfigError:
            return
        for title, section in SECTIONS.items():
            with suppress(ConfigError):
                settings = validate_settings(
                    section, RawSettings(raw.data, raw.origins), title=title
                )
                data = settings_to_data(settings)
                again = parse_yaml(dump_yaml(data), path).data
                assert again == data, "a file that is written again is another file"

    return _in_file(parse, ".yaml")


def _files() -> Iterator[bytes]:
    for path in sorted((HOUSE / "config").glob("*/*.yaml")):
        yield path.read_bytes()
    yield b"a: &x [1, 2]\nb: *x\nc: !!int 3\nd: 0x1f\ne: .inf\nf: |\n  text\n"


def _protocol() -> Harness:
    from pamctl.daemon import requested_settings
    from pamctl.daemon.protocol import (
        Method,
        RequestError,
        RequestRefusedError,
        encode_failure,
        encode_result,
        list_orders,
        parse_request,
    )
    from pamctl.daemon.rig_session import RigSession
    from pamctl.settings.resolve import resolve

    settings = resolve()

    def check(name: str, **given: Any) -> object:
        """Check what is asked as the session does, and move nothing."""
        if name == "start":
            experiment = given["experiment"]
            requested_settings.load_experiment(settings, experiment, given["name"], None)
        elif name in ("set", "load"):
            changed = (
                requested_settings.change_gains(settings, given["changes"])
                if name == "set"
                else requested_settings.load_controller(settings, given["controller"], "file")
            )
            requested_settings.require_tunable(settings, changed)
        return list(map(str, given))

    methods = {
        name: Method(told.params, lambda p, name=name: check(name, **dict(p)))
        for name, told in list_orders(RigSession).items()
    }

    def answer(data: bytes) -> None:
        for line in data.split(b"\n"):
            try:
                request = parse_request(line, methods)
                try:
                    told = encode_result(request.id, request.method.call(request.params))
                except RequestRefusedError as error:
                    told = encode_failure(RequestError(1, str(error), request.id))
            except RequestError as error:
                told = encode_failure(error)
            assert told.count(b"\n") == 1, "an answer is one line"
            json.loads(told)

    return answer


def _requests() -> Iterator[bytes]:
    sys.path.insert(0, str(HOUSE))
    from pamctl.settings.resolve import resolve, settings_to_data

    settings = resolve()
    controller, experiment = (
        settings_to_data(s) for s in (settings.controller, settings.experiment)
    )
    for method, params in (
        ("status", {}),
        ("estop", {}),
        ("start", {"experiment": experiment, "name": "tracking-1", "duration_s": 2.0}),
        ("load", {"controller": controller, "name": "qsmc", "ramp_s": 1}),
        ("set", {"changes": ["controller.eta=1", "controller.lambda_per_s=12"]}),
        ("goto", {"position_m": 0.012, "within_s": 2}),
        ("mark", {"text": "here"}),
        ("recent", {"after_tick": 3, "every": 10, "fields": ["t_s"]}),
    ):
        said = {"jsonrpc": "2.0", "id": 1, "method": method, "params": params}
        yield json.dumps(said).encode()


TARGETS: dict[str, tuple[Callable[[], Harness], Callable[[], Iterator[bytes]]]] = {
    "read": (_read, _logs),
    "recover": (_recover, _logs),
    "csv": (_import(".csv"), _tables),
    "mat": (_import(".mat"), _mats),
    "yaml": (_yaml, _files),
    "protocol": (_protocol, _requests),
}


if __name__ == "__main__":
    sys.exit(main())
