"""The backend on comedi over a stand-in library with the card and the muscle behind it."""

from __future__ import annotations

import errno
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator

import pytest
from standin.standin import COMEDI_SONAME, PERMIT, Card, here_behind_comedi, library
from support.card_rigs import CardClock
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

from hal.comedi import libcomedi
from hal.comedi.comedi_backend import ComediSettings
from hal.comedi.comedi_rig import ComediRig
from hal.rig import RigError, open_rig
from pamctl.exit_codes import Ending, ExitCode
from pamctl.processes.guardian import drive_safe
from pamctl.realtime.loop import ControlLoop
from pamctl.settings.build import build_program, build_tick_setup, nominal_zero_of
from pamctl.settings.resolve import ConfigError, resolve
from pamctl.signals import Phase, Truth

SAFE_V = 1.25
FILL_V = 10.0
READ, WRITE, CONFIGURE = "comedi_do_insnlist", "comedi_data_write", "comedi_do_insn"
Make = Callable[..., ComediRig]
safe = pytest.approx(SAFE_V, abs=AO_STEP_V)


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch) -> Iterator[Card]:
    monkeypatch.setenv(PERMIT, "1")
    card = here_behind_comedi()
    card.power_up()
    card.calibrate()
    yield card
    card.mend()
    card.registers.is_gone = 0


@pytest.fixture
def make(card: Card) -> Iterator[Make]:
    """Make rigs, and close them whatever the test has done to them."""
    made = []

    def make_one(**changes: object) -> ComediRig:
        settings = ComediSettings.model_validate(changes)
        made.append(ComediRig(settings, safe_output_v=SAFE_V))
        return made[-1]

    yield make_one
    card.mend()
    card.registers.is_gone = 0
    for rig in made:
        rig.close()


# --- opening -----------------------------------------------------------------------------


def test_the_safe_voltage_is_the_first_thing_written_and_the_last(card: Card, make: Make) -> None:
    with open_rig(make()) as rig:
        rig.write(7.0)
    assert card.written_v[0] == safe
    assert card.written_v[-1] == safe
    assert [volts for volts in card.written_v if volts != safe] == [pytest.approx(7.0, abs=1e-3)]


@pytest.mark.parametrize("after", range(13))
def test_an_encoder_that_cannot_be_set_up_is_reported_at_the_safe_voltage(
    card: Card, make: Make, after: int
) -> None:
    card.registers.ao_v[0] = 8.0  # left there by a run that was killed
    card.fail(CONFIGURE, -errno.EINVAL, after=after, times=1)
    rig = make()
    with pytest.raises(RigError, match=r"setting up (PFI|counter)") as caught:
        rig.open()
    assert caught.value.code == errno.EINVAL
    assert "PFI lines in section comedi" in caught.value.fix
    assert card.output_v == safe
    rig.open()  # nothing of the first try is still locked


def test_the_encoder_is_decoded_four_times_and_filtered_and_has_no_index(
    card: Card, make: Make
) -> None:
    make().open()
    registers = card.registers
    assert registers.counter_runs
    assert registers.counter_edges_per_count == 1
    assert registers.counter_filter_s == 125e-9
    assert not registers.counter_z_resets


@pytest.mark.parametrize(("filter_ns", "filter_s"), [(0, 0.0), (6425, 6.425e-6)])
def test_the_encoder_filter_is_that_of_the_rig_file(
    card: Card, make: Make, filter_ns: int, filter_s: float
) -> None:
    make(encoder_filter_ns=filter_ns).open()
    assert card.registers.counter_filter_s == filter_s


@pytest.mark.parametrize(
    ("a", "b", "counted"), [(8, 10, 2000), (10, 8, -2000), (2, 3, 0), (8, 3, 0), (15, 10, 0)]
)
def test_the_encoder_counts_on_the_lines_that_it_is_wired_to(
    card: Card, make: Make, a: int, b: int, counted: int
) -> None:
    card.stop_time()
    rig = make(encoder_a_pfi=a, encoder_b_pfi=b)
    rig.open()
    rig.write(FILL_V)
    card.set_time_ns(300 * MS)
    counts = rig.read().encoder_counts
    assert (abs(counts) > 2000) == (counted != 0)
    assert counts * counted >= 0


