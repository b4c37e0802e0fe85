"""The card's backend over the real nidaqmx package and a stand-in driver."""

from __future__ import annotations

import ctypes
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator

import pytest
from standin.standin import PERMIT, Card, here, library
from support.card_rigs import READ_COUNT, READ_VOLTS, WRITE, hardware_timed, on_demand
from support.patience import PATIENCE_S
from support.runs import (
    AO_STEP_V,
    COUNT_M,
    MS,
    MemoryJournal,
    ScriptedSupervisor,
    run,
    run_settings,
)

from hal.nidaq.card_settings import NidaqSettings
from hal.rig import Rig, RigError, open_rig
from pamctl.exit_codes import Ending, ExitCode
from pamctl.processes.guardian import drive_safe
from pamctl.realtime.clock import Clock
from pamctl.realtime.loop import ControlLoop
from pamctl.settings.build import build_program, build_tick_setup, nominal_zero_of
from pamctl.settings.resolve import ConfigError, resolve
from pamctl.signals import Phase, Truth

SAFE_V = 1.25
VENT_V, FILL_V = 0.0, 10.0
safe = pytest.approx(SAFE_V, abs=AO_STEP_V)


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch) -> Iterator[Card]:
    monkeypatch.setenv(PERMIT, "1")
    here().power_up()
    yield here()
    here().mend()
    here().registers.is_gone = 0


@pytest.fixture
def make(card: Card) -> Iterator[Callable[..., object]]:
    """Make rigs, and close them whatever the test has done to them."""
    from hal.nidaq.nidaq_rig import NidaqRig

    made = []

    def make_one(**changes: object) -> NidaqRig:
        made.append(NidaqRig(NidaqSettings(**changes), safe_output_v=SAFE_V))
        return made[-1]

    yield make_one
    card.mend()
    card.registers.is_gone = 0
    for rig in made:
        rig.close()


# --- opening -----------------------------------------------------------------------------


def test_the_safe_voltage_is_the_first_thing_written_and_the_last(card: Card, make) -> None:
    with open_rig(make()) as rig:
        rig.write(7.0)
    assert card.written_v[0] == safe
    assert card.written_v[-1] == safe
    assert [volts for volts in card.written_v if volts != safe] == [pytest.approx(7.0, abs=1e-3)]


@pytest.mark.parametrize(
    "function", ["DAQmxCreateAIVoltageChan", "DAQmxCreateCILinEncoderChan", "DAQmxSetChanAttribute"]
)
def test_an_input_that_cannot_be_had_is_found_out_at_the_safe_voltage(
    card: Card, make, function: str
) -> None:
    card.registers.ao_v[0] = 8.0  # left there by a run that was killed
    card.fail(function, -200170, times=1)
    rig = make()
    with pytest.raises(RigError, match="no such channel") as caught:
        rig.open()
    assert caught.value.code == -200170
    assert card.output_v == safe
    rig.open()  # nothing is left reserved, and no task of the first try


def test_the_encoder_is_decoded_four_times_and_filtered_and_has_no_index(card: Card, make) -> None:
    make().open()
    registers = card.registers
    assert registers.counter_runs
    assert registers.counter_edges_per_count == 1
    assert registers.counter_filter_s == 125e-9
    assert not registers.counter_z_resets


def test_the_encoder_filter_can_be_off_but_never_one_that_loses_counts(card: Card, make) -> None:
    make(encoder_filter_ns=0).open()
    assert card.registers.counter_filter_s == 0.0
    with pytest.raises(ValueError, match="encoder_filter_ns"):
        NidaqSettings(encoder_filter_ns=2_550_000)  # type: ignore[arg-type]


@pytest.mark.parametrize(("terminal", "number"), [("rse", 10083), ("nrse", 10078), ("diff", 10106)])
def test_the_input_is_wired_as_the_file_says_in_its_narrowest_range(
    card: Card, make, terminal: str, number: int
) -> None:
    make(terminal=terminal).open()
    assert card.registers.ai_terminal == number
    assert card.registers.ai_full_scale_v == 5.0


