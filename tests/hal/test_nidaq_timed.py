"""Hardware-timed single points: the card is the clock, and what is written waits for its edge."""

from collections.abc import Callable, Iterator

import pytest
from nidaqmx.constants import WaitMode
from standin.standin import USB, Card, here
from support.card_rigs import READ_COUNT, READ_VOLTS, WRITE, make_and_close, use_card
from support.runs import AO_STEP_V, MS

from hal.nidaq.card_settings import NidaqSettings
from hal.nidaq.nidaq_backend import judge_hardware_timing
from hal.nidaq.probe import try_hardware_timing
from hal.rig import RigError, open_rig
from pamctl.processes.backends import build_clock, build_rig
from pamctl.realtime.clock import SampleClock
from pamctl.settings.resolve import ConfigError, resolve

SAFE_V = 1.25
safe = pytest.approx(SAFE_V, abs=AO_STEP_V)


@pytest.fixture
def card() -> Iterator[Card]:
    """A card whose time stands still but for its own edges."""
    for card in use_card(here()):
        card.stop_time()
        yield card


@pytest.fixture
def make(card: Card) -> Iterator[Callable[..., object]]:
    from hal.nidaq.nidaq_rig import HardwareTimedRig

    def make_one(**changes: object) -> HardwareTimedRig:
        settings = NidaqSettings(timing="hardware_timed", **changes)
        return HardwareTimedRig(settings, rate_hz=1e3, safe_output_v=SAFE_V, now_ns=card.now_ns)

    yield from make_and_close(card, make_one)


# --- order -------------------------------------------------------------------------------


def test_what_follows_the_clock_starts_before_it_and_stops_output_first(card, make):
    with open_rig(make()):
        assert card.task_moves == ["+ao0", "-ao0", "+ctr0", "+ao0", "+ai"]
    assert card.task_moves[5:] == ["-ao0", "-ai", "-ctr0"]


def test_the_safe_voltage_is_out_before_the_sample_clock_runs(card, make):
    card.registers.ao_v[0] = 8.0  # left there by a run that was killed
    card.fail("DAQmxStartTask", -200821, after=2)  # the one on demand and the counter do start
    with pytest.raises(RigError):
        make().open()
    assert card.output_v == safe


# --- one tick ----------------------------------------------------------------------------


def test_what_is_written_is_put_out_at_the_next_edge_and_not_before(card, make):
    rig = make()
    rig.open()
    rig.read()
    for volts in (7.0, 3.0):
        before_v = card.output_v
        rig.write(volts)
        assert card.output_v == before_v
        edge_ns = rig.await_edge().t_ns
        assert card.output_v == pytest.approx(volts, abs=AO_STEP_V / 2)
        assert card.registers.ao_ns - 1 == edge_ns
        rig.read()
    assert rig.describe().output_delay_ticks == 1


def test_each_sample_is_that_of_the_edge_before_the_new_output_acts(card, make):
    """Input, counter and output share the edge: the muscle cannot have moved yet."""
    rig = make()
    rig.open()
    at_rest = rig.read()
    rig.write(10.0)
    first, second = rig.read(), rig.read()
    assert first.pressure_v == at_rest.pressure_v
    assert second.pressure_v > first.pressure_v
    assert second.encoder_t_ns - first.encoder_t_ns == MS
    assert second.pressure_t_ns == second.encoder_t_ns


def test_encoder_and_pressure_are_latched_together_even_where_they_are_read_late(card, make):
    rig = make()
    rig.open()
    rig.write(10.0)
    for _ in range(50):
        rig.read()
    rig.await_edge()
    card.set_time_ns(card.now_ns() + 900_000)  # the computer dawdles, the muscle goes on
    late = rig.read().encoder_counts
    assert late == card.registers.sampled_count
    assert late < card.registers.counter


def test_the_safe_voltage_is_out_when_make_safe_returns_and_the_rig_goes_on(card, make):
    rig = make()
    rig.open()
    for _ in range(3):
        rig.write(9.0)
        rig.read()
        rig.write(8.0)
        rig.make_safe()
        assert card.output_v == safe
        assert not any(card.registers.ao_is_pending)
    assert rig.safe_failure is None
    assert rig.read().encoder_t_ns < rig.read().encoder_t_ns


def test_the_safe_voltage_is_driven_without_a_sample_clock_too(card, make):
    rig = make()
    rig.open()
    rig.write(9.0)
    rig.read()
    card.registers.clock_runs = 0
    rig.make_safe()
    assert card.output_v == safe
    assert rig.safe_failure is None


# --- too late ----------------------------------------------------------------------------


@pytest.mark.parametrize("code", [0, -209800, -209802, 209800, 209802])
def test_missed_edges_are_counted_whatever_the_driver_says_of_them(card, make, code):
    rig = make()
    rig.open()
    card.registers.late_code = code
    clock = SampleClock(build_clock(resolve(), may_spin=False), rig.await_edge)
    ticks = []
    for dawdled_ns in (0, 100_000, 3 * MS + 200_000, 0, 0):
        card.set_time_ns(card.now_ns() + dawdled_ns)
        wake = clock.wait()
        rig.read()
        ticks.append((wake.tick, wake.missed))
    # Where the driver refuses a sample that came too late, the next one is read.
    late = (5, 3) if code < 0 else (4, 2)
    assert ticks == [(0, 0), (1, 0), late, (late[0] + 1, 0), (late[0] + 2, 0)]
    assert rig.warnings == ({str(code): 1} if code else {})


