"""The stand-in driver agrees with NI's package and with the simulated plant."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator

import pytest
from standin.standin import HERE, Card, advance, here
from support.card_rigs import use_card

from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.simulated import SimulatedPlant

SOURCE = (HERE / "daqmx.c").read_text()


@pytest.fixture
def card() -> Iterator[Card]:
    yield from use_card(here())


def test_its_muscle_is_that_of_the_simulation(card: Card) -> None:
    plant = SimulatedPlant(plant_parameters(PlantSettings()))
    state = (0.0, 0.0, 101.3e3)
    for tick in range(1000):
        command_v = (5.0, -3.0, 0.0, 1.2, -5.0)[tick // 70 % 5]
        plant.advance(command_v, 1e-3)
        state = tuple(advance(state, command_v, 1e-3))
        assert state[0] == pytest.approx(plant.position_m, abs=1e-9)
        assert state[2] == pytest.approx(plant.pressure_pa, abs=1e-3)
    assert max(abs(plant.state.velocity_m_per_s), plant.position_m) > 0


def test_its_muscle_rests_until_it_is_read(card: Card) -> None:
    """A decay to the smallest floats must not end in NaN."""
    state = (0.008, 0.0, 250e3)
    for _ in range(60):
        state = tuple(advance(state, -4.375, 1.0))
    assert state == pytest.approx((0.0, 0.0, 101.3e3))


# --- names and numbers -------------------------------------------------------------------


def enumerated(marker: str) -> dict[str, int]:
    """Return the enum of the source that follows a comment."""
    body = SOURCE[SOURCE.index(marker) :]
    body = body[: body.index("};")]
    return {name: int(value) for name, value in re.findall(r"(\w+) = (-?\d+),", body)}


def test_its_error_numbers_are_ni_s() -> None:
    from nidaqmx.error_codes import DAQmxErrors

    numbers = enumerated("/* Names as in nidaqmx.error_codes.DAQmxErrors. */")
    assert len(numbers) > 10
    assert {name: DAQmxErrors[name].value for name in numbers} == numbers


def test_its_constants_are_ni_s() -> None:
    from nidaqmx import constants

    numbers = enumerated("/* Names as in nidaqmx.constants")
    assert len(numbers) > 10
    for name, number in numbers.items():
        kind, _, member = name.partition("__")
        assert getattr(constants, kind)[member].value == number, name


def test_the_fixes_of_the_backend_are_for_errors_that_exist() -> None:
    from nidaqmx.error_codes import DAQmxErrors

    from hal.nidaq.card_settings import FIXES

    assert set(FIXES) <= {error.value for error in DAQmxErrors}


# --- signatures --------------------------------------------------------------------------


def test_its_driver_is_hidden_from_processes_that_do_not_request_it(card: Card) -> None:
    assert "standin" not in os.environ.get("LD_LIBRARY_PATH", "")
    assert "STANDIN_DEVICE" not in os.environ
