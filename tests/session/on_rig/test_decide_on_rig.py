"""On the simulated rig: two explanations, the program that decides, and its forecast."""

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
from pamctl.base.errors import ExitCode, end_on_signals
from pamctl.cli.diagnose import DiagnoseOptions, diagnose_on_rig
from pamctl.diagnose import Verdict
from pamctl.diagnose.deciding_program import ProgramTrial
from pamctl.diagnose.evidence.constants import COARSE_STEP_S
from pamctl.diagnose.evidence.weigh import prepare_weigher
from pamctl.diagnose.explanations import list_explanations
from pamctl.diagnose.record import Record
from pamctl.diagnose.report.diagnosis_page import write_diagnosis
from pamctl.diagnose.report.next_experiment import choose_next_experiment, format_experiment_file
from pamctl.plant.model import PlantSettings
from pamctl.session.decide_on_rig import Investigation, decide_on_rig, write_investigation
from pamctl.session.rig_plan import Budget, make_rig_plan
from pamctl.session.simulated_rig import simulate

pytestmark = pytest.mark.long

DELAY_S = 1e-3


def test_the_second_program_decides_between_delay_and_slew(done):
    first, second = done.rounds
    assert first.diagnosis.verdict is Verdict.DESCRIBED
    assert {"command_delay", "valve_slew"} <= {*first.left}
    assert second.diagnosis.verdict is Verdict.NAMED
    assert second.left == ("command_delay",)
    assert done.is_decided
    assert done.stopped == "one explanation is left"
    assert done.rig_time_s < 40.0
    (delay,) = (n for n in second.diagnosis.numbers if n.name == "command_delay.delay_s")
    assert delay.value == pytest.approx(DELAY_S, rel=0.05)


def test_the_forecast_is_what_a_whole_refit_leaves(done):
    """The wrong plant is fitted to what the true plant would show, with the records so far."""
    found = done.rounds[0].diagnosis
    chosen = found.deciding
    assert found.evidence is not None
    assert chosen is not None
    explanations = list_explanations(found.evidence, found.nominal)
    true, wrong = (
        next(e for e in explanations if e.name == n) for n in ("command_delay", "valve_slew")
    )
    forecast = next(s for s in chosen.separations if (s.true, s.refuted) == (true.name, wrong.name))
    assert forecast.block == "mechanics"
    run = ProgramTrial(chosen.program, (true, wrong), 1e-3).run(true)
    assert len(run.position_m) == round(1e3 * chosen.duration_s)
    noise_m = found.evidence.noise_rms["position_m"]
    shown_m = run.position_m + np.random.default_rng(4).normal(0.0, noise_m, len(run.position_m))
    noise_pa = found.evidence.noise_rms["pressure_pa"]
    shown_pa = run.pressure_pa + np.random.default_rng(5).normal(0.0, noise_pa, len(shown_m))
    commands = ProgramTrial(chosen.program, (true, wrong), 1e-3).commands_v
    new = Record("new", np.arange(len(commands)) * 1e-3, commands, shown_pa, shown_m)
    weigher, start = prepare_weigher([done.records[0], new], [], wrong.plant)
    again = weigher.settle(start)
    off = weigher.train.shown - weigher.train.simulate(
        {**weigher.base, **again.values}, COARSE_STEP_S
    )
    blocks = len(commands) // weigher.train.block
    left = np.sqrt(np.mean(off[weigher.train.channels.index("position_m"), -blocks:] ** 2))
    assert left / noise_m == pytest.approx(forecast.residual_over_floor, rel=0.5)
    assert forecast.sureness > 1.0


def test_the_forecasts_are_judged_by_what_the_run_showed(done):
    last = done.rounds[1]
    judged = {forecast.refuted: forecast for forecast in last.diagnosis.forecasts}
    assert {(each.record, each.true) for each in judged.values()} == {(last.log, "command_delay")}
    assert judged["valve_slew"].is_good
    assert all(each.found is not None and each.found > 10.0 for each in judged.values())


def test_the_program_asks_for_what_was_said(done):
    chosen = done.rounds[0].diagnosis.deciding
    assert chosen is not None
    record = done.records[1]
    assert record["pressure_pa"].max() <= chosen.pressure_pa + 5e3
    assert record["position_m"].max() <= chosen.high_m + 0.3e-3
    assert 0.0 <= record.duration_s - chosen.duration_s < 1.0  # until the end of its stop


def test_the_experiment_file_runs_as_it_stands(done, tmp_path):
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


