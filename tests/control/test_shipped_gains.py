"""The claims of the shipped gains files, checked against Table IV on the compiled closed loop."""

import math
import re
from functools import cache

import pytest

from pamctl.offline.closed_loop import simulate_run
from pamctl.offline.merit import TABLE_IV, Merit
from pamctl.settings.config_files import find_config_file
from pamctl.settings.resolve import resolve
from pamctl.tune import GainsTrial, Member

EXPERIMENTS = ("tracking-1", "tracking-2")
DEFAULTS = ("qsmc", "smc", "pid")
FOR_THE_PAPERS_PLANT = tuple(f"{law}-paper-plant" for law in DEFAULTS)
PLANTS = [("paper", 0), ("paper-valve109", 1)]


@cache
def figures(controller: str, experiment: str, plant: str, delay_ticks: int) -> Merit | None:
    """Figures of one simulated run; None where safety ended it."""
    delay = f"rig.sim.output_delay_ticks={delay_ticks}"
    settings = resolve(
        controller=controller, experiment=experiment, plant=plant, overrides=[delay], seed=1
    )
    return simulate_run(settings).merit()


def table_iv(experiment: str, law: str) -> Merit:
    return next(row.merit for row in TABLE_IV if (row.experiment, row.law) == (experiment, law))


def assert_inside(found: Merit | None, bound: Merit, share: float = 1.0) -> None:
    assert found is not None, "a safety trip"
    assert found.max_m <= share * bound.max_m
    assert found.rms_m <= share * bound.rms_m
    if not math.isnan(bound.steady_m) and share == 1.0:
        assert found.steady_m <= bound.steady_m


@pytest.mark.parametrize("plant", ["paper", "paper-valve109"])
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_table_iii_of_the_paper_read_in_inches_lands_inside_table_iv(experiment, plant):
    found = figures("paper-table3-qsmc", experiment, plant, 0)
    assert_inside(found, table_iv(experiment, "qsmc"))


@pytest.mark.parametrize("controller", FOR_THE_PAPERS_PLANT)
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_gains_for_the_papers_plant_reach_a_tenth_of_both_columns_of_table_iv(
    experiment, controller
):
    """The steady error is left out: a tenth of it is half a count of the encoder."""
    found = figures(controller, experiment, "paper", 0)
    for law in ("qsmc", "smc"):
        assert_inside(found, table_iv(experiment, law), share=0.1)


@pytest.mark.parametrize(("plant", "delay_ticks"), PLANTS)
@pytest.mark.parametrize("experiment", EXPERIMENTS)
@pytest.mark.parametrize("controller", DEFAULTS)
def test_default_gains_hold_with_a_109_hz_valve_and_a_tick_of_delay(
    controller, experiment, plant, delay_ticks
):
    found = figures(controller, experiment, plant, delay_ticks)
    assert_inside(found, table_iv(experiment, "smc"))
    assert_inside(found, table_iv(experiment, "qsmc"))


@pytest.mark.parametrize("controller", [*DEFAULTS, *FOR_THE_PAPERS_PLANT])
def test_a_tuned_file_says_how_it_was_made_and_what_it_does_on_the_papers_plants(controller):
    lines = find_config_file("controller", controller).read_text().splitlines()
    words = " ".join(line.removeprefix("#") for line in lines if line.startswith("#")).split()
    header = " ".join(words)
    law = controller.split("-")[0]
    assert f"Made by: pamctl tune --law {law} " in header
    assert f"--out {controller}.yaml" in header
    said = re.search(r"on 2 named plants 2 inside .*? worst (\d+\.\d+)", header)
    assert said is not None
    settings = resolve(controller=controller).controller
    plants = [Member(p, resolve(plant=p).plant) for p in ("paper", "paper-valve109")]
    worst = max(GainsTrial("whole").verdict(settings, plant).worst for plant in plants)
    assert float(said[1]) == pytest.approx(worst, abs=0.005)


def test_the_printed_smc_gains_do_not_track_as_their_file_says():
    assert figures("paper-table3-smc", "tracking-1", "paper", 0) is None
