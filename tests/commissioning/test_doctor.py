"""`pamctl doctor`: each fault that a rig or a PC can have is found, named, and told how to mend."""

import json
import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from standin.standin import Card, here
from support.benches import Reversed, Unsupplied, bench_of, card_rig
from support.card_rigs import READ_VOLTS, use_card
from support.command_line import run_pamctl, run_process, start_process
from support.patience import PATIENCE_S, await_true
from support.runs import AO_STEP_V, parts, run_settings

from hal.backend import report_check
from hal.faulty import FaultSettings
from hal.nidaq.nidaq_backend import (
    check_device_nodes,
    examine_card,
    examine_card_clock,
    examine_output,
    judge_release,
)
from hal.problem import Problem, worst_level
from hal.sim import peek_v
from pamctl.commissioning.bench import Bench, LimitError
from pamctl.commissioning.pc_checks import (
    CallCosts,
    WakeUps,
    check_governor,
    check_log_disk,
    check_processors,
    check_shared_memory,
    judge_calls,
    judge_permissions,
    judge_rate,
    judge_wake_ups,
    measure_calls,
    summarise_latencies,
)
from pamctl.commissioning.rig_checks import (
    examine_actuation,
    judge_hand_motion,
    judge_sensors,
    make_probe_request,
    measure_at_rest,
)
from pamctl.plant.model import plant_parameters
from pamctl.processes.backends import SHARED_MEMORY, ao_path
from pamctl.processes.interrupts import Interrupts, SignalInterrupt
from pamctl.realtime.scheduling import Preparation, PreparationStep
from pamctl.settings.resolve import resolve

PAMCTL = str(Path(sys.executable).with_name("pamctl"))


def index_by_name(findings: list[Problem]) -> dict[str, Problem]:
    """Return findings by name, each of them once."""
    assert len({finding.key for finding in findings}) == len(findings)
    return {finding.key: finding for finding in findings}


def examine_bench(bench: Bench, *, actuate: bool = True) -> dict[str, Problem]:
    findings = list(judge_sensors(bench, measure_at_rest(bench)))
    return index_by_name([*findings, *(examine_actuation(bench) if actuate else ())])


# --- the rig, simulated ------------------------------------------------------------------


def simulated(*faults: FaultSettings, plant: object = None, **homing: object) -> Bench:
    """Return a bench over the simulated rig on a virtual clock."""
    settings = run_settings()
    made = parts(settings, faults)
    if plant is not None:
        made.rig._plant = plant
    return bench_of(settings, made.whole, made.clock)


def fault(kind: str, size: float = 0.0) -> FaultSettings:
    return FaultSettings(kind=kind, from_tick=0, size=size)  # type: ignore[arg-type]


def test_a_sound_rig_has_nothing_but_ok():
    found = examine_bench(simulated())
    assert {finding.level for finding in found.values()} == {"ok"}
    assert set(found) == {
        "sensor.voltage",
        "sensor.noise",
        "encoder.rest",
        "valve.sign",
        "encoder.alive",
    }


def test_a_hint_names_the_backend_s_own_keys_and_none_where_there_are_none():
    made = parts(run_settings(), [fault("broken_wire")])
    on_card = examine_bench(bench_of(resolve(rig="pci6221"), made.whole, made.clock), actuate=False)
    fix = on_card["sensor.voltage"].fix
    assert fix.endswith("; check nidaq.pressure_channel and nidaq.terminal in the rig file")
    without = examine_bench(simulated(fault("broken_wire")), actuate=False)
    assert "nidaq" not in "".join(finding.fix for finding in without.values())


def test_an_encoder_that_stands_while_the_muscle_moves_is_found_unplugged():
    found = examine_bench(simulated(fault("stuck_encoder")))
    assert found["encoder.rest"].level == "ok"  # at rest nobody can tell
    assert found["valve.sign"].level == "ok"
    assert found["encoder.alive"].level == "fault"
    assert "unplugged" in found["encoder.alive"].fix


