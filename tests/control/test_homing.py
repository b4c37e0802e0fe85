"""Homing of the simulated rig, whose zeros are known, and of rigs that cannot be homed."""

import math
from collections import deque
from collections.abc import Callable, Iterator
from itertools import groupby, islice

import pytest
from support.runs import MS, parts, run_settings

from hal.calibration import CalibrationSettings, Zero
from hal.rig import RawSample
from pamctl.control.homing import Homing, HomingError, HomingSettings
from pamctl.plant.parameters import PlantState
from pamctl.signals import Phase, Reference

SETTINGS = HomingSettings(fill_rise_v=0, fill_counts=0)
"""For made-up samples, which do not answer to the valve."""
WATCHFUL = HomingSettings()
NOMINAL = CalibrationSettings()


def homed(
    *overrides: str, settings: HomingSettings = WATCHFUL, start: PlantState | None = None
) -> tuple[Zero, list[Reference], float]:
    """Home a simulated rig; return the zeros, the references, and the true end position."""
    run = run_settings(*overrides)
    made = parts(run, run.rig.faults)
    if start is not None:
        made.plant.state = start
    homing, asked = Homing(settings, run.rig.calibration), []
    made.rig.open()
    while True:
        wake = made.clock.wait()
        reference = homing.next_reference(wake.now_ns * 1e-9, made.whole.read())
        if reference is None:
            assert homing.zero is not None
            return homing.zero, asked, made.plant.position_m
        asked.append(reference)
        made.rig.write(5.0 + reference.reference_valve_v)


@pytest.mark.parametrize(("zero_v", "start"), [(0.19, 1000.4), (0.4, -35_000.9)])
def test_homing_finds_both_zeros_however_far_the_nominal_ones_are_off(zero_v, start):
    zero, _, _ = homed(f"rig.sim.sensor_zero_v={zero_v}", f"rig.sim.encoder_start_counts={start}")
    # 250 samples of 2 mV noise: a standard error of 0.13 mV.
    assert zero.sensor_zero_v == pytest.approx(zero_v, abs=0.7e-3)
    assert zero.encoder_zero_counts == math.floor(start)


def test_homing_of_a_filled_muscle_waits_until_it_is_empty():
    filled = PlantState(0.0236, 0.0, 441.3e3)
    zero, _, end_m = homed(start=filled)
    assert zero.sensor_zero_v == pytest.approx(0.215, abs=0.7e-3)
    assert abs(zero.encoder_zero_counts - 1000) <= 1
    assert abs(end_m) < 3.175e-6


def test_a_slow_valve_is_waited_for():
    """With the zero taken too early, 1 kPa left in the muscle would be 6 mV and 0.07 mm."""
    filled = PlantState(0.0236, 0.0, 441.3e3)
    zero, _, _ = homed(
        "plant.parameters.valve_gain_m2_per_v=0.05e-6",
        settings=SETTINGS.model_copy(update={"timeout_s": 60.0}),
        start=filled,
    )
    assert zero.sensor_zero_v == pytest.approx(0.215, abs=1e-3)
    assert abs(zero.encoder_zero_counts - 1000) <= 1


@pytest.mark.parametrize("fills", [0, 3])
def test_homing_vents_fills_so_many_times_and_vents_last(fills):
    settings = SETTINGS.model_copy(update={"fills": fills, "fill_v": 1.5, "vent_v": -4.0})
    _, asked, _ = homed(settings=settings)
    assert {reference.phase for reference in asked} == {Phase.HOMING}
    assert all(math.isnan(reference.reference_m) for reference in asked)
    volts = [reference.reference_valve_v for reference in asked]
    turns = [v for v, before in zip(volts, [None, *volts], strict=False) if v != before]
    assert turns == [-4.0, *[1.5, -4.0] * fills]
    assert volts.count(1.5) == pytest.approx(fills * settings.fill_s * 1e3, abs=fills)


def synthetic(
    sample_at: Callable[[float], tuple[float, float]], seconds: float = 60.0
) -> Iterator[tuple[float, RawSample]]:
    for tick in range(round(seconds * 1e3)):
        volts, counts = sample_at(tick * 1e-3)
        yield tick * 1e-3, RawSample(volts, math.floor(counts), tick * MS, tick * MS)


