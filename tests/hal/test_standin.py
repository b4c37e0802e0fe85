"""The stand-in driver agrees with NI's package and with the simulated plant."""

from __future__ import annotations

import ctypes
import os
import re
from collections.abc import Iterator

import numpy as np
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


def declared() -> dict[str, list[str]]:
    """Return the C types of each exported function's arguments; `...` is left out."""
    found = re.findall(r"EXPORT int32_t (DAQmx\w+)\(([^)]*)\)", SOURCE)
    return {
        name: [c_type(argument) for argument in arguments.split(",") if "..." not in argument]
        for name, arguments in found
    }


def c_type(argument: str) -> str:
    return re.sub(r"\w+$", "", " ".join(argument.split())).strip()


def expected_types() -> dict[str, list[type]]:
    """What the package may pass where the stand-in has declared a C type."""
    from nidaqmx._lib import CtypesByteString, c_bool32

    pointer = ctypes.POINTER
    return {
        "TaskHandle": [ctypes.c_void_p],
        "TaskHandle *": [pointer(ctypes.c_void_p)],
        "const char *": [CtypesByteString],
        "char *": [ctypes.c_char_p],
        "int32_t": [ctypes.c_int],
        "uint64_t": [ctypes.c_ulonglong],
        "uint32_t": [ctypes.c_uint],
        "uint32_t *": [pointer(ctypes.c_uint)],
        "bool32": [c_bool32],
        "bool32 *": [pointer(c_bool32)],
        "double": [ctypes.c_double],
        "double *": [pointer(ctypes.c_double)],
        "float64 *": [np.ctypeslib.ndpointer(dtype=np.float64, flags=("C", "W"))],
        "int32_t *": [pointer(ctypes.c_int)],
    }


def call_everything() -> None:
    """Call each function of the stand-in through the package."""
    from nidaqmx import Task
    from nidaqmx.constants import AcquisitionType, LengthUnits, TaskMode, WaitMode
    from nidaqmx.errors import DaqError, DaqWarning
    from nidaqmx.stream_readers import AnalogSingleChannelReader, CounterReader
    from nidaqmx.stream_writers import AnalogSingleChannelWriter
    from nidaqmx.system import Device, System

    assert System.local().driver_version
    device = Device("Dev1")
    assert device.product_type == "PCI-6221"
    device.reset_device()
    with Task("out") as out, Task("volts") as volts, Task("counts") as counts:
        out.ao_channels.add_ao_voltage_chan("Dev1/ao0")
        out.control(TaskMode.TASK_VERIFY)
        assert out.is_task_done()
        here().fail("DAQmxStartTask", 200010, times=1)
        with pytest.warns(DaqWarning):
            out.start()
        AnalogSingleChannelWriter(out.out_stream).write_one_sample(1.0)
        volts.ai_channels.add_ai_voltage_chan("Dev1/ai0")
        volts.in_stream.wait_mode = WaitMode.SLEEP
        assert volts.in_stream.wait_mode == WaitMode.SLEEP
        AnalogSingleChannelReader(volts.in_stream).read_one_sample()
        volts.timing.cfg_samp_clk_timing(1e3, samps_per_chan=3)
        volts.start()
        AnalogSingleChannelReader(volts.in_stream).read_many_sample(np.zeros(3), 3)
        volts.stop()
        volts.timing.cfg_samp_clk_timing(1e3, sample_mode=AcquisitionType.HW_TIMED_SINGLE_POINT)
        channel = counts.ci_channels.add_ci_lin_encoder_chan("Dev1/ctr0", units=LengthUnits.TICKS)
        channel.ci_encoder_a_input_dig_fltr_enable = False
        assert channel.physical_channel.name == "Dev1/ctr0"
        reader = CounterReader(counts.in_stream)
        assert reader.read_one_sample_uint32() == reader.read_one_sample_double() == 0
        with pytest.raises(DaqError, match="-200077"):
            channel.ci_encoder_a_input_dig_fltr_min_pulse_width = 1e-6
        out.stop()


def test_its_signatures_are_those_the_package_calls(
    card: Card, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The package says its environment once in a process: an earlier test may have heard it.
    monkeypatch.setattr("nidaqmx._library_interpreter._was_runtime_environment_set", None)
    call_everything()
    from nidaqmx._lib import lib_importer

    types = expected_types()
    for name, arguments in declared().items():
        called_with = getattr(lib_importer.windll, name).argtypes
        assert called_with is not None, f"{name} was not called"
        assert len(called_with) == len(arguments), name
        for passed, argument in zip(called_with, arguments, strict=True):
            assert issubclass(passed, tuple(types[argument])), f"{name}: {passed} for {argument}"


def test_its_driver_is_hidden_from_processes_that_do_not_request_it(card: Card) -> None:
    assert "standin" not in os.environ.get("LD_LIBRARY_PATH", "")
    assert "STANDIN_DEVICE" not in os.environ
