"""Every shipped rig keeps the contract; more tests of the simulated rig.

The cases are in `hal/rig_contract.py`. To test another backend, add a factory to `FACTORIES`.
"""

import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from standin.standin import PERMIT, here, here_behind_comedi

from hal.backend import BuiltRig, RigRequest
from hal.calibration import CalibrationSettings, Configured
from hal.comedi.comedi_backend import COMEDI, ComediSettings
from hal.entry_points import _SHIPPED_RIGS, RIGS
from hal.faulty import FaultSettings, FaultyRig
from hal.nidaq.card_settings import NidaqSettings
from hal.nidaq.nidaq_backend import NIDAQ
from hal.rig import RawSample, Rig, RigError, RigIdentity, open_rig
from hal.rig_contract import (
    RIG_CONTRACT,
    RigBench,
    every_read_is_fresh,
    record_names_its_device_output_and_pace,
    safe_voltage_is_out_before_open_returns,
    write_within_the_range_goes_to_the_nearest_code,
)
from hal.sim import SIM, SimRig, SimSettings, sensor_chain
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.simulated import SimulatedPlant

SAFE_V = 1.25
"""Neither zero nor half scale: no default can be taken for it."""
STEP_V = 20.0 / 65536.0


class PassingTime:
    """A clock that goes on by 10 us whenever it is read."""

    def __init__(self) -> None:
        self.time_ns = 5_000_000_000

    def now_ns(self) -> int:
        self.time_ns += 10_000
        return self.time_ns


def request(settings: Configured, now_ns: Callable[[], int]) -> RigRequest[Any]:
    return RigRequest(
        settings=settings,
        calibration=CalibrationSettings(),
        safe_volts=SAFE_V,
        rate_hz=1000.0,
        now_ns=now_ns,
        plant=SimulatedPlant(plant_parameters(PlantSettings())),
    )


def make_sim(output_delay_ticks: int = 0) -> RigBench:
    asked = request(SimSettings(output_delay_ticks=output_delay_ticks), PassingTime().now_ns)
    built = SIM.build(asked)
    assert isinstance(built.rig, SimRig)
    rig = built.rig
    return RigBench(SIM, asked, built, lambda: rig.output_v)


def make_sim_with_delay() -> RigBench:
    return make_sim(output_delay_ticks=1)


def make_faulty_without_faults_due() -> RigBench:
    bench = make_sim()
    faults = [FaultSettings(kind="device_lost", from_tick=1_000_000)]
    bench.built = BuiltRig(FaultyRig(bench.rig, faults))
    return bench


_cards_in_use: list[Rig] = []
"""Rigs that hold the one card there is; a forgotten SimRig holds nothing."""


def give_the_card_back() -> None:
    while _cards_in_use:
        _cards_in_use.pop().close()


def make_nidaq() -> RigBench:
    """The card's backend over the stand-in driver, on the whole range of its output."""
    card = here()
    card.power_up()
    give_the_card_back()
    asked = request(NidaqSettings(output_low_v=-10.0), time.monotonic_ns)
    built = NIDAQ.build(asked)
    _cards_in_use.append(built.rig)
    return RigBench(NIDAQ, asked, built, lambda: card.output_v)


def make_nidaq_hardware_timed() -> RigBench:
    """The same by the card's sample clock; its voltmeter waits for the next edge."""
    card = here()
    give_the_card_back()
    card.power_up()
    card.stop_time()

    def now_ns() -> int:
        card.set_time_ns(card.now_ns() + 10_000)
        return card.now_ns()

    asked = request(NidaqSettings(output_low_v=-10.0, timing="hardware_timed"), now_ns)
    built = NIDAQ.build(asked)
    _cards_in_use.append(built.rig)
    return RigBench(NIDAQ, asked, built, lambda: card.output_at_next_edge_v)


def make_comedi() -> RigBench:
    """The card behind the stand-in of libcomedi, on the whole range of its output."""
    card = here_behind_comedi()
    give_the_card_back()
    card.power_up()
    card.calibrate()
    asked = request(ComediSettings(output_low_v=-10.0), time.monotonic_ns)
    built = COMEDI.build(asked)
    _cards_in_use.append(built.rig)
    return RigBench(COMEDI, asked, built, lambda: card.output_v)


