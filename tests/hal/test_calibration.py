"""Volts and counts agree with the data sheets, and the simulated sensors with both."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.runs import COUNT_M

from hal.calibration import (
    CalibrationSettings,
    Converter,
    Zero,
    calibration,
    encoder_counts,
    output_v,
    position_m,
    pressure_pa,
    quantise_v,
    sensor_v,
    valve_v,
)
from hal.sim import SimRig, SimSettings, sensor_chain

NOMINAL = calibration(CalibrationSettings())
VENTED = Zero(0.2, 0.0)
ATMOSPHERE_PA = 101.3e3

calibrations = st.builds(
    lambda **values: calibration(CalibrationSettings(**values)),
    sensor_pa_per_v=st.floats(1e4, 1e6),
    atmospheric_pressure_pa=st.floats(6e4, 1.1e5),
    encoder_m_per_count=st.floats(1e-7, 1e-3),
    encoder_sign=st.sampled_from([1, -1]),
    driver_offset_v=st.floats(-10, 10),
    driver_gain=st.floats(0.1, 10),
)
zeros = st.builds(Zero, st.floats(0.0, 1.0), st.integers(-(10**6), 10**6).map(float))


@given(calibrations, zeros, st.floats(-0.5, 5.0))
def test_volts_to_pascals_and_back(cal, zero, volts):
    assert sensor_v(cal, zero, pressure_pa(cal, zero, volts)) == pytest.approx(volts, abs=1e-10)


@given(calibrations, zeros, st.integers(-(10**7), 10**7))
def test_counts_to_metres_and_back(cal, zero, counts):
    there_and_back = encoder_counts(cal, zero, position_m(cal, zero, counts))
    assert there_and_back == pytest.approx(counts, abs=1e-6)


@given(calibrations, st.floats(-5, 5))
def test_commands_to_volts_and_back(cal, command_v):
    assert valve_v(cal, output_v(cal, command_v)) == pytest.approx(command_v, abs=1e-10)


def test_the_pressure_sensor_is_an_mpx5700() -> None:
    # Data sheet: Vout = Vs (0.0012858 P/kPa + 0.04), Vs = 5 V.
    assert pressure_pa(NOMINAL, VENTED, 0.2) == ATMOSPHERE_PA
    slope_v_per_pa = sensor_v(NOMINAL, VENTED, 1e3) - sensor_v(NOMINAL, VENTED, 0.0)
    assert slope_v_per_pa == pytest.approx(6.429e-3, rel=1e-4)
    for gauge_kpa in (0.0, 100.0, 340.0, 700.0):
        data_sheet_v = 5.0 * (0.0012858 * gauge_kpa + 0.04)
        absolute_pa = ATMOSPHERE_PA + gauge_kpa * 1e3
        assert sensor_v(NOMINAL, VENTED, absolute_pa) == pytest.approx(data_sheet_v, abs=1e-12)


def test_the_encoder_is_an_em2_counted_four_times_a_cycle():
    assert position_m(NOMINAL, VENTED, 8000) == pytest.approx(25.4e-3, rel=1e-12)
    assert position_m(NOMINAL, VENTED, 1) == pytest.approx(3.175e-6, rel=1e-12)


def test_a_contraction_is_positive_whichever_way_the_counts_run():
    reversed_counts = calibration(CalibrationSettings(encoder_sign=-1))
    zero = Zero(0.2, 5000.0)
    assert position_m(reversed_counts, zero, 4000) == pytest.approx(1000 * COUNT_M)
    assert position_m(NOMINAL, zero, 6000) == pytest.approx(1000 * COUNT_M)
    assert encoder_counts(reversed_counts, zero, 1000 * COUNT_M) == pytest.approx(4000)


full_scales = st.sampled_from([5.0, 10.0])


@given(full_scales, st.floats(-1, 1))
def test_a_converter_rounds_to_the_nearest_of_65536_codes(full_scale_v, share):
    step_v = 2 * full_scale_v / 65536
    volts = share * (full_scale_v - step_v)
    converted = quantise_v(Converter(full_scale_v), volts)
    assert abs(converted - volts) <= step_v / 2 * (1 + 1e-9)
    assert (converted / step_v).is_integer()


@given(full_scales, st.floats(0, allow_infinity=False))
def test_a_converter_saturates_one_step_below_its_upper_end(full_scale_v, beyond_v):
    converter = Converter(full_scale_v)
    assert quantise_v(converter, full_scale_v + beyond_v) == full_scale_v * (1 - 2 / 65536)
    assert quantise_v(converter, -full_scale_v - beyond_v) == -full_scale_v


class Stand:
    """A plant that keeps its state."""

    def __init__(self, position_m: float, pressure_pa: float) -> None:
        self.position_m = position_m
        self.pressure_pa = pressure_pa

    def advance(self, command_v: float, duration_s: float) -> None:
        pass


def sensed(settings: SimSettings, nominal=None, position=0.0, pressure=ATMOSPHERE_PA, seed=0):
    chain = sensor_chain(settings, nominal or CalibrationSettings())
    plant = Stand(position, pressure)
    rig = SimRig(plant, chain, safe_output_v=0.0, now_ns=lambda: 0, seed=seed)
    rig.open()
    return rig


@given(
    st.floats(-1e-3, 28e-3),
    st.floats(ATMOSPHERE_PA, 600e3),
    st.sampled_from([1, -1]),
    st.floats(0.184, 0.409),
    st.floats(-2000, 2000),
)
def test_a_quiet_simulated_sensor_says_what_the_calibration_says(
    position, pressure, sign, zero_v, start
):
    nominal = CalibrationSettings(encoder_sign=sign)
    settings = SimSettings(sensor_noise_v=0, sensor_zero_v=zero_v, encoder_start_counts=start)
    sample = sensed(settings, nominal, position, pressure).read()
    cal, zero = calibration(nominal), Zero(zero_v, start)
    step_pa = 10.0 / 65536 * cal.sensor_pa_per_v
    assert abs(pressure_pa(cal, zero, sample.pressure_v) - pressure) <= step_pa / 2 * (1 + 1e-9)
    # The counter knows the last whole edge that was passed.
    beyond_edge = sign * (position - position_m(cal, zero, sample.encoder_counts))
    assert -1e-12 <= beyond_edge <= COUNT_M * (1 + 1e-9)


def test_the_simulated_sensor_saturates_where_its_converter_does():
    rig = sensed(SimSettings(sensor_noise_v=0), pressure=2e6)
    assert rig.read().pressure_v == 5.0 - 10.0 / 65536
