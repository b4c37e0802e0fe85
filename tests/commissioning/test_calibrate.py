"""`pamctl calibrate`: what is hidden in a rig is found, within the uncertainty that is stated."""

import json
import os
import re
import signal
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest
from standin.standin import Card, here
from support.benches import Reversed, Unsupplied, bench_of, card_rig
from support.card_rigs import use_card
from support.command_line import run_pamctl, start_process
from support.patience import PATIENCE_S
from support.runs import MS
from typer.testing import CliRunner

from hal.calibration import CalibrationSettings
from hal.faulty import FaultSettings, FaultyRig
from hal.sim import SimRig, SimSettings, peek_v, sensor_chain
from pamctl.commissioning.bench import Bench, LimitError
from pamctl.commissioning.calibrations import (
    calibrate_encoder_by_hand,
    calibrate_encoder_by_muscle,
    calibrate_pressure,
    calibrate_valve,
)
from pamctl.commissioning.guided import (
    CalibrationError,
    CalibrationOutcome,
    PreparedAnswers,
    RigValue,
    insert_values,
)
from pamctl.kernel.calls import prepare
from pamctl.plant.model import plant_parameters
from pamctl.plant.simulated import SimulatedPlant
from pamctl.processes.backends import SHARED_MEMORY, ao_path
from pamctl.realtime.clock import VirtualClock
from pamctl.settings.config_files import config_dir
from pamctl.settings.resolve import RunSettings, check_config_file, resolve
from pamctl.settings.yaml12 import load_yaml, parse_yaml

PAMCTL = str(Path(sys.executable).with_name("pamctl"))
ATMOSPHERE_PA = 101.3e3
TANK_PA = 441.3e3
COUNT_M = 3.175e-6
PA_PER_V = 1.0 / (5.0 * 1.2858e-6)


class Rig:
    """A simulated rig whose true calibration is hidden from the bench."""

    def __init__(
        self,
        settings: RunSettings,
        plant: SimulatedPlant | None = None,
        faults: Sequence[FaultSettings] = (),
        noise_v: float = 0.002,
        zero_v: float = 0.215,
        **hidden: float,
    ) -> None:
        clock = VirtualClock(MS)
        self.plant = plant or SimulatedPlant(plant_parameters(settings.plant), prepare=prepare)
        true = CalibrationSettings(**hidden)  # type: ignore[arg-type]
        self.sim = SimRig(
            self.plant,
            sensor_chain(SimSettings(sensor_noise_v=noise_v, sensor_zero_v=zero_v), true),
            safe_output_v=0.0,
            now_ns=clock.now_ns,
        )
        rig = FaultyRig(self.sim, faults)
        self.bench = bench_of(settings, rig, clock)


class Gauges:
    """An operator who reads the true pressure and the true contraction, from sluggish gauges."""

    def __init__(self, read: Callable[[], float]) -> None:
        self.read = read
        self.reading = 0.0

    def wait(self, request: str, idle: Callable[[], object]) -> None:
        shown = []
        for _ in range(50):
            idle()
            shown.append(self.read())
        self.reading = statistics.fmean(shown[-25:])

    def number(self, question: str, idle: Callable[[], object]) -> float:
        self.wait(question, idle)
        return self.reading


def found(outcome: CalibrationOutcome) -> dict[str, RigValue]:
    return {value.keys[1]: value for value in outcome.values}


def assert_found(value: RigValue, hidden: float) -> None:
    """See that what is hidden was found, within an uncertainty that says something."""
    assert abs(value.value - hidden) <= value.uncertainty
    assert value.uncertainty < 0.02 * abs(hidden)


# --- the pressure sensor -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("zero_v", "gain", "points_kpa"), [(0.19, 0.93, (250.0,)), (0.38, 1.08, (80.0, 160.0, 240.0))]
)
def test_a_wrong_zero_and_gain_of_the_sensor_are_found(zero_v, gain, points_kpa):
    rig = Rig(resolve(), zero_v=zero_v, sensor_pa_per_v=gain * PA_PER_V)
    gauge = Gauges(lambda: (rig.plant.pressure_pa - ATMOSPHERE_PA) * 1e-3)
    values = found(calibrate_pressure(rig.bench, gauge, points_kpa))
    assert_found(values["sensor_zero_v"], zero_v)
    assert_found(values["sensor_pa_per_v"], gain * PA_PER_V)


