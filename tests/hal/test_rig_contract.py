"""What every rig owes the loop. To add a backend, add a factory to `FACTORIES`."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st
from standin.standin import PERMIT, here

from hal.calibration import CalibrationSettings
from hal.faulty import FaultSettings, FaultyRig
from hal.nidaq.card_settings import NidaqSettings
from hal.rig import RawSample, Rig, RigError, open_rig
from hal.sim.sim_rig import SimRig, SimSettings, sensor_chain
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.simulated import SimulatedPlant

SAFE_V = 1.25
"""Neither zero nor half scale, so that no default passes for it."""
LOWEST_V, STEP_V = -10.0, 20.0 / 65536.0
HIGHEST_V = 10.0 - STEP_V


class Bench(NamedTuple):
    """A rig on the bench, with a voltmeter on its output."""

    rig: Rig
    now_ns: Callable[[], int]
    """The clock that the sample's times are on."""
    output_v: Callable[[], float]
    """What the device really puts out, whatever the rig says."""


class PassingTime:
    """A clock that goes on by 10 us whenever somebody looks at it."""

    def __init__(self) -> None:
        self.time_ns = 5_000_000_000

    def now_ns(self) -> int:
        self.time_ns += 10_000
        return self.time_ns


def sim(output_delay_ticks: int = 0) -> Bench:
    passing = PassingTime()
    rig = SimRig(
        SimulatedPlant(plant_parameters(PlantSettings())),
        sensor_chain(SimSettings(), CalibrationSettings()),
        safe_output_v=SAFE_V,
        now_ns=passing.now_ns,
        output_delay_ticks=output_delay_ticks,
    )
    return Bench(rig, passing.now_ns, lambda: rig.output_v)


def sim_with_delay() -> Bench:
    return sim(output_delay_ticks=1)


def faulty_without_faults_due() -> Bench:
    bench = sim()
    faults = [FaultSettings(kind="device_lost", from_tick=1_000_000)]
    return bench._replace(rig=FaultyRig(bench.rig, faults))


_cards_in_use: list[Rig] = []
"""Rigs that hold the one card there is, as SimRigs that were forgotten do not."""


def give_the_card_back() -> None:
    while _cards_in_use:
        _cards_in_use.pop().close()


def nidaq() -> Bench:
    """The card's backend over the stand-in driver, on the whole range of its output."""
    card = here()
    card.power_up()
    from hal.nidaq.on_demand import NidaqRig

    give_the_card_back()
    rig = NidaqRig(NidaqSettings(output_low_v=-10.0), safe_output_v=SAFE_V)
    _cards_in_use.append(rig)
    return Bench(rig, time.monotonic_ns, lambda: card.output_v)


def nidaq_hardware_timed() -> Bench:
    """The same by the card's sample clock; its voltmeter waits for the edge that is due."""
    card = here()
    from hal.nidaq.hardware_timed import HardwareTimedRig

    give_the_card_back()
    card.power_up()
    card.stop_time()

    def now_ns() -> int:
        card.set_time_ns(card.now_ns() + 10_000)
        return card.now_ns()

    rig = HardwareTimedRig(
        NidaqSettings(output_low_v=-10.0, timing="hardware_timed"),
        rate_hz=1000.0,
        safe_output_v=SAFE_V,
        now_ns=now_ns,
    )
    _cards_in_use.append(rig)
    return Bench(rig, now_ns, lambda: card.output_at_next_edge_v)


