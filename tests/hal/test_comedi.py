"""The backend on comedi over a stand-in library with the card and the muscle behind it."""

import errno
import os
from collections.abc import Callable, Iterator

import pytest
from standin.standin import COMEDI_SONAME, Card, here_behind_comedi, library
from support.card_rigs import make_and_close, use_card
from support.runs import AO_STEP_V, MS

from hal.comedi import libcomedi
from hal.comedi.comedi_backend import ComediSettings
from hal.comedi.comedi_rig import ComediRig
from hal.rig import RigError

SAFE_V = 1.25
FILL_V = 10.0
READ, CONFIGURE = "comedi_do_insnlist", "comedi_do_insn"
Make = Callable[..., ComediRig]
safe = pytest.approx(SAFE_V, abs=AO_STEP_V)


@pytest.fixture
def card() -> Iterator[Card]:
    yield from use_card(here_behind_comedi())


@pytest.fixture
def make(card: Card) -> Iterator[Make]:
    def make_one(**changes: object) -> ComediRig:
        return ComediRig(ComediSettings.model_validate(changes), safe_output_v=SAFE_V)

    yield from make_and_close(card, make_one)


# --- opening -----------------------------------------------------------------------------


@pytest.mark.parametrize("after", range(13))
def test_an_encoder_that_cannot_be_set_up_is_reported_at_the_safe_voltage(card, make, after):
    card.registers.ao_v[0] = 8.0  # left there by a run that was killed
    card.fail(CONFIGURE, -errno.EINVAL, after=after, times=1)
    rig = make()
    with pytest.raises(RigError, match=r"setting up (PFI|counter)") as caught:
        rig.open()
    assert caught.value.code == errno.EINVAL
    assert "PFI lines in section comedi" in caught.value.fix
    assert card.output_v == safe
    rig.open()  # nothing of the first try is still locked


@pytest.mark.parametrize(("filter_ns", "filter_s"), [(0, 0.0), (6425, 6.425e-6)])
def test_the_encoder_filter_is_that_of_the_rig_file(card, make, filter_ns, filter_s):
    make(encoder_filter_ns=filter_ns).open()
    assert card.registers.counter_filter_s == filter_s


@pytest.mark.parametrize(
    ("a", "b", "counted"), [(8, 10, 2000), (10, 8, -2000), (2, 3, 0), (8, 3, 0), (15, 10, 0)]
)
def test_the_encoder_counts_on_the_lines_that_it_is_wired_to(card, make, a, b, counted):
    card.stop_time()
    rig = make(encoder_a_pfi=a, encoder_b_pfi=b)
    rig.open()
    rig.write(FILL_V)
    card.set_time_ns(300 * MS)
    counts = rig.read().encoder_counts
    assert (abs(counts) > 2000) == (counted != 0)
    assert counts * counted >= 0


def test_once_opened_it_says_which_library_card_and_calibration_it_uses(card, make):
    rig = make()
    assert "library" not in rig.describe().extra
    rig.open()
    extra = rig.describe().extra
    assert extra["library"] == str(library(COMEDI_SONAME))
    assert extra["driver_version"] == "0.7.76"
    assert extra["product_type"] == "pci-6221"
    assert extra["calibrated_by"] == str(card.calibration_path)
    assert extra["input_volts_coefficients"] == [0.0, 10.0 / 65536.0]


def test_no_child_process_inherits_the_device_file(make):
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


def test_a_calibrated_card_reads_and_writes_true_volts(card, make):
    off_by_percents(card)
    card.calibrate()
    rig = make()
    rig.open()
    assert card.output_v == safe
    assert rig.read().pressure_v == pytest.approx(0.215, abs=3e-4)
    for volts in (0.0, 0.3, 4.9, 9.6):
        assert rig.write(volts) == pytest.approx(volts, abs=AO_STEP_V / 2)
        assert card.output_v == pytest.approx(volts, abs=1.5 * AO_STEP_V)


def test_a_voltage_beyond_the_last_code_puts_out_the_last_code(card, make):
    """The kernel refuses a code that the converter does not have."""
    off_by_percents(card)
    card.calibrate()
    rig = make()
    rig.open()
    rig.write(10.0)
    assert card.output_v == pytest.approx(9.7 - 0.02, abs=1e-3)


def test_a_nonlinear_polynomial_is_applied(card, make):
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
def test_without_a_calibration_the_rig_says_what_to_run_at_the_safe_voltage(card, make, parts):
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


def test_make_safe_needs_no_calibration(card, make):
    card.calibration_path.unlink()
    card.registers.ao_v[0] = 8.0
    rig = make()
    rig.make_safe()
    assert rig.safe_failure is None
    assert card.output_v == pytest.approx(SAFE_V, abs=5 * AO_STEP_V)


def test_an_uncalibrated_card_is_used_only_where_the_rig_file_says_so(card, make):
    off_by_percents(card)
    card.calibration_path.unlink()
    rig = make(calibration_file="none")
    rig.open()
    assert rig.describe().extra["calibrated_by"] == "none"
    assert rig.read().pressure_v == pytest.approx(0.215 * 0.94 + 0.011, abs=1e-3)


def test_a_calibration_file_that_the_rig_file_names_is_read(card, make):
    named = card.calibration_path.with_name("mine")
    card.calibration_path.rename(named)
    rig = make(calibration_file=str(named))
    rig.open()
    assert rig.describe().extra["calibrated_by"] == str(named)


# --- when the card refuses ---------------------------------------------------------------


def test_where_both_are_read_singly_an_error_names_the_one_that_failed(card, make):
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
def test_a_device_file_that_cannot_be_opened_says_why(card, make, code, fix):
    card.fail("comedi_open", -code)
    rig = make()
    with pytest.raises(RigError, match="opening /dev/comedi0") as caught:
        rig.open()
    assert caught.value.code == code
    assert fix in caught.value.fix


def test_a_device_file_that_is_not_there_says_which_driver_makes_it(make):
    with pytest.raises(RigError, match="modprobe ni_pcimio") as caught:
        make(device="/dev/comedi7").open()
    assert caught.value.code == errno.ENOENT


def test_a_channel_that_the_card_does_not_have_is_named(card, make):
    with pytest.raises(RigError, match="analog input 16 is not one of the card's 16"):
        make(pressure_channel="ai16").open()
    assert card.output_v == safe


def test_without_the_library_the_error_says_what_to_install(make, monkeypatch):
    monkeypatch.setattr(libcomedi, "SONAME", "libcomedi-that-is-not-there.so")
    monkeypatch.setattr(libcomedi, "load_library", libcomedi.load_library.__wrapped__)
    rig = make()
    with pytest.raises(RigError, match="apt install libcomedi0"):
        rig.open()
    rig.make_safe()
    assert "apt install libcomedi0" in str(rig.safe_failure)


def test_a_library_without_the_functions_that_are_needed_is_too_old(make, monkeypatch):
    monkeypatch.setattr(libcomedi, "SONAME", "libm.so.6")
    monkeypatch.setattr(libcomedi, "load_library", libcomedi.load_library.__wrapped__)
    with pytest.raises(RigError, match="libcomedi is too old"):
        make().open()
