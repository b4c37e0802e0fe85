"""What is the same behind NI-DAQmx and behind comedi: one card, one muscle, two drivers."""

import errno
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import pytest
from standin.standin import PERMIT, Card, here, here_behind_comedi
from support.card_rigs import (
    READ_COUNT,
    READ_VOLTS,
    WRITE,
    CardClock,
    hardware_timed,
    make_and_close,
    on_demand,
    use_card,
)
from support.patience import PATIENCE_S
from support.runs import (
    AO_STEP_V,
    COUNT_M,
    MS,
    MemoryJournal,
    ScriptedSupervisor,
    run,
    run_settings,
    steered,
)

from hal.comedi.comedi_backend import ComediSettings
from hal.comedi.comedi_rig import ComediRig
from hal.nidaq.card_settings import NidaqSettings
from hal.rig import Rig, RigError, open_rig
from pamctl.base.errors import Ending, ExitCode
from pamctl.processes.guardian import drive_safe
from pamctl.realtime.clock import Clock
from pamctl.realtime.loop import ControlLoop
from pamctl.settings.resolve import ConfigError, resolve
from pamctl.signals import Truth

SAFE_V = 1.25
FILL_V = 10.0
COMEDI_READ, COMEDI_WRITE = "comedi_do_insnlist", "comedi_data_write"
safe = pytest.approx(SAFE_V, abs=AO_STEP_V)

HOLD_BY_NIDAQ = """
import time
from nidaqmx import Task
from nidaqmx.stream_writers import AnalogSingleChannelWriter
task = Task("holder")
task.ao_channels.add_ao_voltage_chan("Dev1/ao0")
task.start()
AnalogSingleChannelWriter(task.out_stream).write_one_sample(8.0)
print("holding", flush=True)
time.sleep(60)
"""
HOLD_BY_COMEDI = """
import time
from hal.comedi.comedi_rig import ComediRig
from hal.comedi.comedi_backend import ComediSettings
rig = ComediRig(ComediSettings(), safe_output_v=1.25)
rig.open()
rig.write(8.0)
print("holding", flush=True)
time.sleep(60)
"""


class Driver(NamedTuple):
    """One way to the card, and what it calls things."""

    name: str
    here: Callable[[], Card]
    rig_file: str
    terminals: dict[str, int]
    read: str
    write: str
    timeout: int
    """What is told as the error's number; a function of comedi returns its negative."""
    gone: int
    busy: int
    """Of an output that another process holds, when the rig is opened."""
    busy_when_safe: int
    hold: str

    def make_rig(self, **changes: Any) -> Rig:
        if self.name == "comedi":
            return ComediRig(ComediSettings.model_validate(changes), safe_output_v=SAFE_V)
        from hal.nidaq.nidaq_rig import NidaqRig

        return NidaqRig(NidaqSettings(**changes), safe_output_v=SAFE_V)

    def fail(self, card: Card, function: str, code: int, **when: int) -> None:
        card.fail(function, -code if self.name == "comedi" else code, **when)


NIDAQ = Driver(
    "nidaq", here, "pci6221", {"rse": 10083, "nrse": 10078, "diff": 10106},
    READ_VOLTS, WRITE, -200284, -201003, -50103, -50103, HOLD_BY_NIDAQ,
)  # fmt: skip
COMEDI = Driver(
    "comedi", here_behind_comedi, "pci6221-comedi", {"rse": 0, "nrse": 1, "diff": 2},
    COMEDI_READ, COMEDI_WRITE, errno.ETIME, errno.ENODEV, errno.EBUSY, errno.EACCES, HOLD_BY_COMEDI,
)  # fmt: skip
Make = Callable[..., Any]


@pytest.fixture(params=[NIDAQ, COMEDI], ids=lambda one: one.name)
def driver(request: pytest.FixtureRequest) -> Driver:
    given: Driver = request.param
    return given


@pytest.fixture
def card(driver: Driver) -> Iterator[Card]:
    yield from use_card(driver.here())


@pytest.fixture
def make(driver: Driver, card: Card) -> Iterator[Make]:
    yield from make_and_close(card, driver.make_rig)


# --- opening -----------------------------------------------------------------------------


