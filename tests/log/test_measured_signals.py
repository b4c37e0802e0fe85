"""Offline tools see the same signals in a log of ours and in an imported one."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.made_up import log_run

import pamctl.log
from hal.calibration import CalibrationSettings
from pamctl.log.importing.pipeline import write_imported
from pamctl.log.measured_signals import SIGNAL_FIELDS, Signals
from pamctl.log.reader import read_some
from pamctl.report.reported_run import FIGURE_FIELDS, summarise_run
from pamctl.signals import Phase

GOLDEN = Path(__file__).parents[1] / "golden"

TICKS = 300


def recorded(directory: Path, **calibration: float) -> pamctl.log.Log:
    settings = CalibrationSettings(**calibration).model_dump()
    path = directory / "run.mcap"
    config = {"rig": {"calibration": settings, "loop": {"rate_hz": 1000.0}}}
    log_run(directory / "a.ring", path, TICKS, config=config)
    return pamctl.log.read(path)


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> pamctl.log.Log:
    return recorded(tmp_path_factory.mktemp("recorded"))


@pytest.fixture
def imported(tmp_path) -> pamctl.log.Log:
    t_s = np.delete(np.arange(TICKS) * 1e-3, slice(100, 104))
    quantities = {"position_m": np.sin(t_s), "valve_v": np.cos(t_s)}
    write_imported(tmp_path / "a.mcap", t_s, quantities, {"source": "lab.csv"})
    return pamctl.log.read(tmp_path / "a.mcap")


def test_the_valve_command_of_a_run_is_what_was_applied_and_not_what_was_asked_for(tmp_path):
    log = recorded(tmp_path, driver_offset_v=4.0, driver_gain=0.5)
    measured = pamctl.log.signals(log)
    assert np.array_equal(measured.valve_v, (log["applied_v"] - 4.0) / 0.5)
    assert np.array_equal(measured.pressure_pa, log["pressure_pa"])
    assert (measured.phase == Phase.TRACK).all()
    assert measured.force_n is None
    assert not log.is_imported


def timed(log: pamctl.log.Log, rig: dict[str, str], **columns: object) -> pamctl.log.Log:
    """Return the log as of another rig, with other columns; all durations that are not given: 0."""
    zero = np.zeros(len(log))
    none = dict.fromkeys(("late_s", "read_s", "compute_s", "write_s"), zero)
    metadata = {**log.metadata, "rig": rig}
    return replace(log, metadata=metadata, columns={**log.columns, **none, **columns})


DELAYED = {"output_delay_ticks": "1", "safe_output_v": "0.0"}
CLOCKED = {**DELAYED, "sample_clock": "/Dev1/ai/SampleClock"}


@pytest.mark.parametrize("rig", [DELAYED, CLOCKED], ids=["computer", "card"])
def test_a_delayed_output_reaches_the_valve_a_tick_later(log, rig):
    t_s = log["t_s"] + 3e-3 * (np.arange(TICKS) >= 200)
    at_once = pamctl.log.signals(timed(log, {}))
    late = pamctl.log.signals(timed(log, rig, t_s=t_s))
    assert at_once.acts_after_s is None
    assert late.valve_v[0] == -5.0
    assert np.array_equal(late.valve_v[1:], at_once.valve_v[:-1])
    if rig is DELAYED:
        assert late.acts_after_s is None
    else:  # between ticks 199 and 200 the card had three more edges, and put it out at the first
        assert late.acts_after_s[200] == pytest.approx(-3e-3)
        assert not np.delete(late.acts_after_s, 200).any()


def test_a_write_that_misses_the_next_edge_waits_for_the_one_after_it(log):
    compute_s = np.full(TICKS, 2e-4)
    compute_s[50] = 1.3e-3
    late = pamctl.log.signals(timed(log, CLOCKED, compute_s=compute_s))
    assert late.acts_after_s[51] == pytest.approx(1e-3)
    assert not np.delete(late.acts_after_s, 51).any()


@pytest.mark.parametrize("simulated", [True, False])
def test_a_command_in_real_time_acts_when_its_tick_has_read_and_computed(log, simulated):
    random = np.random.default_rng(1)
    waited_s, read_s, compute_s, write_s, late_s = random.uniform(5e-6, 9e-5, (5, TICKS))
    waited_s[7] = 0.0  # the promptest tick shows the phase of the grid
    late_s[100] = 6e-4
    woke_s = log["tick"] * 1e-3 + late_s
    truth = np.full(TICKS, 1e5 if simulated else np.nan)
    whole = timed(
        log,
        {},
        t_s=woke_s + waited_s - waited_s[0] - woke_s[0],
        late_s=late_s,
        read_s=waited_s + read_s,
        compute_s=compute_s,
        write_s=write_s,
        true_pressure_pa=truth,
    )
    acts_s = pamctl.log.signals(whole).acts_after_s
    expected_s = read_s + compute_s + (0.0 if simulated else write_s)
    np.testing.assert_allclose(acts_s, expected_s, rtol=0, atol=1e-12)
    assert np.array_equal(pamctl.log.signals(whole)[20:30].acts_after_s, acts_s[20:30])


def test_signals_know_the_command_before_their_first(log):
    measured = pamctl.log.signals(timed(log, {"safe_output_v": "0.625"}))
    assert measured.held_v == 0.625 - 5.0
    assert measured[:10].held_v == measured.held_v
    assert measured[40:].held_v == measured[30:][10:].held_v == measured.valve_v[39]
    applied_v = np.where(np.arange(TICKS) == 39, np.nan, log["applied_v"])  # a write that failed
    assert pamctl.log.signals(timed(log, {}, applied_v=applied_v))[40:].held_v is None
    assert pamctl.log.signals(timed(log, {})).held_v is None


def test_a_log_without_durations_lets_its_commands_act_at_their_samples(log):
    old = {n: c for n, c in log.columns.items() if not n.endswith(("read_s", "compute_s", "e_s"))}
    assert "write_s" not in old
    assert pamctl.log.signals(replace(log, columns=old)).acts_after_s is None


def test_an_import_may_state_when_commands_act(tmp_path):
    t_s = np.arange(TICKS) * 1e-3
    columns = {"position_m": np.sin(t_s), "valve_v": np.cos(t_s)}
    write_imported(tmp_path / "a.mcap", t_s, columns, {"acts_after_s": "0.00015"})
    measured = pamctl.log.signals(pamctl.log.read(tmp_path / "a.mcap"))
    assert measured.acts_after_s.tolist() == [1.5e-4] * TICKS


def test_a_run_without_its_calibration_says_that_the_applied_command_is_not_known(tmp_path):
    log_run(tmp_path / "a.ring", tmp_path / "a.mcap", 10)
    with pytest.raises(pamctl.log.LogError, match="carries no calibration"):
        pamctl.log.signals(pamctl.log.read(tmp_path / "a.mcap"))


def test_a_gap_in_an_imported_log_counts_as_missed_ticks(imported):
    measured = pamctl.log.signals(imported)
    assert measured.missed.sum() == measured.missed[100] == 4
    assert np.array_equal(np.diff(imported["tick"]) - 1, measured.missed[1:])
    assert measured.dt_s[:2].tolist() == pytest.approx([1e-3, 1e-3])
    assert pamctl.log.info(imported.path)["missed_ticks"] == 4


def test_the_package_costs_the_loop_nothing_until_a_log_is_read():
    code = "import sys, pamctl.log; print(*sys.modules)"
    loaded = subprocess.check_output([sys.executable, "-c", code], text=True).split()
    assert not {"numpy", "mcap", "pydantic"} & set(loaded)
    assert set(pamctl.log.__all__) == {
        name for name in pamctl.log.__all__ if hasattr(pamctl.log, name)
    }


@pytest.mark.parametrize("name", ["qsmc", "missed", "card", "card-clocked"])
def test_some_columns_suffice_for_figures_and_signals(name):
    path = GOLDEN / f"{name}.mcap"
    whole = pamctl.log.read(path)
    figures = read_some(path, FIGURE_FIELDS)
    assert len(figures.columns) < len(whole.columns)
    np.testing.assert_equal(summarise_run(figures), summarise_run(whole))
    some = pamctl.log.signals(read_some(path, SIGNAL_FIELDS))
    for field in Signals.__dataclass_fields__:
        np.testing.assert_equal(getattr(some, field), getattr(pamctl.log.signals(whole), field))