def fed(sample_at, settings=SETTINGS, calibration=NOMINAL) -> tuple[Zero, float]:
    """Home on synthetic samples; return the zero and the time at which it was found."""
    homing = Homing(settings, calibration)
    for t_s, sample in synthetic(sample_at):
        if homing.next_reference(t_s, sample) is None:
            assert homing.zero is not None
            return homing.zero, t_s
    raise AssertionError("homing neither ended nor gave up")


@pytest.mark.parametrize("zero_v", [0.0, 0.183, 0.41, 4.7])
def test_a_zero_outside_the_sensors_electrical_range_is_refused(zero_v):
    said = rf"vented pressure sensor gives {zero_v:.3f} V, outside 0\.184 to 0\.409 V; check"
    with pytest.raises(HomingError, match=said):
        fed(lambda t: (zero_v, 5))


def test_the_electrical_range_is_a_setting():
    wide = CalibrationSettings(sensor_zero_lowest_v=0.0, sensor_zero_highest_v=1.0)
    assert fed(lambda t: (0.9, 0), calibration=wide)[0].sensor_zero_v == pytest.approx(0.9)


LEAKS = {
    "an encoder that creeps": lambda t: (0.2, 20 * t),
    "an encoder that hunts": lambda t: (0.2, 4 * (round(t * 1e3) % 2)),
    "a pressure that falls": lambda t: (3.0 - 0.1 * t, 0),
    "a pressure that rises": lambda t: (0.2 + 0.1 * t, 0),
    "a pressure that is no number": lambda t: (math.nan, 0),
}


@pytest.mark.parametrize("what", LEAKS)
def test_homing_fails_if_the_sensors_do_not_settle(what):
    homing = Homing(SETTINGS, NOMINAL)
    said = r"still moving 10 s after venting.*counts.*mV.*check the exhaust and the encoder"
    samples = synthetic(LEAKS[what])
    for t_s, sample in samples:
        if t_s > SETTINGS.timeout_s - 1e-9:
            break
        assert homing.next_reference(t_s, sample) is not None
    with pytest.raises(HomingError, match=said):
        deque((homing.next_reference(t_s, sample) for t_s, sample in islice(samples, 3)), maxlen=0)


def test_every_vent_must_be_steady_for_the_whole_steady_time():
    homing, watched = Homing(SETTINGS, NOMINAL), []
    for t_s, sample in synthetic(lambda t: (0.2, 0)):
        reference = homing.next_reference(t_s, sample)
        if reference is None:
            break
        watched.append(reference.reference_valve_v)
    lengths = [(volts, len(list(same))) for volts, same in groupby(watched)]
    vent, fill = (-5.0, pytest.approx(250, abs=1)), (2.0, pytest.approx(150, abs=1))
    assert lengths == [vent, fill, vent, fill, vent]


def test_homing_depends_on_time_and_not_on_ticks():
    """At a quarter of the ticks it takes as long and finds the same."""
    sparse = Homing(SETTINGS, NOMINAL)
    for t_s, sample in synthetic(lambda t: (0.25, 12)):
        if round(t_s * 1e3) % 4 == 0 and sparse.next_reference(t_s, sample) is None:
            break
    _, every_tick_s = fed(lambda t: (0.25, 12))
    assert sparse.zero == Zero(pytest.approx(0.25), 12.0)
    assert t_s == pytest.approx(every_tick_s, abs=0.03)


def test_an_encoder_that_stands_still_while_filling_is_refused():
    with pytest.raises(HomingError, match="moved the encoder by 0 counts"):
        homed("rig.faults=[{kind: stuck_encoder, from_tick: 0}]")


def test_an_encoder_that_counts_backwards_is_refused():
    with pytest.raises(HomingError, match="check its wiring, its supply and `encoder_sign`"):
        homed("rig.faults=[{kind: reversed_encoder, from_tick: 0}]")


def test_a_fill_that_raises_no_pressure_is_refused():
    sample = RawSample(0.215, 1000, 0, 0)
    homing = Homing(HomingSettings(), CalibrationSettings())
    with pytest.raises(HomingError, match="changed the pressure sensor by 0 mV only"):
        for tick in range(20_000):
            homing.next_reference(tick * 1e-3, sample)