@pytest.fixture(autouse=True)
def _one_card_for_all(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv(PERMIT, "1")
    yield
    give_the_card_back()


FACTORIES = [sim, sim_with_delay, faulty_without_faults_due, nidaq, nidaq_hardware_timed]

every_rig = pytest.mark.parametrize("make", FACTORIES)
Make = Callable[[], Bench]


@every_rig
def test_the_safe_voltage_is_out_before_open_returns(make: Make) -> None:
    rig, _, output_v = make()
    rig.open()
    assert output_v() == pytest.approx(SAFE_V, abs=STEP_V / 2)


@every_rig
def test_a_rig_that_is_not_open_refuses_to_read_and_write(make: Make) -> None:
    rig, _, output_v = make()
    for _ in range(2):  # never opened; closed
        with pytest.raises(RigError, match="open"):
            rig.read()
        with pytest.raises(RigError, match="open"):
            rig.write(7.0)
        rig.open()
        rig.close()
    assert output_v() == pytest.approx(SAFE_V, abs=STEP_V / 2)


@every_rig
def test_every_read_is_fresh(make: Make) -> None:
    rig, now_ns, _ = make()
    rig.open()
    for _ in range(5):
        before_ns = now_ns()
        sample = rig.read()
        after_ns = now_ns()
        assert before_ns < sample.pressure_t_ns < after_ns
        assert before_ns < sample.encoder_t_ns < after_ns


@every_rig
def test_a_sample_is_volts_and_whole_counts(make: Make) -> None:
    rig, _, _ = make()
    rig.open()
    sample = rig.read()
    assert isinstance(sample, RawSample)
    assert math.isfinite(sample.pressure_v)
    assert [type(value) for value in sample] == [float, int, int, int]


@every_rig
@given(volts=st.floats(LOWEST_V, HIGHEST_V))
def test_a_write_within_the_range_goes_to_the_nearest_code(make: Make, volts: float) -> None:
    rig, _, output_v = make()
    rig.open()
    applied_v = rig.write(volts)
    assert applied_v == output_v()
    assert abs(applied_v - volts) <= STEP_V / 2 * (1 + 1e-9)
    assert applied_v / STEP_V == round(applied_v / STEP_V)


@every_rig
@given(volts=st.floats(allow_nan=False, allow_infinity=False))
def test_a_write_outside_the_range_stops_at_its_end(make: Make, volts: float) -> None:
    rig, _, output_v = make()
    rig.open()
    applied_v = rig.write(volts)
    assert applied_v == output_v()
    assert LOWEST_V <= applied_v <= HIGHEST_V
    if not LOWEST_V <= volts <= HIGHEST_V:
        assert applied_v == (HIGHEST_V if volts > 0 else LOWEST_V)


@every_rig
@pytest.mark.parametrize("volts", [math.nan, math.inf, -math.inf])
def test_a_write_that_is_no_number_is_refused_and_changes_nothing(make: Make, volts: float) -> None:
    rig, _, output_v = make()
    rig.open()
    applied_v = rig.write(6.5)
    with pytest.raises(RigError, match="finite"):
        rig.write(volts)
    assert output_v() == applied_v
    assert rig.write(3.0) == output_v() != applied_v


@every_rig
def test_make_safe_is_legal_in_every_state_any_number_of_times(make: Make) -> None:
    rig, _, output_v = make()
    safe_v = pytest.approx(SAFE_V, abs=STEP_V / 2)

    def make_safe_twice() -> None:
        for _ in range(2):
            rig.make_safe()
            assert output_v() == safe_v

    make_safe_twice()  # before open
    rig.open()
    make_safe_twice()  # before anything was written
    rig.write(9.0)
    make_safe_twice()
    rig.write(-9.0)
    rig.read()
    make_safe_twice()
    rig.close()
    make_safe_twice()


@every_rig
def test_close_ends_safe_and_may_be_repeated(make: Make) -> None:
    rig, _, output_v = make()
    rig.open()
    rig.write(9.0)
    for _ in range(3):
        rig.close()
        assert output_v() == pytest.approx(SAFE_V, abs=STEP_V / 2)


@every_rig
def test_close_before_open_is_harmless(make: Make) -> None:
    rig, _, _ = make()
    rig.close()
    rig.open()
    rig.read()


@every_rig
def test_a_rig_describes_itself_before_open_in_json(make: Make) -> None:
    rig, _, _ = make()
    before = dict(rig.describe())
    assert before["backend"]
    assert json.loads(json.dumps(before, allow_nan=False)) == before
    rig.open()
    after = dict(rig.describe())
    assert {name: after[name] for name in before} == before
    assert json.loads(json.dumps(after, allow_nan=False)) == after


@every_rig
@pytest.mark.parametrize("raised", [ValueError, KeyboardInterrupt, SystemExit])
def test_an_exception_leaves_the_rig_safe_and_closed(
    make: Make, raised: type[BaseException]
) -> None:
    rig, _, output_v = make()

    def work() -> None:
        with open_rig(rig):
            rig.write(9.0)
            raise raised

    with pytest.raises(raised):
        work()
    assert output_v() == pytest.approx(SAFE_V, abs=STEP_V / 2)
    with pytest.raises(RigError):
        rig.read()


@every_rig
def test_a_closed_rig_opens_again_safe(make: Make) -> None:
    rig, _, output_v = make()
    for _ in range(3):
        with open_rig(rig):
            assert output_v() == pytest.approx(SAFE_V, abs=STEP_V / 2)
            rig.read()
            assert rig.write(7.0) == output_v()


def test_a_rig_is_made_safe_before_it_is_closed_even_if_it_did_not_open() -> None:
    calls: list[str] = []

    class Recorded:
        def open(self) -> None:
            calls.append("open")
            raise RigError("gone")

        def make_safe(self) -> None:
            calls.append("make_safe")

        def close(self) -> None:
            calls.append("close")

    with pytest.raises(RigError, match="gone"), open_rig(Recorded()):  # type: ignore[arg-type]
        pass
    assert calls == ["open", "make_safe", "close"]


class BurstPlant:
    """A simulated muscle whose numbers have gone where no kernel can follow."""

    position_m = 0.0
    pressure_pa = 101.3e3

    def advance(self, command_v: float, duration_s: float) -> None:
        raise ValueError("math domain error")


def test_a_simulated_plant_that_fails_cannot_keep_its_rig_from_being_made_safe() -> None:
    chain = sensor_chain(SimSettings(), CalibrationSettings())
    rig = SimRig(BurstPlant(), chain, safe_output_v=SAFE_V, now_ns=PassingTime().now_ns)
    with pytest.raises(ValueError, match="domain"), open_rig(rig):
        rig.read()
    assert rig.output_v == pytest.approx(SAFE_V, abs=STEP_V / 2)
    with pytest.raises(RigError, match="not open"):
        rig.read()


class Lazy:
    """Notes the valve command that acted during each stretch of time."""

    position_m = 0.0
    pressure_pa = 101.3e3

    def __init__(self) -> None:
        self.history: list[tuple[float, float]] = []

    def advance(self, command_v: float, duration_s: float) -> None:
        self.history.append((round(command_v, 2), round(duration_s * 1e3, 6)))


def lazy_rig(delay: int) -> tuple[SimRig, Lazy, list[int]]:
    plant, now_ns = Lazy(), [0]
    chain = sensor_chain(SimSettings(), CalibrationSettings())
    rig = SimRig(
        plant, chain, safe_output_v=0.0, now_ns=lambda: now_ns[0], output_delay_ticks=delay
    )
    rig.open()
    return rig, plant, now_ns


def played(delay: int) -> list[tuple[float, float]]:
    """Two ticks and a stop; each read at a whole ms, each write 0.25 ms later."""
    rig, plant, now_ns = lazy_rig(delay)
    for volts in (10.0, 7.0):
        rig.read()
        now_ns[0] += 250_000
        rig.write(volts)
        now_ns[0] += 750_000
    rig.read()
    now_ns[0] += 500_000
    rig.make_safe()
    now_ns[0] += 500_000
    rig.read()
    return plant.history


def test_a_write_reaches_the_simulated_valve_when_it_is_made() -> None:
    assert played(delay=0) == [
        (-5.0, 0.25),
        (5.0, 0.75),
        (5.0, 0.25),
        (2.0, 0.75),
        (2.0, 0.5),
        (-5.0, 0.5),
    ]


def test_with_output_delay_a_write_waits_for_the_next_read_but_the_safe_voltage_does_not() -> None:
    assert played(delay=1) == [(-5.0, 1.0), (5.0, 1.0), (2.0, 0.5), (-5.0, 0.5)]