@pytest.mark.parametrize(
    ("readings", "complaint"),
    [
        ([14.5, 29.0, 43.5], "psi"),
        ([1.0, 2.0, 3.0], "bar"),
        ([100.0, 0.0, 300.0], "cannot read 0"),
        ([100.0, float("nan"), 300.0], "cannot read nan"),
        ([100.0, 240.0, 300.0], "do not lie on a line"),
    ],
)
def test_readings_that_make_no_sense_are_refused(readings, complaint):
    with pytest.raises(CalibrationError, match=complaint):
        calibrate_pressure(Rig(resolve()).bench, PreparedAnswers(readings), (100.0, 200.0, 300.0))


def test_a_zero_outside_the_sensor_s_data_sheet_is_refused():
    with pytest.raises(CalibrationError, match=r"gives 0\.480 V, outside 0\.184 to 0\.409 V"):
        calibrate_pressure(Rig(resolve(), zero_v=0.48).bench, PreparedAnswers([]), ())


def test_a_pressure_that_the_supply_does_not_reach_is_said_so():
    with pytest.raises(LimitError, match=r"does not reach 390 kPa"):
        calibrate_pressure(Rig(resolve()).bench, PreparedAnswers([390.0]), (390.0,))


# --- the encoder -------------------------------------------------------------------------


@pytest.mark.parametrize(("sign", "scale"), [(1, 0.9), (-1, 1.15)])
def test_a_wrong_scale_and_sign_of_the_encoder_are_found_on_the_muscle(sign, scale):
    rig = Rig(resolve(), encoder_sign=sign, encoder_m_per_count=scale * COUNT_M)
    contraction = Gauges(lambda: rig.plant.position_m * 1e3)
    outcome = calibrate_encoder_by_muscle(rig.bench, contraction, (200.0, 300.0))
    values = found(outcome)
    assert values["encoder_sign"].value == sign
    assert ("the opposite" in values["encoder_sign"].how) == (sign < 0)
    assert_found(values["encoder_m_per_count"], scale * COUNT_M)


class Carriage(SimulatedPlant):
    """A vented muscle on a carriage that a hand moves."""

    hand_m = 0.0

    @property
    def position_m(self) -> float:
        return self.hand_m


class Hand(Gauges):
    """Moves the carriage by gauge blocks, in turn, and back to its stop."""

    def __init__(self, carriage: Carriage, blocks_mm: Sequence[float], play_mm: float = 0.0):
        super().__init__(lambda: blocks_mm[0])
        self.carriage = carriage
        self._places_mm = [x for block in blocks_mm for x in (0.0, block + play_mm)]

    def wait(self, request: str, idle: Callable[[], object]) -> None:
        super().wait(request, idle)
        if self._places_mm:
            self.carriage.hand_m = self._places_mm.pop(0) * 1e-3


def on_a_carriage(**hidden: float) -> tuple[Rig, Carriage]:
    settings = resolve()
    carriage = Carriage(plant_parameters(settings.plant))
    return Rig(settings, carriage, **hidden), carriage


@pytest.mark.parametrize("sign", [1, -1])
def test_gauge_blocks_give_scale_and_sign_without_any_pressure(sign):
    rig, carriage = on_a_carriage(encoder_sign=sign, encoder_m_per_count=1.05 * COUNT_M)
    blocks_mm = (5.0, 10.0, 20.0)
    values = found(calibrate_encoder_by_hand(rig.bench, Hand(carriage, blocks_mm), blocks_mm))
    assert values["encoder_sign"].value == sign
    assert_found(values["encoder_m_per_count"], 1.05 * COUNT_M)
    assert rig.sim.output_v == 0.0