def test_the_safe_voltage_is_the_first_thing_written_and_the_last(card, make):
    with open_rig(make()) as rig:
        rig.write(7.0)
    assert card.written_v[0] == safe
    assert card.written_v[-1] == safe
    assert [volts for volts in card.written_v if volts != safe] == [pytest.approx(7.0, abs=1e-3)]


def test_the_encoder_is_decoded_four_times_and_filtered_and_has_no_index(card, make):
    make().open()
    registers = card.registers
    assert registers.counter_runs
    assert registers.counter_edges_per_count == 1
    assert registers.counter_filter_s == 125e-9
    assert not registers.counter_z_resets


@pytest.mark.parametrize("terminal", ["rse", "nrse", "diff"])
def test_the_input_is_wired_as_the_file_says_in_its_narrowest_range(driver, card, make, terminal):
    make(terminal=terminal).open()
    assert card.registers.ai_terminal == driver.terminals[terminal]
    assert card.registers.ai_full_scale_v == 5.0


def test_a_rig_that_is_open_does_not_open_again(make):
    rig = make()
    rig.open()
    with pytest.raises(RigError, match="open already"):
        rig.open()
    rig.read()


def test_the_stand_in_is_refused_where_tests_do_not_permit_it(make, monkeypatch):
    monkeypatch.delenv(PERMIT)
    with pytest.raises(RigError, match="stand-in driver of pamctl's tests"):
        make().open()


# --- reading and writing -----------------------------------------------------------------


@pytest.mark.parametrize("is_one_call", [True, False])
def test_the_count_follows_the_muscle_through_many_reads(driver, card, make, is_one_call):
    if driver is COMEDI and not is_one_call:
        driver.fail(card, COMEDI_READ, errno.EINVAL)
    card.stop_time()
    rig = make()
    rig.open()
    assert rig.describe().extra.get("reads_in_one_call", is_one_call) == is_one_call
    rig.write(FILL_V)
    for tick in range(200):
        card.set_time_ns(tick * MS)
        sample = rig.read()
        position_m = card.registers.plant.position_m
        assert sample.encoder_counts == math.floor(0.4 + position_m / COUNT_M)
        assert sample.pressure_v == pytest.approx(
            0.215 + (card.registers.plant.pressure_pa - 101.3e3) * 5.0 * 1.2858e-6, abs=8e-5
        )
    assert position_m > 10e-3


