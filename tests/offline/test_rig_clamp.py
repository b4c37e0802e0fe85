"""A rig that lets the law have less than its own limit does not wind it up."""

from __future__ import annotations

import numpy as np
import pytest
from support.command_line import run_pamctl

from pamctl.log import read
from pamctl.realtime.gain_ramp import fit_law
from pamctl.settings.build import build_tick_setup
from pamctl.settings.resolve import resolve

CLAMP_V = 0.1
SET = [f"rig.limits.command_v={CLAMP_V}", "controller.command_limit_v=5"]


@pytest.mark.long
def test_the_integral_stops_at_the_clamp_of_the_rig(tmp_path) -> None:
    log = tmp_path / "run.mcap"
    words = ["--set", "rig.homing.enabled=false"]  # its fills need more than the clamp
    for change in SET:
        words += ["--set", change]
    done = run_pamctl("run", "--fast", "--controller", "pid", "--duration", 6, *words, "--log", log)
    assert done.returncode == 0, done.stderr
    run = read(log)
    by_law = np.isnan(run["reference_valve_v"])
    commands, saturated = run["command_v"][by_law], run["saturated"][by_law]
    assert np.abs(commands).max() == CLAMP_V
    assert saturated.any()
    assert np.abs(run["robust_v"][by_law]).max() < CLAMP_V  # the integral's share


@pytest.mark.parametrize("law", ["pid", "qsmc", "smc"])
def test_gains_that_are_changed_keep_to_the_clamp_of_the_rig(law) -> None:
    clamped = resolve(controller=law, overrides=SET)
    setup = build_tick_setup(clamped)
    as_low = resolve(controller=law, overrides=[SET[0], f"controller.command_limit_v={CLAMP_V}"])
    assert setup.gains == build_tick_setup(as_low).gains
    assert fit_law(setup, clamped.controller).gains == setup.gains


def test_a_law_with_a_limit_below_the_clamp_keeps_its_own() -> None:
    low = resolve(overrides=["rig.limits.command_v=2", "controller.command_limit_v=1"])
    assert build_tick_setup(low).gains.sliding.limit_v == 1.0