def test_imported_records_get_a_table_of_commands_to_play(done, tmp_path):
    found = done.rounds[0].diagnosis
    found = replace(found, is_of_daemon=False)
    imported = tuple(replace(r, is_imported=True) for r in found.train)
    found = replace(found, train=imported, holdout=imported)
    entry = choose_next_experiment(found)
    assert entry is not None
    assert entry["do"].startswith("play next-experiment.csv, ")
    assert "Each row holds until the next." in entry["do"]
    assert "your card needs (command - offset) / gain" in entry["do"]
    names = write_diagnosis(found, tmp_path / "out", ["one.csv"], imported)
    assert "next-experiment.yaml" not in names
    at_s, level_v = np.loadtxt(
        tmp_path / "out" / "next-experiment.csv", delimiter=",", skiprows=1
    ).T
    # Each row is held until the next one.
    ticks_s = 1e-3 * np.arange(round(1e3 * at_s[-1]) + 1)
    played = level_v[np.searchsorted(at_s, ticks_s + 1e-9, side="right") - 1]
    asked_v = done.records[1]["valve_v"][: len(played)]
    assert np.allclose(played, asked_v, atol=1e-3)  # a step of the converter


def test_the_folder_tells_the_rounds(done, tmp_path):
    names = write_investigation(done, tmp_path / "out")
    assert {*names} == {"diagnosis.json", "plant.yaml", "report.html"}
    document = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert document["verdict"] == "named"
    assert document["forecasts"][0]["is_good"]
    on_rig = document["on_rig"]
    assert [r["verdict"] for r in on_rig["rounds"]] == ["described", "named"]
    assert on_rig["rounds"][0]["explanations_left"][:2] == ["command_delay", "valve_slew"]
    assert on_rig["is_decided"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert "On the rig, round by round" in page
    assert "to tell apart command_delay and valve_slew" in page


@pytest.mark.usefixtures("found_before")
def test_an_interruption_keeps_the_rounds_so_far_and_leaves_the_rig_idle(done, rig):
    """The given record takes the place of the first program; the second one is interrupted."""
    plan = replace(done.plan, first=None, first_name="", first_s=0.0, demand=None)
    investigation = Investigation(plan, [done.records[0]])

    def interrupt(line: str) -> None:
        if line.startswith("round 1: decide"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        decide_on_rig(rig, investigation, progress=interrupt)
    assert [r.diagnosis.verdict for r in investigation.rounds] == [Verdict.DESCRIBED]
    assert investigation.diagnosis is not None
    assert rig.state in ("idle", "ready")


@pytest.mark.usefixtures("found_before")
def test_a_daemon_that_ends_within_a_program_takes_no_round_with_it(done, logs, tmp_path):
    """The daemon is ended as it moves for the program that decides."""
    (given,) = logs.glob(f"{done.records[0].name}*")
    with daemon(tmp_path, "on-rig") as up:

        def end_in_motion() -> None:
            up.wait_for("homing", "running")
            up.process.send_signal(signal.SIGTERM)

        ending = threading.Thread(target=end_in_motion)
        ending.start()
        with pytest.raises(typer.Exit) as left:
            diagnose_on_rig(ask(given, tmp_path / "out", up.socket), PlantSettings())
        ending.join()
        up.process.wait(PATIENCE_S)
        assert up.is_safe()
    # A daemon that leaves may still refuse the order that waits for its loop.
    assert left.value.exit_code in (ExitCode.UNAVAILABLE, ExitCode.CHECK_FAILED)
    document = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert [each["verdict"] for each in document["on_rig"]["rounds"]] == ["described"]
    assert document["on_rig"]["stopped"].startswith("the run failed")


def ask(log: Path, out: Path, socket: Path | None) -> DiagnoseOptions:
    asked = {"logs": [log], "map_path": None, "out": out, "experiment": "diagnosis", "runs": 3}
    more = {"minutes": 2.0, "socket": socket, "dry_run": False, "yes": True, "as_json": False}
    return DiagnoseOptions(None, asked | more)


def test_signals_are_as_before_after_the_rounds():
    before = signal.getsignal(signal.SIGTERM)
    with end_on_signals():
        assert signal.getsignal(signal.SIGTERM) is not before
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.usefixtures("found_before")
def test_a_fault_of_the_program_leaves_the_document_as_far_as_it_is(
    done, rig, logs, tmp_path, monkeypatch
):
    (given,) = logs.glob(f"{done.records[0].name}*")

    def fail(_: object) -> None:
        raise ZeroDivisionError("a fault")

    monkeypatch.setattr("pamctl.session.daemon_rig.connect", lambda _: rig)
    monkeypatch.setattr(rig, "close", lambda: None)
    monkeypatch.setattr("pamctl.session.decide_on_rig._choose_next", fail)
    with pytest.raises(ZeroDivisionError):
        diagnose_on_rig(ask(given, tmp_path / "out", None), PlantSettings())
    document = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert document["on_rig"]["stopped"] == "the program failed: ZeroDivisionError: a fault"
    assert document["next_experiment"]["do"] == "pamctl start next-experiment.yaml"


def test_a_first_program_beyond_the_limits_or_the_budget_is_refused(squares):
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


def test_a_record_of_an_older_log_has_no_forecast():
    from pamctl.diagnose.explanations import read_forecast

    record = Record("r", np.arange(3) * 1e-3)
    assert read_forecast(record) is None
    broken = replace(record, settings={"experiment": {"forecast": {"pairs": []}}})
    assert read_forecast(broken) is None
