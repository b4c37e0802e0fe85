"""On the simulated rig: two explanations, the program that decides, and its forecast."""

from __future__ import annotations

import json
import signal
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
import yaml
from support.patience import PATIENCE_S
from support.processes.daemons import daemon

import pamctl
from pamctl.cli.analyse.on_rig import OnRigTask, diagnose_on_rig, end_on_signals
from pamctl.diagnose import Verdict
from pamctl.diagnose.deciding.explanations import list_explanations
from pamctl.diagnose.deciding.separation import ProgramTrial
from pamctl.diagnose.fitting.block_fit import FULL, fit_numbers, rms
from pamctl.diagnose.fitting.drives import PRESSURE
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.report.next_experiment import choose_next_experiment, format_experiment_file
from pamctl.exit_codes import ExitCode
from pamctl.on_rig.decide_on_rig import Investigation, decide_on_rig
from pamctl.on_rig.rig_plan import Budget, make_rig_plan
from pamctl.on_rig.rig_story import write_investigation
from pamctl.plant.model import PlantSettings
from pamctl.session.simulated_rig import SimulatedRig, simulate

pytestmark = pytest.mark.long

DELAY_S = 1e-3


def test_the_second_program_decides_between_delay_and_spool(done: Investigation) -> None:
    first, second = done.rounds
    assert first.diagnosis.verdict is Verdict.AMBIGUOUS
    assert {*first.left} == {"command_delay", "valve_spool"}
    assert second.diagnosis.verdict is Verdict.NAMED
    assert second.left == ("command_delay",)
    assert done.is_decided
    assert done.stopped == "one explanation is left"
    assert done.rig_time_s < 40.0
    (delay,) = (n for n in second.diagnosis.numbers if n.name == "command_delay.delay_s")
    assert delay.value == pytest.approx(DELAY_S, rel=0.05)


def test_the_forecast_is_what_a_whole_refit_leaves(done: Investigation) -> None:
    """Also the one straight step that sorts the programs is near it, where both are near."""
    found = done.rounds[0].diagnosis
    chosen = found.deciding
    assert found.model is not None
    assert chosen is not None
    true, wrong = list_explanations(found.verdict, found.model, found.standings)
    trial = ProgramTrial(chosen.program, (true, wrong), 1e-3)
    (forecast,) = (s for s in chosen.separations if s.refuted == wrong.name)
    assert forecast.block == PRESSURE
    blocks, fitted = next((b, f) for b, f in wrong.model.fits.items() if PRESSURE in b)
    new = trial._prepare_drives(true, blocks, fitted)
    again = fit_numbers((*fitted.drives, *new), fitted.settings, fitted.free, FULL)
    (drive,) = (d for d in new if d.block == PRESSURE)
    left = rms(drive.residual(again.settings)) / wrong.model.floors[PRESSURE].mean
    left *= drive.deviation / wrong.model.evidence.train[PRESSURE][0].deviation
    assert np.hypot(1.0, left) == pytest.approx(forecast.residual_over_floor, rel=0.05)
    (step,) = (s for s in trial.separations if s.refuted == wrong.name)
    assert step.residual_over_floor == pytest.approx(forecast.residual_over_floor, rel=0.2)
    assert forecast.is_decided


def test_the_forecast_is_judged_by_what_the_run_showed(done: Investigation) -> None:
    last = done.rounds[1]
    (judged,) = last.diagnosis.forecasts
    assert (judged.record, judged.true, judged.refuted) == (
        last.log,
        "command_delay",
        "valve_spool",
    )
    assert judged.found is not None
    assert judged.found == pytest.approx(judged.expected, rel=0.3)
    assert judged.is_good


def test_the_program_asks_for_what_was_said(done: Investigation) -> None:
    chosen = done.rounds[0].diagnosis.deciding
    assert chosen is not None
    record = done.records[1]
    assert record["pressure_pa"].max() <= chosen.pressure_pa + 5e3
    assert record["position_m"].max() <= chosen.high_m + 0.3e-3
    assert 0.0 <= record.duration_s - chosen.duration_s < 1.0  # until the end of its stop


