"""Every golden log replays equal; every change of the tick is caught, with its stage named.

The logs in tests/golden/ are real runs (`scripts/remake_golden_logs.py`). They may have been
made on another CPU than this one: what goes through its libm has a tolerance there.
"""

import copy
import csv
import inspect
import json
import math
import random
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

import hal.calibration
from hal.calibration import position_m, quantise_v
from pamctl.cli.app import app
from pamctl.control import course as course_module
from pamctl.control import filters, pid, qsmc, smc
from pamctl.control.course import Course, Segment
from pamctl.control.filters import low_pass
from pamctl.control.homing import Homing
from pamctl.control.law import answer
from pamctl.control.waves import rest_to_rest
from pamctl.log import Log, read
from pamctl.log.importing.pipeline import write_imported
from pamctl.log.recover import recover_file
from pamctl.log.schema import CUT
from pamctl.offline.program_replay import trace_course
from pamctl.offline.replay_source import (
    REPLAYED_FIELDS,
    NotReplayable,
    read_replay_source,
    replay_stretch,
)
from pamctl.offline.tick_replay import OTHER_CPU, find_differing, replay_log
from pamctl.plant import paper
from pamctl.realtime import tick
from pamctl.realtime.tick import freeze_state
from pamctl.safety import PINNED, SENSOR_RANGE, admit
from pamctl.signals import TICK_FIELDS, Phase

GOLDEN = Path(__file__).parents[1] / "golden"
NAMES = sorted(path.stem for path in GOLDEN.glob("*.mcap"))


def mutated(function: Callable[..., Any], old: str, new: str) -> Callable[..., Any]:
    """Return the function compiled anew from its source, with `old` replaced by `new`."""
    source = textwrap.dedent(inspect.getsource(function))
    assert source.count(old) == 1, f"{old!r} stands {source.count(old)} times in {function}"
    namespace: dict[str, Any] = {}
    code = compile(source.replace(old, new), inspect.getfile(function), "exec", dont_inherit=True)
    exec(code, function.__globals__, namespace)
    return namespace[function.__name__]


@pytest.fixture(scope="session")
def golden() -> Callable[[str], Log]:
    """Return a golden log by its name; no test changes it."""
    logs = {name: read(GOLDEN / f"{name}.mcap") for name in NAMES}
    return logs.__getitem__


