"""Data that would mislead are refused with the reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.made_records import PERIOD_S, measured, pair

from pamctl.diagnose import Record, Verdict, diagnose
from pamctl.diagnose.measured.column_shift import check_time_shifts
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.plant.model import PlantSettings

PAPER = PlantSettings()


def spoilt(**changes: object) -> str:
    """Return why a record with these columns is refused."""
    record = replace(measured("fit", 1), **changes)  # type: ignore[arg-type]
    found = diagnose([record], [measured("judge", 2)], PAPER)
    assert found.verdict is Verdict.BAD_DATA
    assert build_diagnosis_document(found)["reason"] == found.reason
    return found.reason


def test_data_that_would_mislead_are_refused_with_the_reason() -> None:
    good = measured("fit", 1)
    pressure, position, command = good["pressure_pa"], good["position_m"], good["valve_v"]
    assert "kPa" in spoilt(pressure_pa=pressure * 1e-3)
    assert "gauge" in spoilt(pressure_pa=pressure - 101.3e3)
    assert "mm or counts" in spoilt(position_m=position * 1e3)
    assert "driver's offset" in spoilt(valve_v=command + 5.0)
    assert "clipped" in spoilt(pressure_pa=np.minimum(pressure, 350e3))
    t_s = good.t_s.copy()
    t_s[2000:] += 0.3
    assert "a gap of 0.301 s after row 1999" in spoilt(t_s=t_s)
    assert "pressure_pa answers 4" in spoilt(pressure_pa=np.roll(pressure, 40))
    assert "ms before valve_v" in spoilt(pressure_pa=np.roll(pressure, -20))
    assert "ms before pressure_pa" in spoilt(position_m=np.roll(position, -60))
    assert "ms after pressure_pa" in spoilt(
        position_m=np.concatenate([np.zeros(110), position[:-110]])
    )
    broken = position.copy()
    broken[77] = np.nan
    assert "row 77" in spoilt(position_m=broken)


def test_the_longest_lags_of_the_catalogue_are_not_taken_for_a_shifted_column() -> None:
    lags = {
        "command_delay__delay_s": 0.02,
        "valve_spool__time_constant_s": 0.005,
        "bladder_threshold__pressure_pa": 60e3,
        "coulomb_friction__force_n": 40.0,
        "damping_n_s_per_m": 1200.0,
    }
    for hidden in (lags, {"pressure_sensor_lag__time_constant_s": 0.02}, {}):
        assert [*check_time_shifts(measured("fit", **hidden))] == []


def test_a_channel_that_stands_still_is_refused() -> None:
    still = [replace(r, position_m=np.full(len(r), 1e-3)) for r in pair()[0]]
    assert "not excited" in diagnose(still, still, PAPER).reason


def test_columns_of_different_lengths_raise_an_error() -> None:
    with pytest.raises(ValueError, match="3 samples"):
        Record("short", np.arange(4) * PERIOD_S, valve_v=np.zeros(3))