def test_lines_above_9_have_numbers_of_their_own(card: Card, make: Make) -> None:
    """The kernel's header numbers PFI 10 to 15 apart from PFI 0 to 9."""
    card.stop_time()
    for line in range(15):
        card.power_up()
        card.stop_time()
        card.registers.encoder_pfi = (line, line + 1)
        with open_rig(make(encoder_a_pfi=line, encoder_b_pfi=line + 1)) as rig:
            rig.write(FILL_V)
            card.set_time_ns(300 * MS)
            assert rig.read().encoder_counts > 2000


@pytest.mark.parametrize(("terminal", "reference"), [("rse", 0), ("nrse", 1), ("diff", 2)])
def test_the_input_is_wired_as_the_file_says_in_its_narrowest_range(
    card: Card, make: Make, terminal: str, reference: int
) -> None:
    make(terminal=terminal).open()
    assert card.registers.ai_terminal == reference
    assert card.registers.ai_full_scale_v == 5.0


def test_a_rig_that_is_open_does_not_open_again(make: Make) -> None:
    rig = make()
    rig.open()
    with pytest.raises(RigError, match="open already"):
        rig.open()
    rig.read()


def test_once_opened_it_says_which_library_card_and_calibration_it_uses(
    card: Card, make: Make
) -> None:
    rig = make()
    assert "library" not in rig.describe().extra
    rig.open()
    extra = rig.describe().extra
    assert extra["library"] == str(library(COMEDI_SONAME))
    assert extra["driver_version"] == "0.7.76"
    assert extra["product_type"] == "pci-6221"
    assert extra["calibrated_by"] == str(card.calibration_path)
    assert extra["input_volts_coefficients"] == [0.0, 10.0 / 65536.0]