@pytest.mark.parametrize(
    ("blocks_mm", "told_mm", "scale", "complaint"),
    [
        ((10.0,), (0.0,), 1.0, "cannot give the scale"),
        ((10.0,), (-10.0,), 1.0, "the sign is found from the counts"),
        ((10.0, -10.0), (10.0, 10.0), 1.0, "differ in direction"),
        ((0.1,), (10.0,), 1.0, "counted 31"),
        ((10.0,), (10.0,), 4.0, "decoded once instead of four times"),
        ((10.0,), (10.0 / 25.4,), 1.0, "in inches"),
        ((5.0, 10.0, 20.0), (5.0, 12.0, 20.0), 1.0, "do not agree on one scale"),
    ],
)
def test_displacements_that_make_no_sense_are_refused(blocks_mm, told_mm, scale, complaint):
    rig, carriage = on_a_carriage(encoder_m_per_count=scale * COUNT_M)
    with pytest.raises(CalibrationError, match=complaint):
        calibrate_encoder_by_hand(rig.bench, Hand(carriage, blocks_mm), told_mm)


def test_an_unplugged_encoder_is_no_scale():
    rig = Rig(resolve(), faults=[FaultSettings(kind="stuck_encoder", from_tick=0)])
    with pytest.raises(CalibrationError, match="counted 0"):
        calibrate_encoder_by_muscle(rig.bench, PreparedAnswers([15.0]), (200.0,))


# --- the valve ---------------------------------------------------------------------------


class Lapped(SimulatedPlant):
    """A valve with a dead band around its null."""

    def advance(self, command_v: float, duration_s: float) -> None:
        opening_v = command_v - 0.12 if command_v > 0.12 else min(command_v + 0.08, 0.0)
        super().advance(opening_v, duration_s)


@pytest.mark.parametrize("offset_v", [4.6, 5.25])
def test_a_wrong_null_of_the_valve_is_found_and_the_supply_with_it(offset_v):
    rig = Rig(resolve(), driver_offset_v=offset_v)
    outcome = calibrate_valve(rig.bench)
    assert_found(found(outcome)["driver_offset_v"], offset_v)
    assert "no dead band seen" in found(outcome)["driver_offset_v"].how
    assert outcome.figures["supply_pressure_pa"] == pytest.approx(TANK_PA, abs=200.0)
    assert "tank_pressure_pa" in outcome.notes[0]
    null_v = found(outcome)["driver_offset_v"].value
    room_v = min(null_v, 10.0 - null_v)
    limit_v = found(outcome)["command_v"].value
    assert limit_v <= room_v, "the command keeps to the driver's range"
    assert limit_v == pytest.approx(room_v, abs=1e-3)


def test_the_null_of_a_valve_with_a_dead_band_lies_in_its_middle():
    settings = resolve()
    rig = Rig(settings, Lapped(plant_parameters(settings.plant)), driver_offset_v=5.1)
    outcome = calibrate_valve(rig.bench)
    assert_found(found(outcome)["driver_offset_v"], 5.1 + 0.02)
    assert outcome.figures["dead_band_v"] == pytest.approx(0.20, abs=0.006)
    assert re.search(r"dead band (19|20)\d mV", found(outcome)["driver_offset_v"].how)


@pytest.mark.parametrize(("kind", "complaint"), [(Reversed, "REVERSED"), (Unsupplied, "supply")])
def test_a_valve_that_is_reversed_or_has_no_supply_has_no_null(kind, complaint):
    settings = resolve()
    with pytest.raises(CalibrationError, match=complaint):
        calibrate_valve(Rig(settings, kind(plant_parameters(settings.plant))).bench)


# --- the same over the card --------------------------------------------------------------


@pytest.fixture
def card() -> Iterator[Card]:
    yield from use_card(here())


@pytest.fixture
def on_card(card: Card) -> Iterator[Bench]:
    """A bench over the stand-in on a virtual clock, by the shipped rig file."""
    settings = resolve(rig="pci6221")
    rig, clock = card_rig(card, settings)
    yield bench_of(settings, rig, clock)
    rig.close()


