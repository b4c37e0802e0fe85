"""The log: every value is read as it was written, by us and by foreign readers."""

import json
import math
import os
import shutil
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_protobuf.decoder import DecoderFactory
from support.command_line import run_process
from support.installing import alone
from support.made_up import columns, log_run, meta, recording, tick
from support.patience import PATIENCE_S

from pamctl.base.texts import from_json, to_json
from pamctl.log import LogError, info, read
from pamctl.log.recover import recover_file
from pamctl.log.schema import SCHEMA_VERSION, TICK_TOPIC, tick_descriptor, unit_of_column
from pamctl.recording.ring import Ring
from pamctl.signals import TICK_FIELDS, Field

TICKS = 1500
FOREIGN = Path(__file__).parents[1] / "foreign"


@pytest.fixture(scope="module")
def log_path(tmp_path_factory) -> Path:
    """Return a short log written by a real recorder."""
    directory = tmp_path_factory.mktemp("log")
    return log_run(directory / "pamctl-log.ring", directory / "run.mcap", TICKS, rows=1024)


# Every value is read as it was written.


def test_every_column_of_every_tick_is_read_as_it_was_put(log_path):
    log = read(log_path)
    expected = [columns(tick(index)) for index in range(TICKS)]
    assert len(log) == TICKS
    assert list(log.columns) == [field.name for field in TICK_FIELDS]
    for name, column in log.columns.items():
        assert column.tolist() == [row[name] for row in expected], name


def test_events_gains_and_keyframes_are_read_with_the_tick_they_belong_to(log_path):
    log = read(log_path)
    assert [(event["event"], event["tick"]) for event in log.events] == [
        ("timing_setup", 0),
        ("outcome", TICKS - 1),
    ]
    assert log.gains[0]["lambda_per_s"] == 10.0
    (keyframe,) = log.keyframes
    assert keyframe["tick"] == TICKS - 1
    assert keyframe["state"] == {
        "lpf1_a": 1.0,
        "lpf1_b": pytest.approx(math.nan, nan_ok=True),
        "integral": -math.inf,
    }


def test_the_log_carries_the_configuration_and_what_was_attached(log_path):
    log = read(log_path)
    assert log.config == {"controller": {"law": "qsmc", "lambda_per_s": 10.0}, "limit": math.inf}
    assert log.attachments["config.yaml"] == b"law: qsmc\n"
    assert log.metadata["run"]["backend"] == "sim"
    assert log.metadata["pamctl"]["schema_version"] == str(SCHEMA_VERSION)
    assert log.metadata["timing_setup"]["fifo"] == "true"


def test_a_run_of_no_ticks_is_a_whole_log_with_empty_columns(tmp_path):
    path = tmp_path / "empty.mcap"
    with Ring.create(tmp_path / "a.ring", meta(path)) as ring, recording(ring) as process:
        ring.loop_done = 1
        assert process.wait(PATIENCE_S) == 0
    log = read(path)
    assert len(log) == 0
    assert log["position_m"].shape == (0,)
    assert info(path)["complete"]


def test_a_column_that_is_not_there_is_refused_with_the_nearest_name(log_path):
    with pytest.raises(LogError, match=r"no column position_mm; did you mean position_m\?"):
        read(log_path)["position_mm"]


def test_info_sums_up_a_run(log_path):
    summary = info(log_path)
    assert summary["complete"]
    assert summary["ticks"] == TICKS
    assert summary["duration_s"] == pytest.approx((TICKS - 1) * 1e-3)
    assert summary["phases"] == {"track": TICKS}
    assert summary["law"] == "qsmc"
    assert summary["outcome"]["reason"] == "done"
    assert summary["bytes_per_tick"] < 400
    assert json.loads(json.dumps(summary)) == summary


JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda values: st.lists(values) | st.dictionaries(st.text(), values),
    max_leaves=10,
)


@settings(max_examples=20)
@given(JSON_VALUES)
def test_every_value_survives_json_and_every_json_is_valid(value):
    text = to_json(value)
    json.loads(text, parse_constant=pytest.fail)
    assert repr(from_json(text)) == repr(value)


def test_a_unit_is_what_the_suffix_of_the_name_says():
    names = ("position_m", "pressure_pa", "reference_jerk_m_per_s3", "velocity_m_per_s", "valve_v",
             "stiffness_n_per_m", "encoder_t_ns", "encoder_counts", "saturated")  # fmt: skip
    units = ["m", "Pa", "m/s^3", "m/s", "V", "N/m", "ns", "counts", "1"]
    assert list(map(unit_of_column, names)) == units


# Foreign readers.


def test_the_stock_protobuf_decoder_reads_every_tick_as_it_was_put(log_path):
    with log_path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoded = list(reader.iter_decoded_messages(topics=[TICK_TOPIC]))
    assert len(decoded) == TICKS
    for _, _, message, proto in decoded:
        put_in = columns(tick(message.sequence))
        assert {name: getattr(proto, name) for name in put_in} == put_in
        assert all(proto.HasField(name) for name in put_in)


def test_the_stock_reader_finds_units_and_schema_version_beside_the_channel(log_path):
    with log_path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    channels = {channel.topic: channel for channel in summary.channels.values()}
    metadata = channels[TICK_TOPIC].metadata
    assert metadata["schema_version"] == str(SCHEMA_VERSION)
    assert json.loads(metadata["units"])["surface_m_per_s2"] == "m/s^2"
    for schema in summary.schemas.values():
        assert schema.encoding == "protobuf" or json.loads(schema.data)["type"] == "object"


