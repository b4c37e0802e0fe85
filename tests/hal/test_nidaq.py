"""The card's backend over the real nidaqmx package and a stand-in driver, held to NI's numbers."""

import re
from collections.abc import Callable, Iterator

import pytest
from standin.standin import HERE, Card, here, library
from support.card_rigs import READ_COUNT, READ_VOLTS, WRITE, make_and_close, use_card
from support.runs import AO_STEP_V, MS

from hal.nidaq.card_settings import NidaqSettings
from hal.rig import RigError

SAFE_V = 1.25
FILL_V = 10.0
safe = pytest.approx(SAFE_V, abs=AO_STEP_V)


@pytest.fixture
def card() -> Iterator[Card]:
    yield from use_card(here())


@pytest.fixture
def make(card: Card) -> Iterator[Callable[..., object]]:
    from hal.nidaq.nidaq_rig import NidaqRig

    yield from make_and_close(
        card, lambda **changes: NidaqRig(NidaqSettings(**changes), safe_output_v=SAFE_V)
    )


# --- opening -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "function", ["DAQmxCreateAIVoltageChan", "DAQmxCreateCILinEncoderChan", "DAQmxSetChanAttribute"]
)
def test_an_input_that_cannot_be_had_is_found_out_at_the_safe_voltage(card, make, function):
    card.registers.ao_v[0] = 8.0  # left there by a run that was killed
    card.fail(function, -200170, times=1)
    rig = make()
    with pytest.raises(RigError, match="no such channel") as caught:
        rig.open()
    assert caught.value.code == -200170
    assert card.output_v == safe
    rig.open()  # nothing is left reserved, and no task of the first try


def test_the_encoder_filter_can_be_off_but_never_one_that_loses_counts(card, make):
    make(encoder_filter_ns=0).open()
    assert card.registers.counter_filter_s == 0.0
    with pytest.raises(ValueError, match="encoder_filter_ns"):
        NidaqSettings(encoder_filter_ns=2_550_000)  # type: ignore[arg-type]


def test_once_opened_it_says_which_library_and_card_it_drives(make):
    rig = make()
    assert "library" not in rig.describe().extra
    rig.open()
    described = rig.describe().extra
    assert described["library"] == str(library())
    assert described["driver_version"] == "26.8.0"
    assert described["product_type"] == "PCI-6221"
    assert described["serial_number"] == "DECAF"


# --- reading -----------------------------------------------------------------------------


def test_each_reading_has_the_time_at_which_it_was_begun(card, make):
    rig = make()
    rig.open()
    card.fail(READ_COUNT, hang_s=0.003)
    sample = rig.read()
    assert sample.pressure_t_ns - sample.encoder_t_ns >= 3 * MS


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
    card, make, has_37_pins, wired, settings, sign
):
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


def test_a_terminal_that_the_card_lacks_is_refused_with_those_it_has(card, make):
    card.registers.has_37_pins = 1
    with pytest.raises(RigError, match=r"AInputTerm.*/Dev1/PFI8.*PFI0 to PFI7") as caught:
        make(encoder_a_pfi=8, encoder_b_pfi=10).open()
    assert caught.value.code == -200077
    assert card.output_v == safe


# --- writing -----------------------------------------------------------------------------


def test_the_driver_guards_the_same_range_as_the_backend(card, make):
    rig = make(output_high_v=6.0)
    rig.open()
    with pytest.raises(Exception, match="-200561"):
        rig._wired.write_v(6.5, 0.02)
    assert card.output_v == safe


# --- when the driver says no -------------------------------------------------------------


def test_a_refused_value_is_told_whole_with_what_can_be_selected(make, monkeypatch):
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


def test_no_line_of_the_driver_s_message_is_lost_but_task_and_status():
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


def test_without_a_driver_the_error_says_what_to_install(make, monkeypatch):
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


def test_warnings_of_the_driver_are_counted_and_not_printed(card, make, capsys):
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


# --- making safe -------------------------------------------------------------------------


def test_make_safe_takes_back_an_output_that_somebody_has_reset(card, make):
    from nidaqmx.system import Device

    rig = make()
    rig.open()
    rig.write(9.0)
    Device("Dev1").reset_device()
    rig.make_safe()
    assert card.output_v == safe
    assert rig.safe_failure is None


# --- names and numbers -------------------------------------------------------------------

SOURCE = (HERE / "daqmx.c").read_text()


def enumerated(marker: str) -> dict[str, int]:
    """Return the enum of the source that follows a comment."""
    body = SOURCE[SOURCE.index(marker) :]
    body = body[: body.index("};")]
    return {name: int(value) for name, value in re.findall(r"(\w+) = (-?\d+),", body)}


def test_its_error_numbers_are_ni_s():
    from nidaqmx.error_codes import DAQmxErrors

    numbers = enumerated("/* Names as in nidaqmx.error_codes.DAQmxErrors. */")
    assert len(numbers) > 10
    assert {name: DAQmxErrors[name].value for name in numbers} == numbers


def test_its_constants_are_ni_s():
    from nidaqmx import constants

    numbers = enumerated("/* Names as in nidaqmx.constants")
    assert len(numbers) > 10
    for name, number in numbers.items():
        kind, _, member = name.partition("__")
        assert getattr(constants, kind)[member].value == number, name


def test_the_fixes_of_the_backend_are_for_errors_that_exist():
    from nidaqmx.error_codes import DAQmxErrors

    from hal.nidaq.card_settings import FIXES

    assert set(FIXES) <= {error.value for error in DAQmxErrors}