def test_a_card_with_everything_wrong_is_calibrated_piece_by_piece(card, on_card):
    registers = card.registers
    registers.sensor_zero_v, registers.sensor_pa_per_v = 0.31, 1.06 * PA_PER_V
    registers.driver_offset_v = 4.83
    registers.encoder_sign, registers.encoder_m_per_edge = -1, 0.96 * COUNT_M
    registers.noise_v = 0.001
    gauge = Gauges(lambda: (registers.plant.pressure_pa - ATMOSPHERE_PA) * 1e-3)
    sensor = found(calibrate_pressure(on_card, gauge, (100.0, 200.0)))
    assert_found(sensor["sensor_zero_v"], 0.31)
    assert_found(sensor["sensor_pa_per_v"], 1.06 * PA_PER_V)
    contraction = Gauges(lambda: registers.plant.position_m * 1e3)
    encoder = found(calibrate_encoder_by_muscle(on_card, contraction, (200.0,)))
    assert encoder["encoder_sign"].value == -1
    assert_found(encoder["encoder_m_per_count"], 0.96 * COUNT_M)
    assert_found(found(calibrate_valve(on_card))["driver_offset_v"], 4.83)


# --- the rig file ------------------------------------------------------------------------

HEADING = "2026-11-20 14:00 UTC: pamctl calibrate pressure, from rig.yaml"
ZERO = RigValue(("calibration", "sensor_zero_v"), 0.2173, "V", 1.5e-4, "mean of 1000 samples")
NOTE = "the supply gives 441.3 kPa"


@pytest.mark.parametrize("name", ["sim", "pci6221", "pci6221-comedi"])
def test_a_shipped_rig_file_keeps_its_comments_and_all_other_values(name, tmp_path):
    source = config_dir() / "rig" / f"{name}.yaml"
    text = insert_values(source.read_text(), [ZERO], (HEADING, NOTE))
    before, after = load_yaml(source).data, parse_yaml(text, source).data
    assert after["calibration"].pop("sensor_zero_v") == 0.2173  # type: ignore[attr-defined]
    before["calibration"].pop("sensor_zero_v")  # type: ignore[attr-defined]
    assert after == before
    for comment in re.findall(r"#.*", source.read_text()):
        assert comment in text
    assert f"# {HEADING}" in text
    assert "# the supply gives 441.3 kPa" in text
    assert "2026-11-20: mean of 1000 samples, +-0.00015 V; was 0.2" in text
    (tmp_path / "mine.yaml").write_text(text)
    assert check_config_file(tmp_path / "mine.yaml") == "rig"


@pytest.mark.parametrize(
    "text",
    [
        "backend: sim\n",
        "backend: sim\ncalibration:\n  encoder_sign: 1\n",
        "backend: sim\ncalibration: {}\n",
        "backend: sim\ncalibration: {sensor_zero_v: 0.2, encoder_sign: 1}\n",
        "{backend: sim, calibration: {sensor_zero_v: 0.2}}\n",
        "backend: sim\ncalibration:\n      encoder_sign: 1\nlimits:\n  pressure_pa: 4e5",
        'backend: sim\ncalibration:\n  "sensor_zero_v": 0.2\n',
        "backend: sim\ncalibration:\n  sensor_zero_v:\n    0.2\n",
    ],
)
def test_however_a_rig_file_is_written_the_values_get_in_and_nothing_else_changes(text):
    path = Path("rig.yaml")
    before = parse_yaml(text, path).data
    after = parse_yaml(insert_values(text, [ZERO], (HEADING, NOTE)), path).data
    assert after == {
        **before,
        "calibration": {**before.get("calibration", {}), "sensor_zero_v": 0.2173},
    }  # type: ignore[dict-item]


# --- the command -------------------------------------------------------------------------


def device() -> str:
    return f"sim-calibrate-{os.getpid()}"


@pytest.fixture(autouse=True, scope="module")
def _leave_no_device() -> Iterator[None]:
    yield
    ao_path(device()).unlink(missing_ok=True)
    (SHARED_MEMORY / f"pamctl-{device()}.lock").unlink(missing_ok=True)


def command(what: str, *arguments: str, out: str = "mine.yaml") -> list[str]:
    fixed = [] if "nidaq" in arguments else ["--set", f"rig.sim.device={device()}"]
    fixed += ["--out", out]
    return [PAMCTL, "calibrate", what, *fixed, *arguments]