def test_the_stand_in_is_refused_where_tests_do_not_permit_it(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(PERMIT)
    with pytest.raises(RigError, match="stand-in driver of pamctl's tests"):
        make().open()


def test_no_child_process_inherits_the_device_file(make: Make) -> None:
    """A child that did would keep the locks of a rig that was killed."""
    rig = make()
    rig.open()
    assert rig._wired is not None
    file = rig._wired.file
    assert not os.get_inheritable(file.library.comedi_fileno(file.handle))


# --- calibration -------------------------------------------------------------------------


def off_by_percents(card: Card) -> None:
    card.registers.ai_gain, card.registers.ai_offset_v = 0.94, 0.011
    card.registers.ao_gain, card.registers.ao_offset_v = 0.97, -0.02


def test_a_calibrated_card_reads_and_writes_true_volts(card: Card, make: Make) -> None:
    off_by_percents(card)
    card.calibrate()
    rig = make()
    rig.open()
    assert card.output_v == safe
    assert rig.read().pressure_v == pytest.approx(0.215, abs=3e-4)
    for volts in (0.0, 0.3, 4.9, 9.6):
        assert rig.write(volts) == pytest.approx(volts, abs=AO_STEP_V / 2)
        assert card.output_v == pytest.approx(volts, abs=1.5 * AO_STEP_V)


def test_a_voltage_beyond_the_last_code_puts_out_the_last_code(card: Card, make: Make) -> None:
    """The kernel refuses a code that the converter does not have."""
    off_by_percents(card)
    card.calibrate()
    rig = make()
    rig.open()
    rig.write(10.0)
    assert card.output_v == pytest.approx(9.7 - 0.02, abs=1e-3)


def test_a_nonlinear_polynomial_is_applied(card: Card, make: Make) -> None:
    card.calibration_path.write_text(
        card.calibration_path.read_text().replace(
            "coefficients => [0.0, 0.000152587890625]",
            "coefficients => [0.5, 0.000152587890625, 1e-6, -1e-11]",
        )
    )
    rig = make()
    rig.open()
    code = round(0.215 / (10.0 / 65536.0))
    bent_v = 0.5 + code * (10.0 / 65536.0) + 1e-6 * code**2 - 1e-11 * code**3
    assert rig.read().pressure_v == pytest.approx(bent_v, abs=1e-9)


@pytest.mark.parametrize("parts", [{"inputs": False}, {"outputs": False}, None])
def test_without_a_calibration_the_rig_says_what_to_run_at_the_safe_voltage(
    card: Card, make: Make, parts: dict[str, bool] | None
) -> None:
    card.registers.ao_v[0] = 8.0
    if parts is None:
        card.calibration_path.unlink()
    else:
        card.calibrate(**parts)
    with pytest.raises(RigError, match="has no calibration") as caught:
        make().open()
    assert "comedi_soft_calibrate -f /dev/comedi0" in caught.value.fix
    # An uncalibrated code is some steps away.
    assert card.output_v == pytest.approx(SAFE_V, abs=5 * AO_STEP_V)


def test_make_safe_needs_no_calibration(card: Card, make: Make) -> None:
    card.calibration_path.unlink()
    card.registers.ao_v[0] = 8.0
    rig = make()
    rig.make_safe()
    assert rig.safe_failure is None
    assert card.output_v == pytest.approx(SAFE_V, abs=5 * AO_STEP_V)


def test_an_uncalibrated_card_is_used_only_where_the_rig_file_says_so(
    card: Card, make: Make
) -> None:
    off_by_percents(card)
    card.calibration_path.unlink()
    rig = make(calibration_file="none")
    rig.open()
    assert rig.describe().extra["calibrated_by"] == "none"
    assert rig.read().pressure_v == pytest.approx(0.215 * 0.94 + 0.011, abs=1e-3)


def test_a_calibration_file_that_the_rig_file_names_is_read(card: Card, make: Make) -> None:
    named = card.calibration_path.with_name("mine")
    card.calibration_path.rename(named)
    rig = make(calibration_file=str(named))
    rig.open()
    assert rig.describe().extra["calibrated_by"] == str(named)


# --- reading -----------------------------------------------------------------------------


@pytest.mark.parametrize("is_one_call", [True, False])
def test_the_count_follows_the_muscle_through_many_reads(
    card: Card, make: Make, is_one_call: bool
) -> None:
    if not is_one_call:
        card.fail(READ, -errno.EINVAL)
    card.stop_time()
    rig = make()
    rig.open()
    assert rig.describe().extra["reads_in_one_call"] == is_one_call
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


@pytest.mark.parametrize("bits", [32, 24])
def test_the_count_goes_on_where_the_counter_rolls_over(card: Card, make: Make, bits: int) -> None:
    card.stop_time()
    card.registers.counter_maxdata = 2**bits - 1
    rig = make()
    rig.open()
    half = 2 ** (bits - 1)
    upwards = [0, -3, 5, half // 2, half - 1, half + 4, 3 * half // 2, 2 * half - 1, 2 * half + 9]
    for counts in [*upwards, *reversed(upwards), *(-counts for counts in upwards)]:
        card.registers.counter = counts % 2**32
        assert rig.read().encoder_counts == counts


def test_an_unplugged_encoder_stands_still_while_the_muscle_moves(card: Card, make: Make) -> None:
    card.stop_time()
    card.registers.encoder_is_unplugged = 1
    rig = make()
    rig.open()
    rig.write(FILL_V)
    card.set_time_ns(100 * MS)
    assert rig.read().encoder_counts == 0
    assert card.registers.plant.position_m > 5e-3


def test_a_broken_sensor_wire_reads_zero_volts(card: Card, make: Make) -> None:
    rig = make()
    rig.open()
    card.registers.wire_is_broken = 1
    assert rig.read().pressure_v == 0.0


def test_an_input_outside_its_range_reads_the_end_of_it(card: Card, make: Make) -> None:
    card.registers.sensor_zero_v = 1.7
    rig = make(input_low_v=-1.0, input_high_v=1.0)
    rig.open()
    assert rig.read().pressure_v == pytest.approx(1.0, abs=1e-4)


# --- writing -----------------------------------------------------------------------------


def test_a_write_stays_within_the_configured_range_of_the_output(card: Card, make: Make) -> None:
    rig = make(output_low_v=0.0, output_high_v=7.3)
    rig.open()
    assert rig.write(-4.0) == card.output_v == 0.0
    assert rig.write(9.0) == card.output_v
    assert 7.3 - AO_STEP_V < card.output_v <= 7.3
    assert rig.write(5.1) == card.output_v == pytest.approx(5.1, abs=AO_STEP_V / 2)


# --- when the card refuses ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("code", "fix"),
    [
        (errno.EBUSY, "another program"),
        (errno.EACCES, "another program"),
        (errno.ETIME, "did not answer in time"),
        (errno.ENODEV, "modprobe ni_pcimio"),
        (errno.EINVAL, "section comedi"),
        (errno.EIO, "dmesg"),
    ],
)
@pytest.mark.parametrize(
    ("function", "doing"),
    [(READ, "reading encoder and pressure sensor"), (WRITE, "writing to the valve")],
)
def test_an_error_of_the_card_names_what_failed_its_number_and_the_fix(
    card: Card, make: Make, function: str, doing: str, code: int, fix: str
) -> None:
    rig = make()
    rig.open()
    card.fail(function, -code, after=1)

    def tick() -> None:
        rig.read()
        rig.write(6.0)

    tick()
    with pytest.raises(RigError) as caught:
        tick()
    assert caught.value.code == code
    assert str(caught.value).startswith(doing)
    assert os.strerror(code) in caught.value.what
    assert fix in caught.value.fix
    card.mend()
    tick()


def test_where_both_are_read_singly_an_error_names_the_one_that_failed(
    card: Card, make: Make
) -> None:
    card.fail(READ, -errno.EINVAL)
    rig = make()
    rig.open()
    card.fail(CONFIGURE, -errno.ETIME, times=1)
    with pytest.raises(RigError, match="reading the encoder: "):
        rig.read()
    card.fail(CONFIGURE, -errno.ETIME, after=1, times=1)
    with pytest.raises(RigError, match="reading the pressure sensor: "):
        rig.read()
    rig.read()


@pytest.mark.parametrize(
    ("code", "fix"),
    [
        (errno.EACCES, "ls -l /dev/comedi0 shows its group"),
        (errno.ENODEV, "pamctl doctor --backend comedi"),
        (errno.ENOTTY, "no comedi device"),
    ],
)
def test_a_device_file_that_cannot_be_opened_says_why(
    card: Card, make: Make, code: int, fix: str
) -> None:
    card.fail("comedi_open", -code)
    rig = make()
    with pytest.raises(RigError, match="opening /dev/comedi0") as caught:
        rig.open()
    assert caught.value.code == code
    assert fix in caught.value.fix


def test_a_device_file_that_is_not_there_says_which_driver_makes_it(make: Make) -> None:
    with pytest.raises(RigError, match="modprobe ni_pcimio") as caught:
        make(device="/dev/comedi7").open()
    assert caught.value.code == errno.ENOENT


def test_a_channel_that_the_card_does_not_have_is_named(card: Card, make: Make) -> None:
    with pytest.raises(RigError, match="analog input 16 is not one of the card's 16"):
        make(pressure_channel="ai16").open()
    assert card.output_v == safe


def test_without_the_library_the_error_says_what_to_install(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(libcomedi, "SONAME", "libcomedi-that-is-not-there.so")
    monkeypatch.setattr(libcomedi, "load_library", libcomedi.load_library.__wrapped__)
    rig = make()
    with pytest.raises(RigError, match="apt install libcomedi0"):
        rig.open()
    rig.make_safe()
    assert "apt install libcomedi0" in str(rig.safe_failure)


def test_a_library_without_the_functions_that_are_needed_is_too_old(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(libcomedi, "SONAME", "libm.so.6")
    monkeypatch.setattr(libcomedi, "load_library", libcomedi.load_library.__wrapped__)
    with pytest.raises(RigError, match="libcomedi is too old"):
        make().open()


def test_a_converter_that_is_silent_ends_with_the_kernel_s_timeout(card: Card, make: Make) -> None:
    rig = make()
    rig.open()
    card.fail(READ, hang_s=30.0, times=1)
    with pytest.raises(RigError) as caught:
        rig.read()
    assert caught.value.code == errno.ETIME
    rig.read()


# --- making safe -------------------------------------------------------------------------


@pytest.mark.parametrize("failures", [1, 2, 5])
def test_a_safe_write_that_fails_is_tried_again(card: Card, make: Make, failures: int) -> None:
    rig = make()
    rig.open()
    rig.write(9.0)
    card.fail(WRITE, -errno.ETIME, times=failures)
    rig.make_safe()
    assert card.output_v == safe
    assert rig.safe_failure is None


def test_after_a_passing_failure_to_make_safe_the_rig_is_still_open(card: Card, make: Make) -> None:
    rig = make()
    rig.open()
    card.fail(WRITE, -errno.ETIME, times=1)
    rig.make_safe()
    assert rig.write(4.0) == card.output_v


def test_a_card_that_is_gone_raises_nowhere_on_the_way_out(card: Card, make: Make) -> None:
    rig = make()
    with pytest.raises(RigError) as caught, open_rig(rig):
        card.registers.is_gone = 1
        rig.read()
    assert caught.value.code == errno.ENODEV
    assert rig.safe_failure is not None
    assert rig.safe_failure.code == errno.ENODEV


# --- other programs ----------------------------------------------------------------------

HOLD = """
import time
from hal.comedi.comedi_rig import ComediRig
from hal.comedi.comedi_backend import ComediSettings
rig = ComediRig(ComediSettings(), safe_output_v=1.25)
rig.open()
rig.write(8.0)
print("holding", flush=True)
time.sleep(60)
"""


@pytest.fixture
def holder(card: Card) -> Iterator[subprocess.Popen[str]]:
    """Another process that has the card open, with 8 V on its output."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD],
        env={**card.environment(), "PYTHONPATH": os.pathsep.join(sys.path)},
        stdout=subprocess.PIPE,
        text=True,
    )
    with process:
        assert process.stdout is not None
        assert process.stdout.readline() == "holding\n"
        yield process
        process.kill()


def test_an_output_that_another_process_has_locked_is_left_to_it_until_it_is_dead(
    card: Card, make: Make, holder: subprocess.Popen[str]
) -> None:
    rig = make()
    with pytest.raises(RigError, match="another program") as caught:
        rig.open()
    assert caught.value.code == errno.EBUSY
    rig.make_safe()
    assert rig.safe_failure is not None
    assert rig.safe_failure.code == errno.EACCES
    assert card.output_v == pytest.approx(8.0, abs=AO_STEP_V)

    holder.send_signal(signal.SIGKILL)
    os.waitid(os.P_PID, holder.pid, os.WEXITED | os.WNOWAIT)  # dead, and not yet reaped
    assert card.output_v == pytest.approx(8.0, abs=AO_STEP_V)
    rig.open()
    assert card.output_v == safe


def test_make_safe_outwaits_a_holder_that_is_just_dying(
    make: Make, card: Card, holder: subprocess.Popen[str]
) -> None:
    holder.send_signal(signal.SIGKILL)
    assert drive_safe(make(), patience_s=PATIENCE_S) is None
    assert card.output_v == safe


# --- settings ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("override", "complaint"),
    [
        ("rig.comedi.output_low_v=1", "safe_volts must lie within the output's range, 1.0 to 10.0"),
        ("rig.comedi.input_low_v=5", "input_low_v must be below input_high_v"),
        ("rig.comedi.encoder_a_pfi=10", "must be two lines"),
        ("rig.comedi.encoder_b_pfi=16", "comedi.encoder_b_pfi"),
        ("rig.comedi.device=/dev/null", "comedi.device"),
        ("rig.comedi.timing=hardware_timed", "timing"),
    ],
)
def test_an_impossible_rig_file_is_refused(override: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match="rig") as caught:
        resolve(rig="pci6221-comedi", overrides=[override])
    assert complaint in str(caught.value)


# --- the whole loop ----------------------------------------------------------------------


def test_card_and_simulation_give_the_same_ticks(card: Card) -> None:
    settings = run_settings(
        "rig.sim.sensor_noise_v=0", "rig.sim.encoder_start_counts=0.4", duration_s=1.0
    )
    simulated = run(settings)

    card.stop_time()
    clock = CardClock(card)
    rig = ComediRig(ComediSettings(), safe_output_v=settings.rig.safe_volts, now_ns=clock.now_ns)
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
        == Ending(ExitCode.OK, "the duration of 1 s ended the experiment of 37 s")
    )
    assert len(journal.ticks) == len(simulated.journal.ticks)
    assert len(journal.phase(Phase.APPROACH)) == 1000
    pairs = list(zip(journal.ticks, simulated.journal.ticks, strict=True))
    # Equal to the bit, until the two plants, which differ by rounding, fall to two codes.
    assert [real.raw for real, _ in pairs[:500]] == [model.raw for _, model in pairs[:500]]
    assert [real.outcome.applied_v for real, _ in pairs[:500]] == [
        model.outcome.applied_v for _, model in pairs[:500]
    ]
    for real, model in pairs:
        assert real.timing == model.timing
        assert abs(real.raw.encoder_counts - model.raw.encoder_counts) <= 1
        assert real.raw.pressure_v == pytest.approx(model.raw.pressure_v, abs=1.01 * 10 / 65536)
        assert real.outcome.applied_v == pytest.approx(model.outcome.applied_v, abs=0.02)
        assert real.decision.verdicts == model.decision.verdicts
    alike = [real.raw == model.raw for real, model in pairs]
    assert sum(alike) > 0.99 * len(pairs)