def test_a_write_that_came_too_late_is_written_for_the_edge_after(card, make):
    rig = make()
    rig.open()
    rig.read()
    card.fail(WRITE, -209801, times=1)
    rig.write(6.0)
    rig.read()
    assert card.output_v == pytest.approx(6.0, abs=AO_STEP_V / 2)
    assert rig.warnings == {"-209801": 1}


@pytest.mark.parametrize("function", [READ_VOLTS, READ_COUNT, WRITE])
def test_who_is_always_too_late_gets_an_error_that_says_so(card, make, function):
    rig = make()
    rig.open()
    card.fail(function, -209800)
    with pytest.raises(RigError, match=r"rig\.loop\.rate_hz") as caught:
        rig.write(5.0)
        rig.read()
    assert caught.value.code == -209800


def test_a_card_that_samples_no_more_is_an_error_and_no_wait_for_ever(card, make):
    rig = make()
    rig.open()
    rig.read()
    card.registers.clock_runs = 0
    with pytest.raises(RigError, match="waiting for the card's next sample") as caught:
        rig.await_edge()
    assert caught.value.code == -200284


# --- how data move and reads wait --------------------------------------------------------


def test_a_read_sleeps_until_the_card_interrupts_and_the_log_says_how_data_move(card, make):
    rig = make()
    rig.open()
    assert card.registers.ai_wait_mode == WaitMode.WAIT_FOR_INTERRUPT.value
    told = rig.describe().extra
    assert told["wait_mode"] == "WAIT_FOR_INTERRUPT"
    polled = {"input": "POLLED", "counter": "POLLED", "output": "POLLED"}
    assert told["data_transfer_in_use"] == polled


def test_a_driver_that_refuses_the_wait_mode_keeps_its_own_and_the_log_says_which(card, make):
    card.fail("DAQmxSetReadAttribute", -200197)
    rig = make()
    rig.open()
    assert rig.describe().extra["wait_mode"] == "POLL"
    assert rig.read().encoder_counts == 0


@pytest.mark.parametrize("how", ["the file leaves it", "the driver keeps its own"])
def test_a_driver_that_does_not_choose_programmed_io_says_what_to_set(card, make, how):
    fixed = how == "the driver keeps its own"
    card.registers.transfer_is_fixed = fixed
    rig = make(data_transfer="polled" if fixed else "driver")
    with pytest.raises(RigError) as caught:
        rig.open()
    assert caught.value.code == -200842  # the counter starts first
    assert "nidaq.data_transfer: polled" in caught.value.fix
    assert "nidaq.timing: on_demand" in caught.value.fix
    assert card.output_v == safe


@pytest.mark.parametrize("skips", [0, 1, 4])
def test_the_probe_of_the_clock_counts_the_edges_that_nobody_saw(card, skips):
    card.registers.clock_skips = skips
    trial = try_hardware_timing(NidaqSettings(), 1e3, SAFE_V, card.now_ns)
    assert trial.missed == 99 * skips
    found = judge_hardware_timing(trial, 1e-3, is_wanted=True)
    assert found.level == ("fault" if skips else "ok")
    assert f"{trial.missed} missed" in found.message
    assert judge_hardware_timing(trial, 1e-3, is_wanted=False).level == "ok"


def test_the_probe_warns_of_a_read_that_polls(card):
    card.fail("DAQmxSetReadAttribute", -200197)
    trial = try_hardware_timing(NidaqSettings(), 1e3, SAFE_V, card.now_ns)
    found = judge_hardware_timing(trial, 1e-3, is_wanted=True)
    assert found.level == "warning"
    assert "POLL" in found.message


# --- where it is not possible ------------------------------------------------------------


def test_a_card_on_usb_is_refused_with_what_to_do(card, make):
    card.registers.bus = USB
    with pytest.raises(RigError, match="on USB: no hardware-timed single points") as caught:
        make().open()
    assert caught.value.fix == "set nidaq.timing: on_demand in the rig file"
    assert card.output_v == safe


@pytest.mark.parametrize(
    "code", [-200820, -200821, -200303, -200452, -200077, -200769, -200842, -200996, -50152]
)
@pytest.mark.parametrize("function", ["DAQmxCfgSampClkTiming", "DAQmxStartTask"])
def test_a_card_that_does_not_do_it_says_its_number_and_what_to_do(card, make, function, code):
    rig = make()
    card.fail(function, code, after=1)
    with pytest.raises(RigError) as caught:
        rig.open()
    assert caught.value.code == code
    assert "timing" in caught.value.fix
    assert card.output_v == safe
    card.mend()
    rig.open()  # nothing is left reserved


def test_a_timeout_shorter_than_two_samples_is_refused():
    overrides = ["rig.nidaq.timing=hardware_timed", "rig.nidaq.timeout_s=0.0015"]
    with pytest.raises(ConfigError, match="less than two periods"):
        resolve(rig="pci6221", overrides=overrides)


def test_with_hardware_timing_the_rig_is_the_clock(card):
    settings = resolve(rig="pci6221", overrides=["rig.nidaq.timing=hardware_timed"])
    parts = build_rig(settings, build_clock(settings, may_spin=False))
    assert isinstance(parts.clock, SampleClock)
    with open_rig(parts.rig):
        first, second = parts.clock.wait(), parts.clock.wait()
    assert (first.tick, second.tick) == (0, 1)