def test_a_reversed_encoder_is_told_which_sign_to_set():
    found = examine_bench(simulated(fault("reversed_encoder")))
    assert found["encoder.alive"].level == "fault"
    assert "encoder_sign to -1" in found["encoder.alive"].fix


def test_a_reversed_valve_shows_at_the_safe_voltage_and_by_its_pulses():
    plant = Reversed(plant_parameters(run_settings().plant))
    found = examine_bench(simulated(plant=plant))
    assert found["sensor.voltage"].level == "fault"
    assert "reversed" in found["sensor.voltage"].fix
    assert found["valve.sign"].level == "fault"
    assert "THE VALVE IS REVERSED" in found["valve.sign"].fix
    assert found["encoder.alive"].level == "ok"


def test_without_supply_nothing_moves_and_the_valve_is_blamed_before_the_encoder():
    shut = Unsupplied(plant_parameters(run_settings().plant))
    found = examine_bench(simulated(plant=shut))
    assert found["valve.sign"].level == "fault"
    assert "supply" in found["valve.sign"].fix
    assert found["encoder.alive"].level == "warning"


def test_a_sensor_that_breaks_during_a_pulse_stops_it_by_the_limits():
    late = FaultSettings(kind="broken_wire", from_tick=400)
    settings = run_settings()
    made = parts(settings, [late])
    bench = bench_of(settings, made.whole, made.clock)
    found = index_by_name(list(examine_actuation(bench)))
    assert found["valve.sign"].level == "fault"
    assert found["valve.sign"].message.startswith("stopped: the pressure sensor gives 0.000 V")


def test_a_bench_keeps_the_limits_of_pressure_and_travel():
    for override, complaint in [
        ("rig.limits.pressure_pa=150e3", "above limits.pressure_pa"),
        ("rig.limits.stroke_high_mm=3", "has moved"),
    ]:
        settings = run_settings(override)
        made = parts(settings)
        bench = bench_of(settings, made.whole, made.clock)
        with pytest.raises(LimitError, match=complaint):
            bench.hold(5.0, 1.0)


def test_a_loose_encoder_line_is_a_fault_and_a_creeping_one_a_warning():
    jumping = FaultSettings(kind="encoder_jump", from_tick=1200, ticks=1, size=900)
    assert examine_bench(simulated(jumping), actuate=False)["encoder.rest"].level == "fault"
    creeping = FaultSettings(kind="encoder_jump", from_tick=1200, size=5)
    assert examine_bench(simulated(creeping), actuate=False)["encoder.rest"].level == "warning"


def test_a_motion_by_hand_proves_the_encoder_alive_or_not():
    bench = simulated()
    assert judge_hand_motion(bench, 900).level == "ok"
    assert judge_hand_motion(bench, 0).level == "fault"


# --- the card, over the stand-in ---------------------------------------------------------


@pytest.fixture
def card() -> Iterator[Card]:
    yield from use_card(here())


@pytest.fixture
def wired(card: Card) -> Iterator[Callable[[], Bench]]:
    """Make a bench over the card on a virtual clock; it is closed at the end."""
    settings = resolve(rig="pci6221")
    rig, clock = card_rig(card, settings)
    yield lambda: bench_of(settings, rig, clock)
    card.mend()
    rig.close()


def cards(*overrides: str) -> dict[str, Problem]:
    settings = resolve(rig="pci6221", overrides=overrides)
    return index_by_name(list(examine_card(make_probe_request(settings))))


def test_a_sound_card_is_named_with_its_driver_and_writes_nothing_to_its_output(card):
    card.registers.ao_v[0] = 3.0
    found = cards()
    assert found.pop("card.kernel_driver").level == "warning"  # of this PC, which has no card
    assert worst_level(found.values()) == "ok"
    assert "NI-DAQmx 26.8.0" in found["card.driver"].message
    assert "PCI-6221, serial DECAF, bus PCI" in found["card.device"].message
    assert found["card.input_range"].data["step_pa"] == pytest.approx(23.7, abs=0.1)
    assert found["timing.on_demand"].level == "ok"
    assert card.registers.ao_v[0] == 3.0
    assert card.registers.ao_writes == 0