def pamctl(*arguments: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.exit_code, done.stdout


# --- the golden logs -------------------------------------------------------------------------


def test_the_golden_logs_hold_the_cases_that_they_are_kept_for(golden):
    laws = {golden(name).config["controller"]["law"] for name in NAMES}
    assert laws == {"qsmc", "smc", "pid"}
    assert golden("missed")["missed"].sum() > 10
    assert (golden("trip-wire")["verdicts"][-1]) & SENSOR_RANGE
    assert np.isnan(golden("trip-nan")["pressure_pa"][-1])
    assert (golden("readonly")["verdicts"] & PINNED).all()
    assert golden("card").metadata["run"]["backend"] == "nidaq"
    assert set(golden("steps")["phase"]) == {Phase.HOMING, Phase.OPEN_LOOP, Phase.STOPPING}
    assert set(golden("qsmc")["phase"]) == set(Phase) - {Phase.OPEN_LOOP}
    assert all((GOLDEN / f"{name}.mcap").stat().st_size < 250_000 for name in NAMES)


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_a_golden_log_replays_equal(name, golden):
    found = replay_log(golden(name), tolerances=OTHER_CPU)
    assert found.differences == ()
    assert found.is_whole
    assert found.ticks == len(golden(name))
    assert not found.absent


@pytest.mark.parametrize("name", NAMES)
def test_the_compiled_tick_and_the_plain_one_agree_to_the_bit(name, golden):
    recording = read_replay_source(golden(name))
    after = None
    for begin, end in recording.cut_stretches(0):
        state = recording.state_at(begin, after)
        given = (recording.setup_at(begin), recording.output, state, recording.inputs(begin, end))
        after, plain = replay_stretch(*given, plain=True)
        after_compiled, compiled = replay_stretch(*given)
        for field, here, there in zip(REPLAYED_FIELDS, plain, compiled, strict=True):
            assert find_differing(here, there) is None, field.name
        assert (
            find_differing(np.array(freeze_state(after)), np.array(freeze_state(after_compiled)))
            is None
        )


@pytest.mark.parametrize("name", NAMES)
def test_a_golden_log_passes_the_check(name):
    code, said = pamctl("log", "check", GOLDEN / f"{name}.mcap")
    assert code == 0, said


durations = st.floats(1e-3, 2.0) | st.integers(1, 500).map(lambda ticks: ticks * 1e-3)
positions = st.floats(-0.01, 0.03)
segments = st.builds(
    Segment,
    st.sampled_from([Phase.TRACK, Phase.REST, Phase.OPEN_LOOP]).map(int),
    durations | st.just(math.inf),
    positions,
    positions,
    st.just(math.nan) | st.floats(-5, 5),
    st.none(),
)


@given(st.lists(segments, min_size=1, max_size=6), durations, st.floats(0, 10))
def test_a_course_computed_at_once_equals_the_course_tick_by_tick(course, duration_s, begin_s):
    walked = Course(course, duration_s)
    t_s = begin_s + np.arange(round(1.2e3 * duration_s)) * 1e-3
    asked = [walked.at(t) for t in (t_s - begin_s).tolist()]
    last = next((i for i, reference in enumerate(asked) if reference is None), len(asked))
    rows = trace_course(walked, begin_s, t_s[:last])
    assert rows is not None
    expected = np.array(asked[:last], float).reshape(-1, 6).T
    assert all(find_differing(np.array(a), b) is None for a, b in zip(expected, rows, strict=True))
    if last < len(asked):
        assert trace_course(walked, begin_s, t_s) is None


def test_values_from_the_wall_clock_are_not_compared(golden):
    compared = {field.name for field in replay_log(golden("qsmc")).fields}
    by_the_clock = {"late_s", "read_s", "compute_s", "write_s", "pressure_t_ns", "encoder_t_ns"}
    of_the_tick = {
        field.name
        for field in TICK_FIELDS
        if field.stage in ("measurement", "reference", "estimate", "command", "decision")
    }
    assert not by_the_clock & compared
    assert {*of_the_tick, "applied_v", "sensor_zero_v", "safety.valve_v"} <= compared


# --- a changed setting is caught, and its stage is named ---------------------------------------


def with_config(log: Log, key: str, value: object) -> Log:
    """Return the log as if its run had had other settings."""
    config = copy.deepcopy(log.config)
    *way, last = key.split(".")
    section = config
    for name in way:
        section = section[name]
    section[last] = value
    return replace(log, config=config)


SETTINGS = {
    "controller.lpf1_hz": (199.0, "estimate"),
    "controller.lpf2_hz": (106.0, "estimate"),
    "controller.kp_v_s3_per_length": (9.951e-8, "command"),
    "controller.eta": (0.0119, "command"),
    "controller.command_limit_v": (0.05, "command"),
    "rig.limits.slew_v_per_s": (10.0, "decision"),
    "rig.limits.speed_mm_per_s": (5.0, "decision"),
    "rig.calibration.encoder_m_per_count": (3.17501e-6, "measurement"),
    "rig.calibration.sensor_pa_per_v": (155546.0, "measurement"),
    "rig.calibration.driver_gain": (0.99, "outcome"),
    "rig.homing.steady_s": (0.05, "reference"),
    "rig.loop.stop_ramp_s": (0.06, "reference"),
    "experiment.amplitude_mm": (2.01, "reference"),
    "rig.safe_volts": (0.01, "reference"),
}


@pytest.mark.parametrize("key", SETTINGS)
def test_a_changed_setting_is_found_and_its_stage_is_named_first(key, golden):
    value, stage = SETTINGS[key]
    found = replay_log(with_config(golden("qsmc"), key, value), tolerances=OTHER_CPU)
    assert found.differences[0].place.stage == stage


def test_a_stage_before_the_changed_one_stays_equal(golden):
    changed = with_config(golden("qsmc"), "controller.eta", 0.5)
    stages = {d.place.stage for d in replay_log(changed, tolerances=OTHER_CPU).differences}
    assert "command" in stages
    assert not stages & {"zero", "measurement", "reference", "estimate"}


def test_the_first_difference_is_reported_first(golden):
    log = golden("qsmc")
    command = log["command_v"].copy()
    at = 700
    command[at] += 1e-6
    changed = replace(log, columns={**log.columns, "command_v": command})
    found = replay_log(changed, tolerances=OTHER_CPU)
    assert [d.place.name for d in found.differences if d.place.name == "command_v"]
    first = found.differences[0]
    assert (first.place.stage, first.place.name) == ("command", "command_v")
    assert first.first.tick == at
    assert first.first.logged == command[at]
    assert first.first.replayed == pytest.approx(log["command_v"][at], abs=1e-9)
    assert first.ticks == 1
    assert first.largest == pytest.approx(1e-6, abs=1e-9)
    assert [pair.tick for pair in first.around] == list(range(at - 3, at + 4))


# --- a changed source is caught, and its stage is named ------------------------------------------


MUTATIONS: dict[str, tuple[str, str, Any, Any, str, str]] = {
    "filter": ("qsmc", "estimate", filters, low_pass, "(1.0 + g))", "(1.001 + g))"),
    "law qsmc": (
        "qsmc",
        "command",
        qsmc.QsmcGains,
        qsmc.qsmc,
        "3.0 * acceleration",
        "2.9 * acceleration",
    ),
    "law smc": (
        "smc",
        "command",
        smc.SmcGains,
        smc.smc,
        "else model.exhaust_gain",
        "else model.fill_gain",
    ),
    "law pid": ("pid-delayed", "command", pid.PidGains, pid.pid, "+ gains.kd", "- gains.kd"),
    "safety rule": ("trip-wire", "decision", tick, admit, "|= SENSOR_RANGE", "|= STALE_SAMPLE"),
    "calibration": ("steps", "measurement", tick, position_m, "(counts -", "(counts + 0.5 -"),
    "trajectory": ("pid-delayed", "reference", course_module, rest_to_rest, "35.0", "35.001"),
    "homing": ("missed", "zero", Homing, Homing._take_zero, "[-2:]", "[-1:]"),
    "output": (
        "card",
        "outcome",
        hal.calibration,
        quantise_v,
        "volts / step",
        "1.01 * volts / step",
    ),
}
"""Golden log, stage, where the function is called from, the function, and the edit.

A law's kernel is called by the type of its gains.
"""


@pytest.mark.parametrize("what", MUTATIONS)
def test_a_changed_source_is_found_and_its_stage_is_named_first(what, golden, monkeypatch):
    name, stage, where, function, old, new = MUTATIONS[what]
    is_law = where in answer.registry
    if is_law:
        answer.register(where, mutated(function, old, new))
    else:
        monkeypatch.setattr(where, function.__name__, mutated(function, old, new))
    try:
        found = replay_log(golden(name), plain=True, tolerances=OTHER_CPU)
    finally:
        if is_law:
            answer.register(where, function)
    assert found.differences[0].place.stage == stage


# --- another CPU --------------------------------------------------------------------------------


@pytest.fixture(params=["up", "down", "random"])
def other_libm(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make every libm function that the tick calls wrong in its last bit."""
    chance = random.Random(1)

    def off(function: Callable[..., float]) -> Callable[..., float]:
        def rounded_otherwise(*arguments: float) -> float:
            way = {"up": math.inf, "down": -math.inf}.get(request.param)
            value = function(*arguments)
            return math.nextafter(value, way or chance.choice((value, math.inf, -math.inf)))

        return rounded_otherwise

    right = qsmc.sliding_gains

    def gains(settings: Any) -> Any:
        found = right(settings)
        return found._replace(pole_per_s=off(lambda: found.pole_per_s)())

    monkeypatch.setattr(qsmc, "sliding_gains", gains)
    monkeypatch.setattr(smc, "sliding_gains", gains)
    monkeypatch.setattr(filters, "tan", off(math.tan))
    monkeypatch.setattr(paper, "pow", off(math.pow))
    monkeypatch.setattr(paper, "acos", off(math.acos))


@pytest.mark.parametrize("name", ["smc", "pid-delayed", "missed"])
def test_another_libm_is_within_the_tolerances_for_other_cpus_and_not_equal(
    name, other_libm, golden
):
    assert replay_log(golden(name), plain=True, tolerances=OTHER_CPU).is_equal
    exact = replay_log(golden(name), plain=True)
    assert exact.differences[0].place.stage == "estimate"


@given(st.floats(), st.floats(), st.floats(0, 1e3) | st.just(0.0))
def test_two_values_differ_unless_they_are_the_same_bits_both_nan_or_within_the_tolerance(
    logged, replayed, absolute
):
    a, b = np.array([logged]), np.array([replayed])
    same = a.tobytes() == b.tobytes() or (math.isnan(logged) and math.isnan(replayed))
    near = absolute > 0 and abs(logged - replayed) <= absolute
    assert (find_differing(a, b, absolute) is None) == (same or near)


# --- from the middle ---------------------------------------------------------------------------


def test_a_replay_can_start_from_a_frozen_state(golden):
    log = golden("smc")
    found = replay_log(log, from_s=1.2, tolerances=OTHER_CPU)
    assert found.begin == 1000
    assert found.is_equal
    assert found.is_whole
    assert found.ticks == len(log) - 1000


def test_before_the_first_frozen_state_it_starts_from_the_beginning(golden):
    assert replay_log(golden("smc"), from_s=0.5, tolerances=OTHER_CPU).begin == 0


def test_a_start_after_the_end_is_refused(golden):
    with pytest.raises(NotReplayable, match="ends at"):
        replay_log(golden("smc"), from_s=100.0)


# --- logs that lost something --------------------------------------------------------------------


def chunks_of(log: Path) -> Iterator[tuple[int, int]]:
    """Return where the chunks of a log begin and end."""
    from mcap.opcode import Opcode

    from pamctl.log.framing import map_log_file
    from pamctl.log.record_walk import walk_records

    for record in walk_records(map_log_file(log)):
        if record.opcode == Opcode.CHUNK:
            yield record.start, record.end


def recovered_without_a_chunk(tmp_path: Path, name: str, which: int) -> Log:
    source = GOLDEN / f"{name}.mcap"  # in real time a chunk holds some 250 ticks
    data = bytearray(source.read_bytes())
    _, end = list(chunks_of(source))[which]
    data[end - 100] ^= 0xFF
    (tmp_path / "damaged.mcap").write_bytes(data)
    recover_file(tmp_path / "damaged.mcap", tmp_path / "saved.mcap")
    return read(tmp_path / "saved.mcap")


def test_after_a_loss_the_replay_continues_from_the_next_frozen_state_and_says_so(tmp_path):
    log = recovered_without_a_chunk(tmp_path, "card", 2)
    lost = np.flatnonzero(np.diff(log["tick"]) - 1 != log["missed"][1:])
    assert len(lost) == 1
    found = replay_log(log, tolerances=OTHER_CPU)
    assert not found.differences
    assert not found.is_equal
    assert not found.is_whole
    resumed = int(np.searchsorted(log["tick"], 1000))
    assert found.skipped == resumed - (lost[0] + 1)
    assert found.ticks == len(log) - found.skipped
    code, said = pamctl("replay", log.path, "--tolerance", "default-for-other-cpu")
    assert code == 3
    assert f"not replayed: {found.skipped} ticks" in said
    assert f"not whole, {found.ticks} of {len(log)} ticks were replayed" in said


def test_a_log_whose_tick_jumps_is_not_equal_whatever_was_replayed(golden, tmp_path):
    log = golden("qsmc")
    jumped = {name: np.asarray(column).copy() for name, column in log.columns.items()}
    jumped["tick"][400:] += 10**9
    found = replay_log(replace(log, columns=jumped))
    assert (found.ticks, found.skipped) == (400, len(log) - 400)
    assert not found.differences
    assert not found.is_equal
    jumped["missed"][400] += 10**9  # the log counts them: then every tick is replayed
    assert replay_log(replace(log, columns=jumped)).skipped == 0


def test_a_piece_that_lost_ticks_before_its_first_frozen_state_is_not_equal(golden):
    log = golden("qsmc")
    whole = {name: np.asarray(column) for name, column in log.columns.items()}
    story = {"source": "run.mcap", "first_row": "100", "last_row": "1028"}
    piece = {name: column[100:] for name, column in whole.items()}
    cut = replace(log, columns=piece, time_ns=log.time_ns[100:], metadata={CUT: story})
    found = replay_log(cut, tolerances=OTHER_CPU)
    assert found.is_equal
    assert found.begin > 0
    torn = {name: np.concatenate([column[:300], column[310:]]) for name, column in piece.items()}
    found = replay_log(replace(cut, columns=torn, time_ns=cut.time_ns[10:]))
    assert found.skipped > 800
    assert not found.is_equal


def test_a_log_that_begins_with_a_loss_and_has_no_frozen_state_is_refused(tmp_path):
    log = recovered_without_a_chunk(tmp_path, "missed", 0)
    assert len(log) > 100
    assert log["tick"][0] > 0
    with pytest.raises(NotReplayable, match="the state to start from is unknown"):
        replay_log(log)


def test_a_damaged_log_is_refused_with_the_way_to_recover_it(tmp_path):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes((GOLDEN / "qsmc.mcap").read_bytes()[:-9000])
    done = CliRunner().invoke(app, ["replay", str(cut)])
    assert done.exit_code == 65
    assert "pamctl log recover" in done.stderr


# --- logs of other origin -------------------------------------------------------------------------


def test_an_imported_log_cannot_be_replayed(tmp_path):
    t_s = np.arange(100) * 1e-3
    write_imported(tmp_path / "lab.mcap", t_s, {"valve_v": 0 * t_s, "position_m": 0 * t_s}, {})
    done = CliRunner().invoke(app, ["replay", str(tmp_path / "lab.mcap"), "--json"])
    assert done.exit_code == 65
    assert "imported" in json.loads(done.stdout)["reason"]
    assert "no tick of pamctl to replay" in done.stderr


def test_a_log_that_lacks_what_the_tick_needs_names_the_version_to_replay_it_with(golden):
    log = golden("qsmc")
    columns = {name: column for name, column in log.columns.items() if name != "pressure_v"}
    with pytest.raises(NotReplayable, match=r"lacks pressure_v.* replay it with pamctl 0\.1\.0"):
        replay_log(replace(log, columns=columns))


def test_a_configuration_of_another_version_is_refused_with_the_key_that_does_not_fit(golden):
    older = with_config(golden("qsmc"), "controller.lambda_hz", 3.0)
    with pytest.raises(NotReplayable, match=r"controller\.lambda_hz: unknown key"):
        replay_log(older)


def test_a_field_that_an_older_log_lacks_is_not_compared_and_named(golden):
    log = golden("qsmc")
    columns = {name: column for name, column in log.columns.items() if name != "robust_v"}
    found = replay_log(replace(log, columns=columns), tolerances=OTHER_CPU)
    assert found.is_equal
    assert found.absent == ["robust_v"]


def test_a_frozen_state_of_another_version_is_restored_by_its_names(golden):
    log = golden("smc")
    keyframes = copy.deepcopy(log.keyframes)
    for keyframe in keyframes:
        keyframe["state"]["law.of_a_later_version"] = 7.0
        del keyframe["state"]["safety.missed_ticks"]
    other = replace(log, keyframes=keyframes)
    for from_s in (None, 1.2):
        found = replay_log(other, from_s=from_s, tolerances=OTHER_CPU)
        assert found.is_equal
        assert "safety.missed_ticks" not in {field.name for field in found.fields}


def test_a_log_without_configuration_is_refused(golden):
    with pytest.raises(NotReplayable, match="no configuration"):
        replay_log(replace(golden("qsmc"), config={}))


# --- what if --------------------------------------------------------------------------------------


def test_a_what_if_with_the_same_law_gives_the_same_command():
    log = GOLDEN / "qsmc.mcap"
    code, said = pamctl("replay", log, "--set", "controller.lpf2_hz=107.0", "--json")
    answer = json.loads(said)
    assert code == 0
    assert answer["open_loop"] is True
    assert {row["phase"] for row in answer["phases"]} == {"approach", "track", "rest"}
    assert all(row["difference_max_v"] < 1e-9 for row in answer["phases"])


def test_a_what_if_with_twice_the_gain_gives_twice_the_command(tmp_path):
    log = read(GOLDEN / "qsmc.mcap")
    double = 2 * log.config["controller"]["kp_v_s3_per_length"]
    table = tmp_path / "what-if.csv"
    code, said = pamctl(
        *("replay", log.path, "--set", f"controller.kp_v_s3_per_length={double!r}"),
        *("--csv", table),
    )
    assert code == 0
    assert "open loop" in said
    with table.open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == np.isnan(log["reference_valve_v"]).sum()
    for row in rows:
        doubled = 2 * float(row["command_v"])
        assert float(row["what_if_command_v"]) == pytest.approx(doubled, abs=1e-9)


def test_a_what_if_accepts_another_controller_file():
    code, said = pamctl("replay", GOLDEN / "smc.mcap", "--controller", "pid", "--json")
    answer = json.loads(said)
    assert code == 0
    assert answer["law"]["law"] == "pid"
    assert answer["logged_law"]["law"] == "smc"
    assert any(row["difference_max_v"] > 1e-3 for row in answer["phases"])


@pytest.mark.parametrize(
    ("arguments", "complaint", "code"),
    [
        (("--set", "rig.limits.command_v=1"), "only controller.* can be set", 78),
        (("--controller", "nobody"), "there is no such controller", 2),
        (("--csv", "x.csv"), "belongs to a what-if", 2),
        (("--controller", "pid", "--csv", "nowhere/x.csv"), "there is no directory nowhere", 2),
        (("--controller", "pid", "--tolerance", "x.yaml"), "belongs to a comparison", 2),
        (("--tolerance", "x.yaml"), "must be default-for-other-cpu", 2),
    ],
)
def test_an_invalid_what_if_is_refused(arguments, complaint, code):
    done = CliRunner().invoke(app, ["replay", str(GOLDEN / "qsmc.mcap"), *arguments])
    assert done.exit_code == code
    assert complaint in " ".join(done.stderr.split())


def test_a_what_if_on_an_open_loop_run_is_refused():
    done = CliRunner().invoke(
        app, ["replay", str(GOLDEN / "steps.mcap"), "--set", "controller.eta=0"]
    )
    assert done.exit_code == 65
    assert "no tick in which a law ran" in done.stderr


# --- the verb ------------------------------------------------------------------------------------


def test_equal_is_one_line_and_code_0():
    code, said = pamctl("replay", GOLDEN / "qsmc.mcap", "--tolerance", "default-for-other-cpu")
    assert code == 0
    assert said.count("\n") == 1
    assert f"equal, {len(read(GOLDEN / 'qsmc.mcap'))} ticks" in said
    assert "x real time" in said


def test_a_difference_is_code_3_with_tick_stage_field_and_both_values(golden, monkeypatch):
    changed = with_config(golden("qsmc"), "controller.eta", 0.5)
    monkeypatch.setattr("pamctl.log.reader.read_paged", lambda path: changed)
    arguments = ("replay", "x.mcap", "--tolerance", "default-for-other-cpu")
    code, said = pamctl(*arguments, "--json")
    document = json.loads(said)
    first = document["first"]
    assert code == 3
    assert document["equal"] is False
    assert (first["stage"], first["name"]) == ("command", "command_v")
    at = int(np.flatnonzero(changed["tick"] == first["tick"])[0])
    assert first["logged"] == changed["command_v"][at] != first["replayed"]
    assert {pair["tick"] for pair in first["around"]} >= {first["tick"] - 1, first["tick"]}

    code, said = pamctl(*arguments)
    assert code == 3
    assert f"differs from tick {first['tick']} on" in said
    assert repr(first["logged"]) in said
    assert repr(first["replayed"]) in said
    rows = [line.split()[:3] for line in said.splitlines()]
    assert ["decision", "valve_v", str(first["tick"])] in rows
    assert "equal: reference, zero, measurement, estimate" in said