def test_the_repeated_part_differs_by_the_sensors_noise_alone(done: Investigation) -> None:
    assert done.rounds[0].repeated == ()
    by_channel = {d.channel: d for d in done.rounds[1].repeated}
    pressure = by_channel["pressure_pa"]
    assert pressure.rms == pytest.approx(pressure.noise, rel=0.15)
    assert by_channel["position_m"].rms <= 2.0 * by_channel["position_m"].noise
    assert done.diagnosis is not None
    assert done.diagnosis.model is not None
    assert done.diagnosis.model.repeatability[PRESSURE].rms > 0.0


def test_the_experiment_file_runs_as_it_stands(done: Investigation, tmp_path: Path) -> None:
    found = done.rounds[0].diagnosis
    chosen = found.deciding
    assert chosen is not None
    path = tmp_path / "next-experiment.yaml"
    path.write_text(format_experiment_file(chosen, ["one.mcap"]))
    assert yaml.safe_load(path.read_text())["forecast"]["pairs"][0]["true"] in chosen.explanations
    with simulate(logs=tmp_path / "logs", overrides=["rig.homing.enabled=false"]) as other:
        run = other.run(path)
    assert run.ending.code == ExitCode.OK
    ticks = round(1e3 * chosen.duration_s)
    asked, ran = (r["valve_v"][:ticks] for r in (done.records[1], run.to_record()))
    assert np.array_equal(ran, asked)
    entry = choose_next_experiment(found)
    assert entry is not None
    assert entry["do"] == "pamctl start next-experiment.yaml"  # a daemon holds the rig
    alone = choose_next_experiment(replace(found, is_of_daemon=False))
    assert alone is not None
    assert alone["do"] == "pamctl run --experiment next-experiment.yaml"
    assert entry["promises"]
    assert entry["needs"]["pressure_kpa"] < 500.0


def test_imported_records_get_words_instead_of_a_program(done: Investigation) -> None:
    found = done.rounds[0].diagnosis
    found = replace(found, is_of_daemon=False)
    imported = tuple(replace(r, is_imported=True) for r in found.train)
    entry = choose_next_experiment(replace(found, train=imported, holdout=imported))
    assert entry is not None
    assert entry["do"].startswith("record: ")