@pytest.fixture(autouse=True)
def _one_card_for_all(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv(PERMIT, "1")
    yield
    give_the_card_back()


FACTORIES = [
    make_sim,
    make_sim_with_delay,
    make_faulty_without_faults_due,
    make_nidaq,
    make_nidaq_hardware_timed,
    make_comedi,
]


@pytest.mark.parametrize("make", FACTORIES, ids=lambda make: make.__name__)
@pytest.mark.parametrize("case", RIG_CONTRACT, ids=lambda case: case.__name__)
def test_every_rig_keeps_the_contract(case, make):
    case(make)


def test_a_hardware_timed_card_is_paced_by_the_computer_where_the_caller_wants_it():
    here().power_up()
    asked = request(NidaqSettings(timing="hardware_timed"), time.monotonic_ns)
    built = NIDAQ.build(RigRequest(**{**vars(asked), "by_computer": True}))
    assert built.await_edge is None
    assert not built.rig.describe().sample_clock


def test_the_shipped_entry_points_are_those_that_a_stale_install_falls_back_on():
    pyproject = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    declared = pyproject["project"]["entry-points"][RIGS]
    assert declared == {point.name: point.value for point in _SHIPPED_RIGS}


# --- the cases find what is wrong ----------------------------------------------------------


class Wrong:
    """Passes every call to a sound rig; a subclass breaks one promise."""

    def __init__(self, inner: SimRig) -> None:
        self.inner = inner

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)


class ForgetsTheSafeVoltage(Wrong):
    def open(self) -> None:
        self.inner.open()
        self.inner.write(9.0)


class ReturnsStaleSamples(Wrong):
    _sample: RawSample | None = None

    def read(self) -> RawSample:
        self._sample = self._sample or self.inner.read()
        return self._sample


class ReturnsWhatWasAsked(Wrong):
    def write(self, ao_v: float) -> float:
        self.inner.write(ao_v)
        return ao_v


class CallsItselfOtherwise(Wrong):
    def describe(self) -> RigIdentity:
        return self.inner.describe()._replace(backend="other")


@pytest.mark.parametrize(
    ("wrong", "case"),
    [
        (ForgetsTheSafeVoltage, safe_voltage_is_out_before_open_returns),
        (ReturnsStaleSamples, every_read_is_fresh),
        (ReturnsWhatWasAsked, write_within_the_range_goes_to_the_nearest_code),
        (CallsItselfOtherwise, record_names_its_device_output_and_pace),
    ],
)
def test_a_rig_that_breaks_a_promise_fails_the_case_for_it(wrong, case):
    def make() -> RigBench:
        bench = make_sim()
        bench.built = BuiltRig(wrong(bench.rig))  # type: ignore[arg-type]
        return bench

    with pytest.raises(AssertionError):
        case(make)


# --- beyond the contract -------------------------------------------------------------------


def test_a_rig_is_made_safe_before_it_is_closed_even_if_it_did_not_open():
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
    """A simulated muscle whose kernel raises an error."""

    position_m = 0.0
    pressure_pa = 101.3e3

    def advance(self, command_v: float, duration_s: float) -> None:
        raise ValueError("math domain error")


def test_a_simulated_plant_that_fails_cannot_keep_its_rig_from_being_made_safe():
    chain = sensor_chain(SimSettings(), CalibrationSettings())
    rig = SimRig(BurstPlant(), chain, safe_output_v=SAFE_V, now_ns=PassingTime().now_ns)
    with pytest.raises(RigError, match="domain"), open_rig(rig):
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


def play(delay: int) -> list[tuple[float, float]]:
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


def test_a_write_reaches_the_simulated_valve_when_it_is_made():
    assert play(delay=0) == [
        (-5.0, 0.25),
        (5.0, 0.75),
        (5.0, 0.25),
        (2.0, 0.75),
        (2.0, 0.5),
        (-5.0, 0.5),
    ]


def test_with_output_delay_a_write_waits_for_the_next_read_but_the_safe_voltage_does_not():
    assert play(delay=1) == [(-5.0, 1.0), (5.0, 1.0), (2.0, 0.5), (-5.0, 0.5)]