def test_a_rig_that_is_open_does_not_open_again(make) -> None:
    rig = make()
    rig.open()
    with pytest.raises(RigError, match="open already"):
        rig.open()
    rig.read()


def test_once_opened_it_says_which_library_and_card_it_drives(make) -> None:
    rig = make()
    assert "library" not in rig.describe().extra
    rig.open()
    described = rig.describe().extra
    assert described["library"] == str(library())
    assert described["driver_version"] == "26.8.0"
    assert described["product_type"] == "PCI-6221"
    assert described["serial_number"] == "DECAF"


def test_the_stand_in_is_refused_where_tests_do_not_permit_it(
    make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(PERMIT)
    with pytest.raises(RigError, match="stand-in driver of pamctl's tests"):
        make().open()


# --- reading -----------------------------------------------------------------------------


def test_the_count_follows_the_muscle_through_many_reads(card: Card, make) -> None:
    card.stop_time()
    rig = make()
    rig.open()
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


@pytest.mark.parametrize("unsigned", [0, 1])
def test_the_count_goes_on_where_the_counter_rolls_over(card: Card, make, unsigned: int) -> None:
    card.stop_time()
    card.registers.ticks_are_unsigned = unsigned
    rig = make()
    rig.open()
    upwards = [0, -3, 5, 2**30, 2**31 - 1, 2**31 + 4, 3 * 2**30, 2**32 - 1, 2**32 + 9]
    for counts in [*upwards, *reversed(upwards), *(-counts for counts in upwards)]:
        card.registers.counter = counts % 2**32
        assert rig.read().encoder_counts == counts


@pytest.mark.parametrize(
    ("has_37_pins", "wired", "settings", "sign"),
    [
        (0, (8, 10), {}, 1),
        (1, (0, 2), {}, 1),
        (1, (8, 10), {}, 0),
        (0, (3, 5), {}, 0),
        (0, (3, 5), {"encoder_a_pfi": 3, "encoder_b_pfi": 5}, 1),
        (0, (3, 5), {"encoder_a_pfi": 5, "encoder_b_pfi": 3}, -1),
        (1, (3, 5), {"encoder_a_pfi": 3, "encoder_b_pfi": 5}, 1),
    ],
)
def test_the_encoder_counts_where_it_is_wired_to_the_terminals_of_the_file(
    card: Card, make, has_37_pins: int, wired: tuple[int, int], settings: dict[str, int], sign: int
) -> None:
    card.stop_time()
    card.registers.has_37_pins, card.registers.encoder_pfi = has_37_pins, wired
    rig = make(**settings)
    rig.open()
    rig.write(FILL_V)
    card.set_time_ns(100 * MS)
    assert rig.read().encoder_counts == sign * card.registers.encoder_edges
    assert card.registers.encoder_edges > 1000
    if sign == 1:
        assert rig.describe().extra["encoder_terminals"] == [f"/Dev1/PFI{line}" for line in wired]


def test_a_terminal_that_the_card_lacks_is_refused_with_those_it_has(card: Card, make) -> None:
    card.registers.has_37_pins = 1
    with pytest.raises(RigError, match=r"AInputTerm.*/Dev1/PFI8.*PFI0 to PFI7") as caught:
        make(encoder_a_pfi=8, encoder_b_pfi=10).open()
    assert caught.value.code == -200077
    assert card.output_v == safe


def test_an_unplugged_encoder_stands_still_while_the_muscle_moves(card: Card, make) -> None:
    card.stop_time()
    card.registers.encoder_is_unplugged = 1
    rig = make()
    rig.open()
    rig.write(FILL_V)
    card.set_time_ns(100 * MS)
    assert rig.read().encoder_counts == 0
    assert card.registers.plant.position_m > 5e-3


def test_a_broken_sensor_wire_reads_zero_volts(card: Card, make) -> None:
    rig = make()
    rig.open()
    card.registers.wire_is_broken = 1
    assert rig.read().pressure_v == 0.0


def test_an_open_input_without_a_pull_down_reads_what_it_likes(card: Card, make) -> None:
    card.stop_time()
    card.registers.pull_down_is_missing = 1
    card.registers.open_drift_v_per_s = -0.5
    rig = make()
    rig.open()
    before_v = rig.read().pressure_v
    card.registers.wire_is_broken = 1
    card.set_time_ns(100 * MS)
    assert rig.read().pressure_v == pytest.approx(before_v - 0.05, abs=1e-3)
    card.set_time_ns(60_000 * MS)
    assert rig.read().pressure_v == -5.0


def test_an_input_outside_its_range_reads_the_end_of_it(card: Card, make) -> None:
    card.registers.sensor_zero_v = 1.7
    rig = make(input_low_v=-1.0, input_high_v=1.0)
    rig.open()
    assert rig.read().pressure_v == pytest.approx(1.0, abs=1e-4)


# --- writing -----------------------------------------------------------------------------


def test_a_write_stays_within_the_configured_range_of_the_output(card: Card, make) -> None:
    rig = make(output_low_v=0.0, output_high_v=7.3)
    rig.open()
    assert rig.write(-4.0) == card.output_v == 0.0
    assert rig.write(9.0) == card.output_v
    assert 7.3 - AO_STEP_V < card.output_v <= 7.3
    assert rig.write(5.1) == card.output_v == pytest.approx(5.1, abs=AO_STEP_V / 2)


def test_the_driver_guards_the_same_range_as_the_backend(card: Card, make) -> None:
    rig = make(output_high_v=6.0)
    rig.open()
    with pytest.raises(Exception, match="-200561"):
        rig._wired.write_v(6.5, 0.02)
    assert card.output_v == safe


# --- when the driver says no -------------------------------------------------------------


@pytest.mark.parametrize(
    ("code", "fix"),
    [
        (-50103, "another program"),
        (-200284, "did not answer in time"),
        (-200561, "nidaq.output_low_v"),
        (-201003, "nilsdev"),
        (-209999, "look the number up"),
    ],
)
@pytest.mark.parametrize(
    ("function", "doing"),
    [
        (READ_COUNT, "reading the encoder"),
        (READ_VOLTS, "reading the pressure sensor"),
        (WRITE, "writing to the valve"),
    ],
)
def test_an_error_of_the_driver_names_what_failed_its_number_and_the_fix(
    card: Card, make, function: str, doing: str, code: int, fix: str
) -> None:
    rig = make()
    rig.open()
    card.fail(function, code, after=1)

    def tick() -> None:
        rig.read()
        rig.write(6.0)

    tick()
    with pytest.raises(RigError) as caught:
        tick()
    assert caught.value.code == code
    assert str(caught.value).startswith(doing)
    assert fix in caught.value.fix
    card.mend()
    tick()


def test_a_refused_value_is_told_whole_with_what_can_be_selected(
    make, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = make()
    # No value of the settings is refused, so that of the driver is asked for one.
    monkeypatch.setattr(rig, "_settings", rig._settings.model_copy(update={"encoder_filter_ns": 9}))
    with pytest.raises(RigError) as caught:
        rig.open()
    assert caught.value.code == -200077
    assert caught.value.what == (
        "opening Dev1: The stand-in driver says no. "
        "Property: DAQmx_CI_Encoder_AInput_DigFltr_MinPulseWidth; Requested Value: 9e-09; "
        "You Can Select: 125.0e-9, 6.425e-6, 2.55e-3"
    )


def test_no_line_of_the_driver_s_message_is_lost_but_task_and_status() -> None:
    from hal.nidaq.driver import join_lines

    said = """Requested value is not a supported value for this property.

Property: DAQmx_AO_Min
Requested Value: -10.0
Maximum Value:  3.5
Channel Name: Dev1/ao0

Task Name: _unnamedTask<0>

Status Code: -200077"""
    assert join_lines(said) == (
        "Requested value is not a supported value for this property. Property: DAQmx_AO_Min; "
        "Requested Value: -10.0; Maximum Value: 3.5; Channel Name: Dev1/ao0"
    )


def test_a_driver_that_ctypes_cannot_call_is_a_rig_error_too(
    make, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = make()
    rig.open()

    def refuse(timeout_s: float) -> float:
        raise ctypes.ArgumentError("argument 2: wrong type")

    monkeypatch.setattr(rig, "_wired", rig._wired._replace(read_v=refuse))
    with pytest.raises(RigError, match="wrong type"):
        rig.read()


def test_without_a_driver_the_error_says_what_to_install(
    make, monkeypatch: pytest.MonkeyPatch
) -> None:
    from nidaqmx.errors import DaqNotFoundError

    import hal.nidaq.driver

    def missing(purpose: str) -> None:
        raise DaqNotFoundError("Could not find an installation of NI-DAQmx.")

    monkeypatch.setattr(hal.nidaq.driver, "_make_task", missing)
    rig = make()
    with pytest.raises(RigError, match="install NI-DAQmx for Linux"):
        rig.open()
    rig.make_safe()
    assert "install NI-DAQmx" in str(rig.safe_failure)


def test_a_hanging_read_ends_with_a_timeout(card: Card, make) -> None:
    rig = make()
    rig.open()
    card.fail(READ_VOLTS, hang_s=30.0, times=1)
    with pytest.raises(RigError) as caught:
        rig.read()
    assert caught.value.code == -200284
    rig.read()


def test_warnings_of_the_driver_are_counted_and_not_printed(
    card: Card, make, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = make()
    rig.open()
    card.fail(READ_VOLTS, 200010, times=3)
    card.fail(WRITE, 209802, times=1)
    for _ in range(5):
        rig.read()
        rig.write(3.0)
    assert rig.warnings == {"200010": 3, "209802": 1}
    assert rig.describe().extra["driver_warnings"] == rig.warnings
    assert card.output_v == pytest.approx(3.0, abs=AO_STEP_V)
    assert capsys.readouterr() == ("", "")
    rig.close()
    rig.open()
    assert rig.warnings == {}


def test_other_people_s_warnings_are_still_shown(make) -> None:
    import warnings

    with pytest.warns(UserWarning, match="not the driver's"), open_rig(make()):
        warnings.warn("not the driver's", stacklevel=1)


# --- making safe -------------------------------------------------------------------------


@pytest.mark.parametrize("failures", [1, 2, 5])
def test_a_safe_write_that_fails_is_tried_again(card: Card, make, failures: int) -> None:
    rig = make()
    rig.open()
    rig.write(9.0)
    card.fail(WRITE, -200284, times=failures)
    rig.make_safe()
    assert card.output_v == safe
    assert rig.safe_failure is None


def test_after_a_passing_failure_to_make_safe_the_rig_is_still_open(card: Card, make) -> None:
    rig = make()
    rig.open()
    card.fail(WRITE, -200284, times=1)
    rig.make_safe()
    assert rig.write(4.0) == card.output_v


def test_make_safe_takes_back_an_output_that_somebody_has_reset(card: Card, make) -> None:
    from nidaqmx.system import Device

    rig = make()
    rig.open()
    rig.write(9.0)
    Device("Dev1").reset_device()
    rig.make_safe()
    assert card.output_v == safe
    assert rig.safe_failure is None


def test_a_card_that_is_gone_raises_nowhere_on_the_way_out(card: Card, make) -> None:
    rig = make()
    with pytest.raises(RigError) as caught, open_rig(rig):
        card.registers.is_gone = 1
        rig.read()
    assert caught.value.code == -201003
    assert rig.safe_failure is not None
    assert rig.safe_failure.code == -201003


def test_a_read_that_raises_something_unheard_of_still_ends_safe(card: Card, make) -> None:
    rig = make()
    with pytest.raises(MemoryError), open_rig(rig):
        rig.write(9.0)
        raise MemoryError
    assert card.output_v == safe


# --- other processes ---------------------------------------------------------------------

HOLD = """
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


@pytest.fixture
def holder(card: Card) -> Iterator[subprocess.Popen[str]]:
    """Another process that has the output at 8 V."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD], env=card.environment(), stdout=subprocess.PIPE, text=True
    )
    with process:
        assert process.stdout is not None
        assert process.stdout.readline() == "holding\n"
        yield process
        process.kill()


def test_an_output_that_another_process_holds_is_left_to_it_until_it_is_dead(
    card: Card, make, holder: subprocess.Popen[str]
) -> None:
    rig = make()
    with pytest.raises(RigError, match="another program") as caught:
        rig.open()
    assert caught.value.code == -50103
    rig.make_safe()
    assert rig.safe_failure is not None
    assert rig.safe_failure.code == -50103
    assert card.output_v == pytest.approx(8.0, abs=AO_STEP_V)

    holder.send_signal(signal.SIGKILL)
    os.waitid(os.P_PID, holder.pid, os.WEXITED | os.WNOWAIT)  # dead, and not yet reaped
    assert card.output_v == pytest.approx(8.0, abs=AO_STEP_V)
    rig.open()
    assert card.output_v == safe


def test_make_safe_outwaits_a_holder_that_is_just_dying(
    make, card: Card, holder: subprocess.Popen[str]
) -> None:
    holder.send_signal(signal.SIGKILL)
    assert drive_safe(make(), patience_s=PATIENCE_S) is None
    assert card.output_v == safe


# --- settings ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("override", "complaint"),
    [
        ("rig.nidaq.output_low_v=1", "safe_volts must lie within the output's range, 1.0 to 10.0"),
        ("rig.nidaq.output_low_v=10", "output_low_v must be below output_high_v"),
        ("rig.nidaq.input_low_v=5", "input_low_v must be below input_high_v"),
        ("rig.nidaq.terminal=pseudo", "nidaq.terminal"),
        ("rig.nidaq.encoder_a_pfi=3", "must be given both or not at all"),
        ("rig.nidaq.encoder_b_pfi=16", "nidaq.encoder_b_pfi"),
        ("rig.nidaq.devise=Dev2", "did you mean 'device'?"),
        ("rig.nidaq.device=Gerät", "nidaq.device"),
    ],
)
def test_a_rig_file_that_cannot_be_is_refused(override: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match="rig") as caught:
        resolve(rig="pci6221", overrides=[override])
    assert complaint in str(caught.value)


@pytest.mark.parametrize(("timed", "output_delay_ticks"), [(on_demand, 0), (hardware_timed, 1)])
def test_card_and_simulation_give_the_same_ticks(
    card: Card,
    timed: Callable[[Card, float], tuple[Rig, Clock]],
    output_delay_ticks: int,
) -> None:
    settings = run_settings(
        "rig.sim.sensor_noise_v=0",
        "rig.sim.encoder_start_counts=0.4",
        f"rig.sim.output_delay_ticks={output_delay_ticks}",
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
        setup=build_tick_setup(settings),
        nominal_zero=nominal_zero_of(settings),
        program=build_program(settings),
        journal=journal,
        supervisor=ScriptedSupervisor(),
        truth=lambda: Truth(math.nan, math.nan),
    ).run()
    assert (
        ending
        == simulated.ending
        == Ending(ExitCode.OK, "the duration of 3 s ended the experiment of 37 s")
    )
    assert len(journal.ticks) == len(simulated.journal.ticks) > 5000
    assert len(journal.phase(Phase.TRACK)) + len(journal.phase(Phase.APPROACH)) == 3000
    pairs = list(zip(journal.ticks, simulated.journal.ticks, strict=True))
    for real, model in pairs:
        assert real.timing == model.timing
        assert abs(real.raw.encoder_counts - model.raw.encoder_counts) <= 1
        assert real.raw.pressure_v == pytest.approx(model.raw.pressure_v, abs=1.01 * 10 / 65536)
        assert real.outcome.applied_v == pytest.approx(model.outcome.applied_v, abs=0.02)
        assert real.decision.verdicts == model.decision.verdicts
    # The two plants differ by rounding: hardly ever does one cross a code that the other does not.
    alike = [real.raw[:2] == model.raw[:2] for real, model in pairs]
    assert sum(alike) > 0.99 * len(pairs)