@pytest.mark.parametrize(
    ("override", "name", "wanted"),
    [
        ("rig.nidaq.device=Dev7", "card.device", "Dev7"),
        ("rig.nidaq.pressure_channel=ai40", "card.channels", "nidaq.pressure_channel"),
        ("rig.nidaq.input_high_v=1.0", "card.input_range", "0.1 to 4.8 V"),
        ("rig.nidaq.input_low_v=0.15", "card.input_range", "0.1 to 4.8 V"),
    ],
)
def test_what_the_rig_file_gets_wrong_about_the_card_is_found(card, override, name, wanted):
    found = cards(override)
    assert found[name].level == "fault"
    assert wanted in found[name].wanted
    assert found[name].fix


HOLD = """
import time
from nidaqmx import Task
task = Task("holder")
task.ao_channels.add_ao_voltage_chan("Dev1/ao0")
task.start()
print("holding", flush=True)
time.sleep(60)
"""


def test_a_part_of_the_card_that_another_program_holds_says_how_to_find_the_program(card):
    with subprocess.Popen(
        [sys.executable, "-c", HOLD], env=card.environment(), stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "holding\n"
        found = cards()["card.reservations"]
        holder.kill()
    assert found.level == "fault"
    assert found.data["channels"] == ["ao0"]
    assert "grep -l libnidaqmx /proc" in found.fix


def test_the_card_s_clock_is_tried_with_the_safe_voltage_on_the_output(card):
    card.registers.ao_v[0] = 3.0
    settings = resolve(rig="pci6221", overrides=["rig.safe_volts=1.25"])
    found = examine_card_clock(make_probe_request(settings))
    assert (found.key, found.level) == ("timing.hardware", "ok")
    assert "100 edges" in found.message or "missed" in found.message  # a busy PC misses some
    assert max(abs(volts - 1.25) for volts in card.written_v) < AO_STEP_V


@pytest.mark.parametrize(("timing", "level"), [("on_demand", "ok"), ("hardware_timed", "fault")])
def test_a_card_whose_clock_cannot_pace_says_why_and_it_matters_where_the_file_asks_for_it(
    card, timing, level
):
    card.fail("DAQmxCfgSampClkTiming", -200077)
    settings = resolve(rig="pci6221", overrides=[f"rig.nidaq.timing={timing}"])
    found = examine_card_clock(make_probe_request(settings))
    assert found.level == level
    assert "-200077" in found.message
    assert card.output_v == pytest.approx(0.0, abs=AO_STEP_V)


@pytest.mark.parametrize("keeps", [0, 1])
def test_what_the_driver_does_with_a_killed_process_s_output_is_measured(card, monkeypatch, keeps):
    card.registers.ao_v[0] = 3.0
    card.registers.keeps_dead_owners = keeps
    for key in ("LD_LIBRARY_PATH", "STANDIN_DEVICE"):
        monkeypatch.setenv(key, card.environment()[key])
    (found,) = examine_output(make_probe_request(resolve(rig="pci6221")))
    assert found.key == "card.release"
    assert card.registers.ao_writes == 0
    if keeps:
        assert found.level == "fault"
        assert "reset_device" in found.fix
        assert "--backend comedi" in found.fix
    else:
        assert found.level != "fault"
        assert found.data["free_after_s"] < 1.0


def test_a_slow_release_is_a_warning_and_one_that_could_not_be_measured_too(card):
    assert judge_release(0.02).level == "ok"
    assert judge_release(0.4).level == "warning"
    # The child finds no driver.
    (found,) = examine_output(make_probe_request(resolve(rig="pci6221")))
    assert found.level == "warning"
    assert found.message.startswith("not measured")


def test_the_card_s_own_rig_is_found_sound_and_each_of_its_faults(card, wired):
    assert {finding.level for finding in examine_bench(wired()).values()} == {"ok"}


@pytest.mark.parametrize("drift_v_per_s", [-0.03, 0.03])
def test_an_open_input_that_drifts_is_suspected_to_lack_its_pull_down(card, wired, drift_v_per_s):
    bench = wired()
    card.registers.pull_down_is_missing = card.registers.wire_is_broken = 1
    card.registers.open_v = 0.25
    card.registers.open_drift_v_per_s = drift_v_per_s
    found = examine_bench(bench, actuate=False)
    assert found["sensor.noise"].level == "warning"
    assert "mV while the muscle stands still" in found["sensor.noise"].message
    assert "pull-down of 100 kOhm" in found["sensor.noise"].fix
    assert "nidaq.pressure_channel" in found["sensor.noise"].fix


def test_an_open_input_that_stands_still_is_found_only_by_moving_the_muscle(card, wired):
    """Nothing at rest tells it from a sound sensor: plausible, quiet, steady."""
    bench = wired()
    card.registers.pull_down_is_missing = card.registers.wire_is_broken = 1
    card.registers.open_v = 0.25
    found = examine_bench(bench)
    assert {found[name].level for name in ("sensor.voltage", "sensor.noise")} == {"ok"}
    assert found["valve.sign"].level == "fault"
    assert "pull-down" in found["valve.sign"].fix


@pytest.mark.parametrize("has_37_pins", [0, 1])
def test_terminals_that_the_37_pin_card_lacks_are_a_fault(card, has_37_pins):
    card.registers.has_37_pins = has_37_pins
    lines = ["rig.nidaq.encoder_a_pfi=8", "rig.nidaq.encoder_b_pfi=10"]
    found = cards(*lines)["card.channels"]
    assert found.level == ("fault" if has_37_pins else "ok")
    if has_37_pins:
        assert "nidaq.encoder_b_pfi" in found.fix
        assert "PFI7" in found.wanted
        assert "PFI8" not in found.wanted


def test_slow_calls_of_the_driver_are_found_and_the_slow_one_is_named(card, wired):
    from hal.nidaq.nidaq_rig import NidaqRig

    rig = NidaqRig(resolve(rig="pci6221").rig.nidaq, safe_output_v=0.0)  # type: ignore[union-attr]
    rig.open()
    try:
        card.fail(READ_VOLTS, hang_s=0.004)
        found = index_by_name(list(judge_calls(measure_calls(rig, 0.0, calls=40), 1e-3)))
    finally:
        card.mend()
        rig.close()
    assert found["latency.pressure"].level == "fault"
    assert found["latency.pressure"].data["p50_us"] > 4000
    assert found["latency.encoder"].data["p50_us"] < 2000
    assert found["latency.output"].data["p50_us"] < 2000


def test_a_rate_that_the_calls_do_not_allow_is_a_fault_with_the_rate_that_they_do():
    calls = CallCosts(*[summarise_latencies([50_000] * 100)] * 3)
    held = judge_rate(calls, 5e-6, 1e-3)
    assert held.level == "ok"
    assert "a tick takes about 180 us, 150 us of them in the rig's calls (p99)" in held.message
    assert held.data["held_hz"] == pytest.approx(0.5 / 180e-6)
    assert judge_rate(calls, 5e-6, 250e-6).level == "warning"
    lost = judge_rate(calls, 5e-6, 100e-6)
    assert lost.level == "fault"
    assert "up to 2778 Hz can be held" in lost.message


# --- the PC ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("late_us", "missed", "level"),
    [(3, 0, "ok"), (3, 1, "warning"), (3, 50, "fault"), (200, 0, "warning"), (700, 0, "fault")],
)
def test_wake_ups_are_judged_against_the_period(late_us, missed, level):
    found = judge_wake_ups(
        "pc.wakeup", WakeUps(summarise_latencies([late_us * 1000] * 1000), missed), 1e-3, ""
    )
    assert found.level == level