def calibrate(
    cwd: Path, what: str, *arguments: str, out: str = "mine.yaml", typed: str = ""
) -> subprocess.CompletedProcess[str]:
    return run_pamctl(*command(what, *arguments, out=out)[1:], cwd=cwd, typed=typed)


def test_a_person_at_the_terminal_is_asked_and_gets_a_file_that_passes_the_check(tmp_path):
    done = calibrate(tmp_path, "pressure", "--point", "150", typed="y\nwhat?\nnan\n150,4\n")
    assert done.returncode == 0, done.stderr
    assert "is everything clear of it?" in done.stderr
    assert "'what?' is not a number" in done.stderr
    assert "calibration.sensor_pa_per_v" in done.stdout
    assert run_pamctl("config", "check", "mine.yaml", cwd=tmp_path).returncode == 0
    assert peek_v(ao_path(device())) == 0.0


def test_values_by_options_need_no_terminal_and_give_one_json_document(tmp_path):
    arguments = ["--by", "muscle", "--displacement-mm", "19.63", "--yes", "--json"]
    done = calibrate(tmp_path, "encoder", *arguments)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["rig_file"] == "mine.yaml"
    assert {value["keys"] for value in told["values"]} == {
        "calibration.encoder_m_per_count",
        "calibration.encoder_sign",
    }
    assert (tmp_path / "mine.yaml").exists()


@pytest.mark.parametrize(
    ("arguments", "typed", "code", "complaint"),
    [
        (("pressure",), "n\n", 2, "not confirmed"),
        (("pressure",), "", 2, "standard input has ended"),
        (("pressure", "--yes", "--point", "200", "--reading", "29"), "", 3, "psi"),
    ],
)
def test_what_cannot_be_done_is_said_and_leaves_no_file(
    tmp_path, arguments, typed, code, complaint
):
    done = calibrate(tmp_path, *arguments, typed=typed)
    assert done.returncode == code, done.stderr
    assert complaint in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "mine.yaml").exists()


@pytest.mark.parametrize(
    ("arguments", "out", "complaint"),
    [
        (("valve", "--yes"), "old.yaml", "never overwritten"),
        (("valve", "--yes"), "no/x.yaml", "no directory"),
        (("valve", "--yes"), "mine", "end in .yaml"),
        (("pressure", "--yes", "--reading", "100"), "x.yaml", "values: 1, points: 3"),
        (("pressure", "--yes", "--point", "1e9"), "x.yaml", "must be below 398.7"),
        (("pressure", "--point", "99", "--reading", "nan"), "x.yaml", "must be above 0 (got nan)"),
        (
            ("encoder", "--by", "muscle", "--point", "99", "--displacement-mm", "-1"),
            "x.yaml",
            "must be above 0 (got -1)",
        ),
        (("encoder", "--by", "foot"), "x.yaml", "'hand' or 'muscle'"),
    ],
)
def test_options_that_make_no_sense_are_refused_before_anything_moves(
    tmp_path, arguments, out, complaint
):
    from pamctl.cli.app import app

    (tmp_path / "old.yaml").write_text("backend: sim\n")
    done = CliRunner().invoke(app, command(*arguments, out=str(tmp_path / out))[1:])
    assert done.exit_code == 2
    assert complaint in done.stderr
    assert (tmp_path / "old.yaml").read_text() == "backend: sim\n"


@pytest.mark.long
def test_a_signal_while_a_pressure_is_held_leaves_the_valve_safe(tmp_path):
    """A death: `test_doctor.py`."""
    with start_process(
        command("pressure", "--yes"), cwd=tmp_path, stdin=subprocess.PIPE
    ) as process:
        assert process.stderr is not None
        asked = ""
        while "reference gauge" not in asked:  # the pressure is held now
            letter = process.stderr.read(1)
            assert letter, asked
            asked += letter
        assert peek_v(ao_path(device())) > 1.0  # it is open
        process.send_signal(signal.SIGINT)
        said, complaints = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert "stopped by SIGINT" in said + complaints
    assert "Traceback" not in complaints
    assert peek_v(ao_path(device())) == 0.0
    assert not list(tmp_path.iterdir())
