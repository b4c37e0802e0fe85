"""`pamctl log check` and `recover`: they name what is wrong with a file, and nothing else."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.opcode import Opcode
from support.command_line import run_pamctl
from support.made_up import columns, tick
from support.small_log import CHUNK_TICKS, require_right_index, write_small
from typer.testing import CliRunner

from pamctl.base.new_file import create_new_file
from pamctl.cli.app import app
from pamctl.log import LogError, read
from pamctl.log.check import LogCheckReport, Severity, check_log
from pamctl.log.framing import FileRecord, map_log_file
from pamctl.log.measured_signals import find_signal_problems, judge_ticks
from pamctl.log.record_walk import walk_records
from pamctl.log.recover import recover_file
from pamctl.log.run_meta import RunMeta
from pamctl.log.schema import TICK_MESSAGE, TICK_TOPIC, tick_descriptor
from pamctl.log.wire import TickLayout, make_message_records
from pamctl.log.writer import DESCRIBED_EVERY, LogWriter, begin_log
from pamctl.signals import TICK_FIELDS


def pamctl(*arguments: str | Path) -> Any:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


GOLDEN = Path(__file__).parents[1] / "golden"


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """Return the log of a real run."""
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    experiment = ("--experiment", "square-1", "--duration", "1")
    run_pamctl("run", "--fast", *experiment, "--log", path).check_returncode()
    return path


def write_ticks(path: Path, changes: dict[str, Any], count: int = 50) -> Path:
    """Write made-up ticks whose columns were changed; each change maps a column to values."""
    layout = TickLayout.of_fields(TICK_FIELDS)
    table = np.zeros(count, layout.dtype)
    for index in range(count):
        for name, value in columns(tick(index)).items():
            table[name][index] = value
    time_ns = changes.pop("time_ns", np.arange(count) * 1_000_000)
    for name, values in changes.items():
        table[name] = values
    with create_new_file(path) as stream:
        writer = LogWriter(stream)
        channels = begin_log(writer, RunMeta(str(path)))
        messages = make_message_records(layout.encode(table), time_ns, table["tick"])
        for first in range(0, count, 100):
            writer.add(channels[TICK_TOPIC], messages[first : first + 100])
            writer.end_chunk()
        writer.finish()
    return path


def kinds(report: LogCheckReport, severity: Severity = Severity.ERROR) -> set[str]:
    return {finding.key for finding in report.findings if finding.level == severity}


# Valid logs.


def test_an_imported_log_passes_and_is_called_one(tmp_path):
    report = check_log(write_small(tmp_path / "a.mcap"))
    assert report.ok
    assert kinds(report, Severity.NOTE) == {"imported"}


@pytest.mark.parametrize(
    "at",
    [np.concatenate([np.arange(20), np.arange(23, 53)]), 8278 + np.cumsum([4, 5] * 25)],
    ids=["one gap", "a busy machine, most are missed"],
)
def test_ticks_that_were_missed_and_counted_are_a_note_and_no_error(tmp_path, at):
    missed = np.diff(at, prepend=at[0] - 1) - 1
    dt_s = np.diff(at * 1e-3, prepend=(at[0] - 1) * 1e-3)
    changes = {"tick": at, "t_s": at * 1e-3, "dt_s": dt_s, "missed": missed}
    report = check_log(write_ticks(tmp_path / "a.mcap", {**changes, "time_ns": at * 1_000_000}))
    assert report.ok
    assert kinds(report, Severity.NOTE) == {"missed"}


# Invalid logs.


def with_one(values: Any, index: int, value: Any) -> Any:
    changed = np.array(values)
    changed[index] = value
    return changed


STEPS = np.arange(50)


@pytest.mark.parametrize(
    ("changes", "kind"),
    [
        ({"tick": np.where(STEPS < 30, STEPS, STEPS + 2)}, "gap"),
        ({"missed": with_one(STEPS * 0, 7, 1)}, "gap"),
        ({"tick": with_one(STEPS, 30, 3)}, "tick-order"),
        ({"t_s": with_one(STEPS * 1e-3, 30, 0.01)}, "clock"),
        ({"t_s": np.where(STEPS < 30, STEPS * 1e-3, STEPS * 1e-3 + 0.5)}, "clock"),
        ({"dt_s": with_one(STEPS * 0 + 1e-3, 30, 2e-3)}, "clock"),
        ({"t_s": with_one(STEPS * 1e-3, 30, np.nan)}, "missing"),
        ({"time_ns": np.where(STEPS < 30, STEPS, STEPS + 9) * 1_000_000}, "clock"),
        ({"tick": STEPS + 2**62}, "tick-order"),
        ({"t_s": np.where(STEPS < 30, STEPS * 1e-3, np.inf)}, "missing"),
        ({"t_s": STEPS[::-1] * 1e-3}, "reversed"),
        ({"t_s": STEPS % 25 * 1e-3}, "duplicated"),
        ({"position_m": np.nan}, "empty"),
        ({"phase": np.where(STEPS < 30, 2, 99)}, "phase"),
    ],
)
def test_numbers_times_and_values_that_cannot_be_are_named(tmp_path, changes, kind):
    assert kind in kinds(check_log(write_ticks(tmp_path / "a.mcap", changes)))


@pytest.mark.parametrize(
    ("verb", "changes", "words"),
    [
        ("report", {"t_s": STEPS[::-1] * 1e-3}, "t_s runs backwards"),
        ("diagnose", {"t_s": STEPS % 25 * 1e-3}, "the record is there twice"),
        ("compare", {"t_s": np.where(STEPS < 30, STEPS * 1e-3, np.inf)}, "rows 30 to 49"),
        ("report", {"t_s": STEPS * np.nan}, "t_s is missing or not finite"),
        ("diagnose", {"phase": np.where(STEPS < 30, 2, 99)}, "from row 30 on, the phase is 99"),
    ],
)
def test_no_verb_computes_from_ticks_that_cannot_be(tmp_path, verb, changes, words):
    path = write_ticks(tmp_path / "a.mcap", dict(changes))
    done = pamctl(verb, path, *(["--out", tmp_path / "out"] if verb == "diagnose" else []))
    assert done.exit_code == 65
    assert f"{path} cannot be used: " in done.stderr
    assert words in done.stderr
    assert f"pamctl log check {path}" in done.stderr
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "t_s", [STEPS[::-1] * 1e-3, STEPS % 25 * 1e-3, np.where(STEPS < 30, STEPS, np.inf)]
)
def test_no_replay_begins_where_times_do_not_rise(tmp_path, t_s):
    done = pamctl("replay", write_ticks(tmp_path / "a.mcap", {"t_s": t_s}))
    assert done.exit_code == 65
    assert "are not in order, by number or by time; `pamctl log check" in done.stderr


@pytest.mark.parametrize("verb", ["report", "diagnose", "compare", "replay"])
def test_a_wrong_version_and_a_wrong_first_number_are_said_by_every_verb(
    tmp_path, verb, monkeypatch
):
    monkeypatch.setattr("pamctl.log.writer.SCHEMA_VERSION", "0")
    path = write_ticks(tmp_path / "a.mcap", {"tick": STEPS + 2**62})
    # The notes of a diagnosis are those of `judge_ticks`.
    said = "; ".join(judge_ticks(read(path))) if verb == "diagnose" else pamctl(verb, path).stderr
    assert "the schema version of /pam/tick is '0'; versions begin with 1" in said
    assert f"has the number {2**62} at 0 s: by its time it is tick 0" in said


def test_what_is_doubtful_is_said_with_its_rows_and_stands_on_the_page(tmp_path):
    noise = 2e5 + 300.0 * np.random.default_rng(1).standard_normal(600)
    noise[200:400] = noise[200]
    path = write_ticks(tmp_path / "a.mcap", {"pressure_pa": noise}, 600)
    doubt = "pressure_pa stands still at "
    assert doubt in pamctl("log", "check", path).stdout
    done = pamctl("report", path, "--out", tmp_path / "a.html")
    assert (done.exit_code, doubt in done.stderr) == (0, True)
    assert "rows 200 to 399 (0.2 to 0.399 s)" in done.stderr
    assert f"Doubtful in a: {doubt}" in (tmp_path / "a.html").read_text()


def test_a_long_log_is_checked_in_pieces_and_its_findings_are_those_of_the_whole(
    tmp_path, monkeypatch
):
    noise = 2e5 + 300.0 * np.random.default_rng(1).standard_normal(900)
    noise[350:450] = noise[350]
    tick = np.arange(900) + 2 * (np.arange(900) >= 300)  # a loss where the second piece begins
    path = write_ticks(tmp_path / "a.mcap", {"pressure_pa": noise, "tick": tick}, 900)
    whole = check_log(path).findings
    lengths = []

    def find(ticks: Any) -> Any:
        lengths.append(len(ticks["t_s"]))
        return find_signal_problems(ticks)

    monkeypatch.setattr("pamctl.log.wire._BATCH_TICKS", 100)
    monkeypatch.setattr("pamctl.log.check.PIECE_TICKS", 300)
    monkeypatch.setattr("pamctl.log.check.find_signal_problems", find)
    assert check_log(path).findings == whole
    assert lengths == [300, 301, 301]
    assert any("rows 350 to 449" in finding.message for finding in whole)
    assert any("2 ticks missing between 299 and 302" in f.message for f in whole)


def test_a_protobuf_schema_that_is_labelled_otherwise_is_named(tmp_path):
    layout = TickLayout.of_fields(TICK_FIELDS)
    with create_new_file(tmp_path / "a.mcap") as stream:
        writer = LogWriter(stream)
        schema = (TICK_MESSAGE, "jsonschema", tick_descriptor(TICK_FIELDS))
        channel = writer.channel(TICK_TOPIC, "protobuf", schema)
        ticks = layout.encode(np.zeros(2, layout.dtype))
        writer.add(channel, make_message_records(ticks, STEPS[:2], STEPS[:2]))
        writer.finish()
    assert "schema" in kinds(check_log(tmp_path / "a.mcap"))


def test_a_million_errors_of_a_kind_are_told_in_a_screenful(tmp_path):
    report = check_log(write_ticks(tmp_path / "a.mcap", {"missed": STEPS + 1}))
    told = [finding.message for finding in report.findings if finding.key == "gap"]
    assert len(told) == 6
    assert told[-1] == "and 44 more of these"


def test_a_column_without_a_unit_and_a_missing_one_are_named(tmp_path):
    from pamctl.signals import Field

    fields = (*TICK_FIELDS[:-1], Field("mystery", float, "x"))
    path = tmp_path / "a.mcap"
    with create_new_file(path) as stream:
        writer = LogWriter(stream)
        begin_log(writer, RunMeta(str(path), tick_fields=fields))
        writer.finish()
    messages = [finding.message for finding in check_log(path).findings]
    assert "the name of mystery states no unit" in messages
    assert f"there is no column {TICK_FIELDS[-1].name}" in messages


def test_a_configuration_that_cannot_be_used_and_a_missing_outcome_are_named(tmp_path):
    path = write_ticks(tmp_path / "a.mcap", {})
    done = pamctl("log", "check", "--json", path)
    (report,) = json.loads(done.stdout)
    assert done.exit_code == 3
    found = {(finding["severity"], finding["kind"]) for finding in report["findings"]}
    assert found == {("error", "config"), ("warning", "outcome")}
    assert any("rig: missing" in finding["message"] for finding in report["findings"])


def records_of(path: Path) -> list[FileRecord]:
    return list(walk_records(map_log_file(path)))


@pytest.mark.parametrize("content", [b"", b"not a log", b"\0" * 5000])
def test_a_file_that_is_no_log_is_bad_data_and_the_others_are_still_checked(tmp_path, run, content):
    (tmp_path / "a.mcap").write_bytes(content)
    done = pamctl("log", "check", tmp_path / "a.mcap", run)
    assert done.exit_code == 65
    assert f"{tmp_path / 'a.mcap'}: no log" in done.stdout
    assert f"{run}: ok" in done.stdout


# Recovery, as a user meets it.


def test_recovering_a_cut_log_saves_its_whole_chunks_and_says_that_the_rest_is_lost(run, tmp_path):
    (tmp_path / "cut.mcap").write_bytes(run.read_bytes()[:-60_000])
    done = pamctl("log", "recover", tmp_path / "cut.mcap", tmp_path / "saved.mcap")
    assert done.exit_code == 3
    assert "lost" in done.stdout
    saved, whole = read(tmp_path / "saved.mcap"), read(run)
    assert 0 < len(saved) < len(whole)
    assert (saved["position_m"] == whole["position_m"][: len(saved)]).all()
    checked = pamctl("log", "check", tmp_path / "saved.mcap")
    assert checked.exit_code == 0
    assert "the log was recovered" in checked.stdout


def chunks_of(path: Path) -> list[FileRecord]:
    return [record for record in records_of(path) if record.opcode == Opcode.CHUNK]


@pytest.mark.parametrize("lost", [1, 2, DESCRIBED_EVERY])
def test_without_its_first_chunks_and_its_summary_a_log_is_understood_by_a_later_chunk(
    tmp_path, lost
):
    whole = write_small(tmp_path / "a.mcap", chunks=DESCRIBED_EVERY + 2)
    chunks = chunks_of(whole)
    content = bytearray(whole.read_bytes()[: chunks[-1].end])
    for chunk in chunks[:lost]:
        content[chunk.start : chunk.end] = bytes(chunk.end - chunk.start)
    (tmp_path / "b.mcap").write_bytes(content)
    recovery = recover_file(tmp_path / "b.mcap", tmp_path / "c.mcap")
    assert not recovery.lossless
    ticks = read(whole)["position_m"][lost * CHUNK_TICKS :]
    assert read(tmp_path / "c.mcap")["position_m"].tolist() == ticks.tolist()
    assert check_log(tmp_path / "c.mcap").ok
    require_right_index(tmp_path / "c.mcap")


def test_recovery_does_not_touch_a_file_that_is_there(run, tmp_path):
    (tmp_path / "mine.mcap").write_bytes(b"precious")
    done = pamctl("log", "recover", run, tmp_path / "mine.mcap")
    assert done.exit_code == 2
    assert "never overwritten" in done.stderr
    assert (tmp_path / "mine.mcap").read_bytes() == b"precious"


def test_a_chunk_whose_length_is_damaged_is_passed_over_and_the_next_is_found(tmp_path):
    run = GOLDEN / "qsmc.mcap"  # of more than two chunks, however busy this machine is
    content = bytearray(run.read_bytes())
    chunks = chunks_of(run)
    content[chunks[1].start + 3] ^= 0x10
    (tmp_path / "a.mcap").write_bytes(content)
    with pytest.raises(LogError, match="is damaged"):
        read(tmp_path / "a.mcap")
    done = pamctl("log", "recover", tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert done.exit_code == 3
    saved = read(tmp_path / "b.mcap")
    assert saved["tick"][-1] == read(run)["tick"][-1]
    assert kinds(check_log(tmp_path / "b.mcap")) == set()
    assert "gap" in kinds(check_log(tmp_path / "b.mcap"), Severity.WARNING)