def missing(why: str) -> None:
    """Skip, unless the environment promises that everything is installed."""
    (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)(why)


@pytest.fixture(scope="module")
def foreign_reader(request) -> Callable[..., list[dict[str, Any]]]:
    """Return a foreign reader in another language: @mcap/core, protobufjs."""
    if shutil.which("npm") is None:
        missing("npm is not installed")
    home = request.config.cache.mkdir("foreign")
    for name in ("package.json", "validate.mjs"):
        shutil.copy(FOREIGN / name, home)
    command = ["npm", "install", "--no-package-lock", "--no-audit", "--no-fund", "--prefer-offline"]
    with alone():
        installed = run_process(command, cwd=home)
    if installed.returncode != 0:
        missing(f"npm install failed: {installed.stderr[-500:]}")

    def read_foreign(*paths: Path) -> list[dict[str, Any]]:
        command = ["node", "validate.mjs", *map(str, paths)]
        ran = run_process(command, cwd=home)
        assert ran.returncode == 0, ran.stderr
        return [json.loads(line) for line in ran.stdout.splitlines()]

    return read_foreign


def test_a_foreign_reader_reads_golden_logs_as_we_do(foreign_reader):
    names = ("card-clocked", "steps", "trip-nan")
    golden = [Path(__file__).parents[1] / "golden" / f"{name}.mcap" for name in names]
    for path, seen in zip(golden, foreign_reader(*golden), strict=True):
        log = read(path)
        assert seen["messages"] == log.counts
        assert sorted(seen["attachments"]) == sorted(log.attachments)
        for row, ours in (("first", 0), ("last", -1)):
            for name, column in log.columns.items():
                value = seen[row][name]  # JSON has no NaN
                found = math.nan if value is None else float(value)
                expected = pytest.approx(float(column[ours]), nan_ok=True, abs=0)
                assert found == expected, (path.stem, name)


# Logs of another version.


def write_ticks(path: Path, descriptor: bytes, payloads: list[bytes], encoding: str = "protobuf"):
    """Write a log of ticks with a foreign writer."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.LZ4)
        writer.start()
        schema = writer.register_schema("pamctl.Tick", "protobuf", descriptor)
        channel = writer.register_channel(TICK_TOPIC, encoding, schema)
        for index, payload in enumerate(payloads):
            writer.add_message(channel, index, payload, index, index)
        writer.finish()


def proto_class(descriptor: bytes) -> Any:
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message_factory import GetMessageClass

    pool = DescriptorPool()
    pool.Add(FileDescriptorSet.FromString(descriptor).file[0])
    return GetMessageClass(pool.FindMessageTypeByName("pamctl.Tick"))


def test_fields_in_another_order_on_the_wire_are_not_taken_for_each_other(tmp_path):
    fields = [Field("a_m", float, "x"), Field("b_m", float, "x")]
    descriptor = tick_descriptor(fields)
    message = proto_class(descriptor)
    a, b = message(a_m=1.0).SerializeToString(), message(b_m=2.0).SerializeToString()
    write_ticks(tmp_path / "a.mcap", descriptor, [a + b, b + a])
    log = read(tmp_path / "a.mcap")
    assert log["a_m"].tolist() == [1.0, 1.0]
    assert log["b_m"].tolist() == [2.0, 2.0]


def test_a_tick_without_an_integer_is_refused_since_no_integer_means_missing(tmp_path):
    descriptor = tick_descriptor(TICK_FIELDS)
    write_ticks(tmp_path / "a.mcap", descriptor, [proto_class(descriptor)().SerializeToString()])
    with pytest.raises(LogError, match="version that cannot be read: a tick lacks its tick"):
        read(tmp_path / "a.mcap")


def test_a_tick_with_a_text_is_refused(tmp_path):
    files = FileDescriptorSet.FromString(tick_descriptor(TICK_FIELDS))
    files.file[0].message_type[0].field[3].type = FieldDescriptorProto.TYPE_STRING
    write_ticks(tmp_path / "a.mcap", files.SerializeToString(), [])
    with pytest.raises(LogError, match="is not a plain number"):
        read(tmp_path / "a.mcap")


def test_an_mcap_file_without_ticks_is_refused_as_no_log_of_ours(tmp_path):
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()
    with pytest.raises(LogError, match="it has no channel /pam/tick"):
        read(tmp_path / "a.mcap")


def test_the_schema_version_goes_up_when_the_columns_change():
    digests = {1: 0x90B4066}
    digest = zlib.crc32(tick_descriptor(TICK_FIELDS))
    assert digests[SCHEMA_VERSION] == digest, "raise SCHEMA_VERSION, and add its digest here"


# Damaged files.


@pytest.mark.parametrize("content", [b"", b"not a log", b"\0" * 5000])
def test_a_file_that_is_no_log_is_refused_by_read_info_and_recover(tmp_path, content):
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    for use in (read, info, lambda path: recover_file(path, tmp_path / "b.mcap")):
        with pytest.raises(LogError, match=r"is empty|is not a log|can be saved"):
            use(path)
    assert not (tmp_path / "b.mcap").exists()


def test_a_file_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(LogError, match=r"cannot read .*: No such file"):
        read(tmp_path / "a.mcap")
