"""One investigation on a simulated rig, shared by the tests of this folder."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from support.made_records import ask_only

from pamctl.diagnose import diagnose
from pamctl.plant.model import PlantSettings
from pamctl.session.decide_on_rig import Investigation, decide_on_rig
from pamctl.session.rig_plan import Budget, make_rig_plan
from pamctl.session.simulated_rig import SimulatedRig, simulate

DELAY_S = 1e-3
SQUARES = """
kind: program
parts:
  - {wave: hold, valve_v: -5, duration_s: 1}
  - {wave: square, frequency_hz: 1, amplitude_v: 5, cycles: 2}
  - {wave: hold, valve_v: -5, duration_s: 1.2}
"""
"""Two full strokes alone do not tell a delay from a limited slew."""


@pytest.fixture(scope="package")
def squares(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("experiment") / "squares.yaml"
    path.write_text(SQUARES)
    return path


@pytest.fixture(scope="package")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("logs")


@pytest.fixture(scope="package")
def rig(logs: Path) -> Iterator[SimulatedRig]:
    delayed = {"base": "paper", "effects": {"command_delay": {"delay_s": DELAY_S}}}
    with simulate(delayed, logs=logs) as made:
        yield made


@pytest.fixture(scope="package")
def done(rig: SimulatedRig, squares: Path) -> Investigation:
    plan = make_rig_plan(rig.settings(), PlantSettings(), str(squares), Budget(3, 2.0))
    investigation = Investigation(plan)
    asked = ask_only("command_delay", "valve_slew", "valve_spool")
    with pytest.MonkeyPatch.context() as patch:
        few = partial(diagnose, without=asked)
        patch.setattr("pamctl.session.decide_on_rig.diagnose", few)
        decide_on_rig(rig, investigation)
    return investigation


@pytest.fixture
def found_before(done: Investigation, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first record was diagnosed already: whoever diagnoses it again need not wait."""
    first = done.rounds[0].diagnosis
    monkeypatch.setattr("pamctl.session.decide_on_rig.diagnose", lambda *_, **__: first)