def test_every_right_that_was_refused_is_a_warning_with_its_fix():
    from contextlib import ExitStack

    steps = (
        PreparationStep("gc", True, "objects frozen"),
        PreparationStep("mlock", True, "all memory"),
        PreparationStep("fifo", False, "Operation not permitted; RLIMIT_RTPRIO is 0: put ..."),
    )
    found = index_by_name(list(judge_permissions(Preparation("auto", steps, ExitStack()))))
    assert set(found) == {"pc.mlock", "pc.fifo"}
    assert found["pc.fifo"].level == "warning"
    assert found["pc.fifo"].message == "refused: Operation not permitted"
    assert found["pc.fifo"].fix.startswith("RLIMIT_RTPRIO")


def test_one_processor_and_a_saving_governor_are_warnings(tmp_path):
    assert check_processors(1).level == "warning"
    assert check_processors(2).level == "ok"
    assert check_governor(tmp_path).level == "ok"
    for number, name in enumerate(["performance", "powersave"]):
        place = tmp_path / f"cpu{number}" / "cpufreq"
        place.mkdir(parents=True)
        (place / "scaling_governor").write_text(f"{name}\n")
    assert check_governor(tmp_path).level == "warning"
    assert "cpupower" in check_governor(tmp_path).fix


def test_places_that_cannot_be_written_are_faults(tmp_path):
    assert check_shared_memory(tmp_path / "no-shm").level == "fault"
    assert check_shared_memory(SHARED_MEMORY).data["free_bytes"]
    assert check_log_disk(tmp_path / "not" / "yet" / "there").level == "ok"


