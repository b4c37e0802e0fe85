"""What offline tools see of a log is the same, whether we ran the rig or another system did."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.made_up import log_run

import pamctl.log
from hal.calibration import CalibrationSettings
from pamctl.log.importing.imported_log import write_imported
from pamctl.signals import Phase

TICKS = 300


def recorded(directory: Path, **calibration: float) -> pamctl.log.Log:
    settings = CalibrationSettings(**calibration).model_dump()
    path = directory / "run.mcap"
    log_run(directory / "a.ring", path, TICKS, config={"rig": {"calibration": settings}})
    return pamctl.log.read(path)


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


@pytest.mark.parametrize("clock", [{}, {"sample_clock": "/Dev1/ai/SampleClock"}])
def test_a_delayed_output_reaches_the_valve_a_tick_later(tmp_path, clock):
    log = recorded(tmp_path)
    rig = {"output_delay_ticks": "1", "safe_output_v": "0.0", **clock}
    late = replace(log, metadata={**log.metadata, "rig": rig})
    late.columns["missed"][200] = 3
    at_once, put_out = (pamctl.log.signals(one).valve_v for one in (log, late))
    assert put_out[0] == -5.0
    usual = np.arange(1, TICKS) != 199
    assert np.array_equal(put_out[1:][usual], at_once[:-1][usual])
    # Between ticks 199 and 200 the card had three more edges; without its clock there are none.
    new_share = 0.75 if clock else 0.0
    expected_v = (1.0 - new_share) * at_once[198] + new_share * at_once[199]
    assert put_out[199] == pytest.approx(expected_v)


def test_a_run_without_its_calibration_says_that_the_applied_command_is_not_known(tmp_path):
    log_run(tmp_path / "a.ring", tmp_path / "a.mcap", 10)
    with pytest.raises(pamctl.log.LogError, match="carries no calibration"):
        pamctl.log.signals(pamctl.log.read(tmp_path / "a.mcap"))


def test_an_imported_log_has_the_signals_that_were_measured_and_none_of_the_others(imported):
    measured = pamctl.log.signals(imported)
    assert imported.is_imported
    assert imported.metadata["import"]["source"] == "lab.csv"
    assert np.array_equal(measured.valve_v, np.cos(measured.t_s))
    assert np.array_equal(measured.position_m, np.sin(measured.t_s))
    assert measured.pressure_pa is None
    assert (measured.phase == pamctl.log.NO_PHASE).all()


def test_a_gap_in_an_imported_log_counts_as_missed_ticks(imported):
    measured = pamctl.log.signals(imported)
    assert measured.missed.sum() == measured.missed[100] == 4
    assert np.array_equal(np.diff(imported["tick"]) - 1, measured.missed[1:])
    assert measured.dt_s[:2].tolist() == pytest.approx([1e-3, 1e-3])
    assert pamctl.log.info(imported.path)["missed_ticks"] == 4


def test_a_slice_of_the_signals_is_a_slice_of_each(imported):
    part = pamctl.log.signals(imported)[50:70]
    assert len(part) == 20
    assert np.array_equal(part.position_m, np.sin(part.t_s))
    assert part.pressure_pa is None


def test_the_package_costs_the_loop_nothing_until_a_log_is_read():
    code = "import sys, pamctl.log; print(*sys.modules)"
    loaded = subprocess.check_output([sys.executable, "-c", code], text=True).split()
    assert not {"numpy", "mcap", "pydantic"} & set(loaded)
    assert set(pamctl.log.__all__) == {
        name for name in pamctl.log.__all__ if hasattr(pamctl.log, name)
    }