@pytest.mark.parametrize(
    ("driver", "register", "value", "bits"),
    [
        (NIDAQ, "ticks_are_unsigned", 0, 32),
        (NIDAQ, "ticks_are_unsigned", 1, 32),
        (COMEDI, "counter_maxdata", 2**32 - 1, 32),
        (COMEDI, "counter_maxdata", 2**24 - 1, 24),
    ],
    indirect=["driver"],
)
def test_the_count_goes_on_where_the_counter_rolls_over(card, make, register, value, bits):
    card.stop_time()
    setattr(card.registers, register, value)
    rig = make()
    rig.open()
    half = 2 ** (bits - 1)
    upwards = [0, -3, 5, half // 2, half - 1, half + 4, 3 * half // 2, 2 * half - 1, 2 * half + 9]
    for counts in [*upwards, *reversed(upwards), *(-counts for counts in upwards)]:
        card.registers.counter = counts % 2**32
        assert rig.read().encoder_counts == counts


def test_an_input_outside_its_range_reads_the_end_of_it(card, make):
    card.registers.sensor_zero_v = 1.7
    rig = make(input_low_v=-1.0, input_high_v=1.0)
    rig.open()
    assert rig.read().pressure_v == pytest.approx(1.0, abs=1e-4)


def test_a_write_stays_within_the_configured_range_of_the_output(card, make):
    rig = make(output_low_v=0.0, output_high_v=7.3)
    rig.open()
    assert rig.write(-4.0) == card.output_v == 0.0
    assert rig.write(9.0) == card.output_v
    assert 7.3 - AO_STEP_V < card.output_v <= 7.3
    assert rig.write(5.1) == card.output_v == pytest.approx(5.1, abs=AO_STEP_V / 2)


# --- when the card fails -----------------------------------------------------------------

NIDAQ_FIXES = {
    -50103: "another program",
    -200284: "did not answer in time",
    -200561: "nidaq.output_low_v",
    -201003: "nilsdev",
    -209999: "look the number up",
}
COMEDI_FIXES = {
    errno.EBUSY: "another program",
    errno.EACCES: "another program",
    errno.ETIME: "did not answer in time",
    errno.ENODEV: "modprobe ni_pcimio",
    errno.EINVAL: "section comedi",
    errno.EIO: "dmesg",
}
CALLS = [
    (NIDAQ, READ_COUNT, "reading the encoder"),
    (NIDAQ, READ_VOLTS, "reading the pressure sensor"),
    (NIDAQ, WRITE, "writing to the valve"),
    (COMEDI, COMEDI_READ, "reading encoder and pressure sensor"),
    (COMEDI, COMEDI_WRITE, "writing to the valve"),
]


@pytest.mark.parametrize(("driver", "function", "doing"), CALLS, indirect=["driver"])
def test_an_error_of_the_driver_names_what_failed_its_number_and_the_fix(
    driver, card, make, function, doing
):
    rig = make()
    rig.open()

    def tick() -> None:
        rig.read()
        rig.write(6.0)

    for code, fix in (COMEDI_FIXES if driver is COMEDI else NIDAQ_FIXES).items():
        driver.fail(card, function, code, after=1)
        tick()
        with pytest.raises(RigError) as caught:
            tick()
        assert caught.value.code == code
        assert str(caught.value).startswith(doing)
        assert driver is NIDAQ or os.strerror(code) in caught.value.what
        assert fix in caught.value.fix
        card.mend()
        tick()


def test_a_hanging_read_ends_with_a_timeout(driver, card, make):
    rig = make()
    rig.open()
    card.fail(driver.read, hang_s=30.0, times=1)
    with pytest.raises(RigError) as caught:
        rig.read()
    assert caught.value.code == driver.timeout
    rig.read()


@pytest.mark.parametrize("failures", [1, 2, 5])
def test_a_safe_write_that_fails_is_tried_again(driver, card, make, failures):
    rig = make()
    rig.open()
    rig.write(9.0)
    driver.fail(card, driver.write, driver.timeout, times=failures)
    rig.make_safe()
    assert card.output_v == safe
    assert rig.safe_failure is None


def test_after_a_passing_failure_to_make_safe_the_rig_is_still_open(driver, card, make):
    rig = make()
    rig.open()
    driver.fail(card, driver.write, driver.timeout, times=1)
    rig.make_safe()
    assert rig.write(4.0) == card.output_v


def test_a_card_that_is_gone_raises_nowhere_on_the_way_out(driver, card, make):
    rig = make()
    with pytest.raises(RigError) as caught, open_rig(rig):
        card.registers.is_gone = 1
        rig.read()
    assert caught.value.code == driver.gone
    assert rig.safe_failure is not None
    assert rig.safe_failure.code == driver.gone


# --- other processes ---------------------------------------------------------------------


@pytest.fixture
def holder(driver: Driver, card: Card) -> Iterator[subprocess.Popen[str]]:
    """Another process that has the output at 8 V."""
    process = subprocess.Popen(
        [sys.executable, "-c", driver.hold],
        env={**card.environment(), "PYTHONPATH": os.pathsep.join(sys.path)},
        stdout=subprocess.PIPE,
        text=True,
    )
    with process:
        assert process.stdout is not None
        assert process.stdout.readline() == "holding\n"
        yield process
        process.kill()


def test_an_output_that_another_process_holds_is_left_to_it_until_it_is_dead(
    driver, card, make, holder
):
    rig = make()
    with pytest.raises(RigError, match="another program") as caught:
        rig.open()
    assert caught.value.code == driver.busy
    rig.make_safe()
    assert rig.safe_failure is not None
    assert rig.safe_failure.code == driver.busy_when_safe
    assert card.output_v == pytest.approx(8.0, abs=AO_STEP_V)

    holder.send_signal(signal.SIGKILL)
    os.waitid(os.P_PID, holder.pid, os.WEXITED | os.WNOWAIT)  # dead, and not yet reaped
    assert card.output_v == pytest.approx(8.0, abs=AO_STEP_V)
    rig.open()
    assert card.output_v == safe


def test_make_safe_outwaits_a_holder_that_is_just_dying(make, card, holder):
    holder.send_signal(signal.SIGKILL)
    assert drive_safe(make(), patience_s=PATIENCE_S) is None
    assert card.output_v == safe


# --- settings, and the whole loop --------------------------------------------------------


@pytest.mark.parametrize(
    ("override", "complaint"),
    [
        ("nidaq.output_low_v=1", "safe_volts must lie within the output's range, 1.0 to 10.0"),
        ("nidaq.output_low_v=10", "output_low_v must be below output_high_v"),
        ("nidaq.input_low_v=5", "input_low_v must be below input_high_v"),
        ("nidaq.terminal=pseudo", "nidaq.terminal"),
        ("nidaq.encoder_a_pfi=3", "must be given both or not at all"),
        ("nidaq.encoder_b_pfi=16", "nidaq.encoder_b_pfi"),
        ("nidaq.devise=Dev2", "did you mean 'device'?"),
        ("nidaq.device=Gerät", "nidaq.device"),
        ("comedi.output_low_v=1", "safe_volts must lie within the output's range, 1.0 to 10.0"),
        ("comedi.input_low_v=5", "input_low_v must be below input_high_v"),
        ("comedi.encoder_a_pfi=10", "must be two lines"),
        ("comedi.encoder_b_pfi=16", "comedi.encoder_b_pfi"),
        ("comedi.device=/dev/null", "comedi.device"),
        ("comedi.timing=hardware_timed", "timing"),
    ],
)
def test_a_rig_file_that_cannot_be_is_refused(override, complaint):
    one = COMEDI if override.startswith("comedi") else NIDAQ
    with pytest.raises(ConfigError, match="rig") as caught:
        resolve(rig=one.rig_file, overrides=[f"rig.{override}"])
    assert complaint in str(caught.value)


def test_a_safe_voltage_may_be_the_full_scale_which_is_one_code_beyond_the_last() -> None:
    full = ["rig.safe_volts=10", "rig.calibration.driver_high_v=10"]
    assert resolve(rig=NIDAQ.rig_file, overrides=full).rig.safe_volts == 10.0


def behind_comedi(card: Card, safe_output_v: float) -> tuple[Rig, Clock]:
    clock = CardClock(card)
    rig = ComediRig(ComediSettings(), safe_output_v=safe_output_v, now_ns=clock.now_ns)
    return rig, clock


@pytest.mark.parametrize(
    ("driver", "timed", "output_delay_ticks", "equal_to_the_bit"),
    [
        (NIDAQ, on_demand, 0, 0),
        (NIDAQ, hardware_timed, 1, 0),
        # Until the two plants, which differ by rounding, fall to two codes.
        (COMEDI, behind_comedi, 0, 500),
    ],
    indirect=["driver"],
)
def test_card_and_simulation_give_the_same_ticks(card, timed, output_delay_ticks, equal_to_the_bit):
    settings = run_settings(
        "rig.sim.sensor_noise_v=0",
        "rig.sim.encoder_start_counts=0.4",
        f"rig.sim.output_delay_ticks={output_delay_ticks}",
        "rig.homing.enabled=false",
        duration_s=3.0,
    )
    simulated = run(settings)
    card.stop_time()
    rig, clock = timed(card, settings.rig.safe_volts)
    assert rig.describe().output_delay_ticks == output_delay_ticks
    journal = MemoryJournal()
    ending = ControlLoop(
        rig=rig,
        clock=clock,
        **steered(settings, journal),
        supervisor=ScriptedSupervisor(),
        truth=lambda: Truth(math.nan, math.nan),
    ).run()
    assert (
        ending
        == simulated.ending
        == Ending(ExitCode.OK, "the duration of 3 s ended the experiment of 37 s")
    )
    assert len(journal.ticks) == len(simulated.journal.ticks) > 3000
    pairs = list(zip(journal.ticks, simulated.journal.ticks, strict=True))
    for real, model in pairs[:equal_to_the_bit]:
        assert real.raw == model.raw
        assert real.outcome.applied_v == model.outcome.applied_v
    for real, model in pairs:
        assert real.timing == model.timing
        assert abs(real.raw.encoder_counts - model.raw.encoder_counts) <= 1
        assert real.raw.pressure_v == pytest.approx(model.raw.pressure_v, abs=1.01 * 10 / 65536)
        assert real.outcome.applied_v == pytest.approx(model.outcome.applied_v, abs=0.02)
        assert real.decision.verdicts == model.decision.verdicts
    # Hardly ever does one plant cross a code that the other does not.
    alike = [real.raw[:2] == model.raw[:2] for real, model in pairs]
    assert sum(alike) > 0.99 * len(pairs)