def test_device_nodes_are_judged_by_what_this_user_may(tmp_path):
    assert list(check_device_nodes(tmp_path)) == []
    (tmp_path / "nipalk").touch()
    assert [finding.level for finding in check_device_nodes(tmp_path)] == ["ok"]
    if os.geteuid():
        (tmp_path / "nipalk").chmod(0)
        assert [finding.level for finding in check_device_nodes(tmp_path)] == ["fault"]


# --- the command -------------------------------------------------------------------------


def device() -> str:
    return f"sim-doctor-{os.getpid()}"


def own_card(place: Path) -> Card:
    """Return a card that this process does not drive, under a name that nobody else locks."""
    return Card(place / "registers", f"Dev{os.getpid()}doctor")


def command(*arguments: str, backend: str = "sim") -> list[str]:
    which = ["--set", f"rig.sim.device={device()}"] if backend == "sim" else []
    return [PAMCTL, "doctor", "--backend", backend, "--rt-seconds", "0.1", *which, *arguments]


def run(
    *arguments: str, cwd: Path, backend: str = "sim", env: dict[str, str] | None = None
) -> tuple[int, dict[str, Problem]]:
    done = run_process(command(*arguments, "--json", backend=backend), cwd=cwd, env=env)
    told = json.loads(done.stdout)
    assert told["exit_code"] == done.returncode, done.stderr
    assert "Traceback" not in done.stderr
    return done.returncode, index_by_name([report_check(**finding) for finding in told["findings"]])


def test_without_a_driver_the_doctor_says_what_to_install_and_exits_with_3(tmp_path):
    without = {k: v for k, v in os.environ.items() if k not in {"LD_LIBRARY_PATH", "LIBRARY_PATH"}}
    code, found = run(cwd=tmp_path, backend="nidaq", env=without)
    assert code == 3
    assert found["card.driver"].level == "fault"
    assert "install NI-DAQmx" in found["card.driver"].fix
    assert {"pc.kernel", "pc.fifo", "pc.wakeup"} <= set(found)


@pytest.mark.long
def test_the_whole_examination_of_a_card_passes_and_ends_at_the_safe_voltage(tmp_path):
    here()  # for the compiler
    own = own_card(tmp_path)
    named_so = ["--set", f"rig.nidaq.device={own.name}"]
    environment = dict(own.environment())
    code, found = run("--actuate", *named_so, cwd=tmp_path, backend="nidaq", env=environment)
    faults = {
        name for name, one in found.items() if one.level == "fault" and not name.startswith("pc.")
    }
    # A busy machine may be slow; nothing else may be wrong.
    assert {name for name in faults if not name.startswith("latency.")} == set()
    assert found["latency.pressure"].data["samples"] > 100
    assert found["timing.on_demand"].level == "ok"
    assert "timing.hardware" in found
    assert found["card.release"].data["free_after_s"] < 1.0
    assert found["valve.sign"].level == found["encoder.alive"].level == "ok"
    assert code in (0, 3)
    assert max(own.written_v) <= 10.0
    assert own.output_v == pytest.approx(0.0, abs=AO_STEP_V)