def test_the_folder_tells_the_rounds(done: Investigation, tmp_path: Path) -> None:
    names = write_investigation(done, tmp_path / "out")
    assert {*names} == {"diagnosis.json", "plant.yaml", "report.html"}
    document = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert document["verdict"] == "named"
    assert document["forecasts"][0]["is_good"]
    on_rig = document["on_rig"]
    assert [r["verdict"] for r in on_rig["rounds"]] == ["ambiguous", "named"]
    assert on_rig["rounds"][0]["explanations_left"] == ["command_delay", "valve_spool"]
    assert on_rig["is_decided"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert "On the rig, round by round" in page
    assert "to tell apart command_delay and valve_spool" in page


@pytest.mark.usefixtures("found_before")
def test_an_interruption_keeps_the_rounds_so_far_and_leaves_the_rig_idle(
    done: Investigation, rig: SimulatedRig
) -> None:
    """The given record takes the place of the first program; the second one is interrupted."""
    plan = replace(done.plan, first=None, first_name="", first_s=0.0, demand=None)
    investigation = Investigation(plan, [done.records[0]])

    def interrupt(line: str) -> None:
        if line.startswith("round 1: decide"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        decide_on_rig(rig, investigation, progress=interrupt)
    assert [r.diagnosis.verdict for r in investigation.rounds] == [Verdict.AMBIGUOUS]
    assert investigation.diagnosis is not None
    assert rig.state in ("idle", "ready")


@pytest.mark.usefixtures("found_before")
def test_a_daemon_that_ends_within_a_program_takes_no_round_with_it(
    done: Investigation, logs: Path, tmp_path: Path
) -> None:
    """The daemon is ended as it moves for the program that decides."""
    (given,) = logs.glob(f"{done.records[0].name}*")
    with daemon(tmp_path, "on-rig") as up:

        def end_in_motion() -> None:
            up.wait_for("homing", "running")
            up.process.send_signal(signal.SIGTERM)

        ending = threading.Thread(target=end_in_motion)
        ending.start()
        task = OnRigTask(
            [given], tmp_path / "out", PlantSettings(), "diagnosis", 3, 2.0, up.socket,
            dry_run=False, yes=True,
        )  # fmt: skip
        with pytest.raises(typer.Exit) as left:
            diagnose_on_rig(task, None, as_json=False)
        ending.join()
        up.process.wait(PATIENCE_S)
        assert up.is_safe()
    # A daemon that leaves may still refuse the order that waits for its loop.
    assert left.value.exit_code in (ExitCode.UNAVAILABLE, ExitCode.CHECK_FAILED)
    document = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert [each["verdict"] for each in document["on_rig"]["rounds"]] == ["ambiguous"]
    assert document["on_rig"]["stopped"].startswith("the run failed")


def test_signals_are_as_before_after_the_rounds() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with end_on_signals():
        assert signal.getsignal(signal.SIGTERM) is not before
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.usefixtures("found_before")
def test_a_fault_of_the_program_leaves_the_document_as_far_as_it_is(
    done: Investigation,
    rig: SimulatedRig,
    logs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (given,) = logs.glob(f"{done.records[0].name}*")

    def fail(_: object) -> None:
        raise ZeroDivisionError("a fault")

    monkeypatch.setattr("pamctl.session.daemon_rig.connect", lambda _: rig)
    monkeypatch.setattr(rig, "close", lambda: None)
    monkeypatch.setattr("pamctl.on_rig.decide_on_rig._choose_next", fail)
    task = OnRigTask(
        [given], tmp_path / "out", PlantSettings(), "diagnosis", 3, 2.0, None,
        dry_run=False, yes=True,
    )  # fmt: skip
    with pytest.raises(ZeroDivisionError):
        diagnose_on_rig(task, None, as_json=False)
    document = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert document["on_rig"]["stopped"] == "the program failed: ZeroDivisionError: a fault"
    assert document["next_experiment"]["do"] == "pamctl start next-experiment.yaml"


def test_a_first_program_beyond_the_limits_or_the_budget_is_refused(squares: Path) -> None:
    settings = {**_SETTINGS, "rig": {**_SETTINGS["rig"]}}
    settings["rig"]["limits"] = {**settings["rig"]["limits"], "pressure_pa": 300e3}
    with pytest.raises(pamctl.PamctlError, match="300 kPa") as beyond:
        make_rig_plan(settings, PlantSettings(), str(squares), Budget())
    assert beyond.value.exit_code == ExitCode.CHECK_FAILED
    with pytest.raises(pamctl.PamctlError, match=r"--minutes 0\.3") as long:
        make_rig_plan(_SETTINGS, PlantSettings(), "diagnosis", Budget(1, 0.3))
    assert long.value.exit_code == ExitCode.USAGE
    plan = make_rig_plan(_SETTINGS, PlantSettings(), "diagnosis", Budget())
    assert "500 kPa absolute" in plan.describe()
    assert "58.1 s" in plan.describe()


def _read_settings() -> dict:  # type: ignore[type-arg]
    from pamctl.settings.resolve import resolve, settings_to_data

    return settings_to_data(resolve(fast=True))


_SETTINGS = _read_settings()


def test_a_record_of_an_older_log_has_no_forecast() -> None:
    from pamctl.diagnose.deciding.forecast import read_forecast

    record = Record("r", np.arange(3) * 1e-3)
    assert read_forecast(record) is None
    broken = replace(record, settings={"experiment": {"forecast": {"pairs": []}}})
    assert read_forecast(broken) is None
