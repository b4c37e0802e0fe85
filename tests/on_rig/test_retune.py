"""Retuning on the rig: better gains stay, others are taken back, whatever ends it."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import pamctl
from pamctl.cli.analyse.on_rig import OnRigTask, diagnose_on_rig, end_on_signals
from pamctl.control.references.kinds import MuscleSineSettings
from pamctl.exit_codes import ExitCode
from pamctl.on_rig import retune
from pamctl.on_rig.decide_on_rig import Investigation
from pamctl.on_rig.rig_plan import REST_S, Budget, make_rig_plan
from pamctl.on_rig.rig_story import tell_retuning, write_investigation
from pamctl.plant.model import PlantSettings
from pamctl.session.simulated_rig import SimulatedRig

MOTION = MuscleSineSettings(kind="sine", offset_mm=8, amplitude_mm=2, frequency_hz=1, cycles=2)
SLOWER = {"lambda_per_s": 12.0}
"""A gain with which the rig tracks worse."""


@pytest.fixture
def search(monkeypatch: pytest.MonkeyPatch) -> Callable[[dict[str, Any]], None]:
    """Let the search, which takes a minute, find these gains."""

    def find(gains: dict[str, Any]) -> None:
        monkeypatch.setattr(retune, "search_gains", lambda *_: gains)

    return find


@pytest.fixture
def decided(done: Investigation) -> Investigation:
    plan = replace(done.plan, motion=MOTION)
    return replace(done, plan=plan, rounds=[*done.rounds], retuning=None)


def _ignore(line: str) -> None: ...


def test_worse_gains_are_taken_back(
    decided: Investigation, rig: SimulatedRig, search: Callable[[dict[str, Any]], None]
) -> None:
    old, so_far_s = rig.gains, decided.rig_time_s
    search({**old, **SLOWER})
    retune.retune_on_rig(rig, decided, _ignore)
    done = decided.retuning
    assert done is not None
    assert not done.is_kept
    assert rig.gains == old
    rms = {name: run.metrics.rms_error_m for name, run in done.runs.items()}
    assert rms["after"] > 1.5 * rms["before"]
    lasts_s = sum(run.duration_s + REST_S for run in done.runs.values())
    assert decided.rig_time_s == pytest.approx(so_far_s + lasts_s)
    assert "The gains are as before" in tell_retuning(decided)


def test_better_gains_stay_and_go_into_a_file(
    decided: Investigation,
    rig: SimulatedRig,
    search: Callable[[dict[str, Any]], None],
    tmp_path: Path,
) -> None:
    shipped = rig.gains
    rig.load({**shipped, **SLOWER})
    search(shipped)
    retune.retune_on_rig(rig, decided, _ignore)
    assert decided.retuning is not None
    assert decided.retuning.is_kept
    assert rig.gains == shipped
    assert "gains.yaml" in write_investigation(decided, tmp_path / "out")
    document = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    told = document["on_rig"]["retuning"]
    assert told["after"]["rms_error_m"] < told["before"]["rms_error_m"]
    assert told["rig_time_s"] > 0.0


def test_an_interruption_within_the_new_gains_run_brings_the_old_ones_back(
    decided: Investigation, rig: SimulatedRig, search: Callable[[dict[str, Any]], None]
) -> None:
    old = rig.gains
    search({**old, **SLOWER})

    def interrupt(line: str) -> None:
        if line.endswith("with the new gains"):
            assert rig.gains["lambda_per_s"] == SLOWER["lambda_per_s"]
            os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(KeyboardInterrupt), end_on_signals():
        retune.retune_on_rig(rig, decided, interrupt)
    assert rig.gains == old
    assert decided.retuning is not None
    assert decided.retuning.why == "it was interrupted"
    assert [*decided.retuning.runs] == ["before"]


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
        then=None, motion=None, dry_run=False, yes=True,
    )  # fmt: skip
    with pytest.raises(ZeroDivisionError):
        diagnose_on_rig(task, None, as_json=False)
    document = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert document["on_rig"]["stopped"] == "the program failed: ZeroDivisionError: a fault"
    assert document["next_experiment"]["do"] == "pamctl start next-experiment.yaml"


def test_a_motion_that_tracks_nothing_is_refused(rig: SimulatedRig) -> None:
    with pytest.raises(pamctl.PamctlError, match="closed loop") as refused:
        make_rig_plan(rig.settings(), PlantSettings(), "square-1", Budget(), "square-1")
    assert refused.value.exit_code == ExitCode.USAGE