@pytest.mark.long
def test_at_a_terminal_the_carriage_is_moved_by_hand_to_see_the_encoder_alive(tmp_path):
    here()  # for the compiler
    own = own_card(tmp_path)
    keyboard, terminal = pty.openpty()
    with start_process(
        command("--set", f"rig.nidaq.device={own.name}", backend="nidaq"),
        cwd=tmp_path,
        env=dict(own.environment()),
        stdin=terminal,
    ) as process:
        assert process.stderr is not None
        asked = ""
        while "[Enter" not in asked:
            letter = process.stderr.read(1)
            assert letter, asked
            asked += letter
        own.registers.counter += 777
        os.write(keyboard, b"\n")
        said, _ = process.communicate(timeout=PATIENCE_S)
    os.close(keyboard)
    os.close(terminal)
    (line,) = [line for line in said.splitlines() if "encoder.alive" in line]
    assert line.startswith("ok")
    assert "777 counts" in line
    assert set(own.written_v) == {0.0}


def test_a_device_that_a_run_holds_is_refused_and_left_alone(tmp_path):
    from hal.reservation import hold_reservation

    with hold_reservation(SHARED_MEMORY / f"pamctl-{device()}.lock", device()):
        done = run_pamctl(*command("--actuate", "--json")[1:], cwd=tmp_path)
    assert done.returncode == 3
    told = json.loads(done.stdout)["findings"]
    found = index_by_name([report_check(**finding) for finding in told])
    assert found["rig.device"].level == "fault"
    assert f"held by process {os.getpid()}" in found["rig.device"].message
    assert "valve.sign" not in found


@pytest.mark.long
def test_a_watchman_closes_the_valve_of_a_process_that_dies_in_the_middle_of_a_pulse(tmp_path):
    """A signal that can be heeded: `test_calibrate.py`."""
    endless = ["--actuate", "--set", "rig.homing.fill_s=10", "--set", "rig.homing.fill_v=1"]
    with subprocess.Popen(
        command(*endless), cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    ) as process:
        deadline_s = time.monotonic() + PATIENCE_S
        while not ao_path(device()).exists() or peek_v(ao_path(device())) < 5.9:
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < deadline_s, "the valve was never opened"
            time.sleep(0.01)
        process.kill()
    await_true(lambda: peek_v(ao_path(device())) == 0.0, "the valve was left open")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_one_signal_ends_the_work_and_no_second_one_cuts_the_way_out_short(number):
    way_out = []
    before = signal.getsignal(number)
    with pytest.raises(SignalInterrupt) as caught, Interrupts() as interrupts:
        try:
            with interrupts.heed_signals():
                signal.raise_signal(number)
                way_out.append("never")
        finally:
            signal.raise_signal(number)
            signal.raise_signal(signal.SIGTSTP)
            way_out.append("safe")
    assert way_out == ["safe"]
    assert caught.value.code == 128 + number
    assert signal.getsignal(number) is before


def test_a_signal_outside_the_work_waits_for_its_begin_or_for_its_end():
    with pytest.raises(SignalInterrupt), Interrupts() as interrupts:
        signal.raise_signal(signal.SIGTERM)
        with interrupts.heed_signals():
            pytest.fail("the work was begun")
    done = []
    with pytest.raises(SignalInterrupt), Interrupts() as interrupts:
        with interrupts.heed_signals():
            pass
        signal.raise_signal(signal.SIGTERM)
        done.append("closed")
    assert done == ["closed"]


@pytest.fixture(autouse=True, scope="module")
def _leave_no_device() -> Iterator[None]:
    yield
    ao_path(device()).unlink(missing_ok=True)
    (SHARED_MEMORY / f"pamctl-{device()}.lock").unlink(missing_ok=True)
