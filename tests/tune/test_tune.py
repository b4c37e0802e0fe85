"""The search for gains: the same seed gives the same gains, on any number of processes."""

import json
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from support.command_line import run_pamctl, run_process

from pamctl.control.experiment import plan_experiment
from pamctl.control.law import respond
from pamctl.control.law_registry import installed_laws, law_of
from pamctl.control.sliding import Absement
from pamctl.offline.closed_loop import simulate_run
from pamctl.plant.model import PlantSettings
from pamctl.report.report import format_terminal
from pamctl.settings.resolve import check_config_file, resolve, settings_to_data
from pamctl.signals import Estimate, Phase, Reference
from pamctl.tune import BestGains, GainsSearch, GainsTrial, Jury, Member, draw_ensemble
from pamctl.tune.gains_search import compute_cost, find_space
from pamctl.tune.gains_trial import (
    MOVING,
    PARAMETER_TOLERANCE,
    RESTING,
    SHORT,
    UNCERTAIN_PARAMETERS,
    GainsVerdict,
    holds_the_farthest_point,
)
from pamctl.tune.tune_gains import TuningTask, format_gains_file, report_gains, summarise_verdicts

PID = resolve(controller="pid").controller
PAPER = [Member("paper", resolve().plant)]
LAWS = tuple(installed_laws())
ARMED = Absement(0.0)
BEFORE_PAPER = Jury((), tuple(PAPER))

# --- the plants ----------------------------------------------------------------------


def test_the_same_seed_draws_the_same_plants_and_a_larger_ensemble_only_adds():
    assert draw_ensemble(8, 3)[:5] == draw_ensemble(5, 3)
    assert draw_ensemble(5, 3) != draw_ensemble(5, 4)


def test_parameters_stay_in_their_range_and_each_plant_can_do_the_experiments():
    nominal = PlantSettings().parameters
    members = draw_ensemble(40, 0)
    for name in UNCERTAIN_PARAMETERS:
        found = [getattr(m.plant.parameters, name) / getattr(nominal, name) for m in members]
        assert 1.0 - PARAMETER_TOLERANCE <= min(found) < 0.9
        assert 1.1 < max(found) <= 1.0 + PARAMETER_TOLERANCE
    assert all(holds_the_farthest_point(m.plant) for m in members)


# --- the trial -----------------------------------------------------------------------


def test_the_full_trial_agrees_with_the_experiments_of_the_paper():
    verdict = GainsTrial("whole").verdict(PID, PAPER[0])
    for number, experiment in (("1", "tracking-1"), ("2", "tracking-2")):
        found = simulate_run(resolve(controller="pid", experiment=experiment)).merit()
        assert found is not None
        assert verdict.figures_um[f"max {number}"] == found.max_m * 1e6
        assert verdict.figures_um[f"RMS {number}"] == found.rms_m * 1e6
    assert verdict.is_inside
    assert tuple(RESTING) == (272e-6, 35.6e-6, 15e-6)
    assert MOVING[:2] == (284e-6, 43.2e-6)
    ratios = (verdict.figures_um["RMS 1"] / 35.6, verdict.figures_um["RMS 2"] / 43.2)
    assert verdict.worst >= max(ratios)
    assert verdict.mean <= verdict.worst


def test_the_short_trial_ranks_gains_like_the_full_one():
    """It is what the search goes by."""
    weak = [PID.model_copy(update={"kp_v_per_length": kp}) for kp in (9.5, 3.0, 1.0, 0.3)]
    short, whole = (
        [GainsTrial(length).verdict(gains, PAPER[0]).worst for gains in weak]  # type: ignore[arg-type]
        for length in ("short", "whole")
    )
    assert sorted(short) == short
    assert sorted(whole) == whole
    assert np.corrcoef(np.log(short), np.log(whole))[0, 1] > 0.95


def test_trials_last_as_long_as_stated_and_the_short_one_rests_as_long_as_the_paper():
    """A steady error that is counted too early favours an integral that hunts."""
    experiments = [resolve(experiment=f"tracking-{number}").experiment for number in (1, 2)]
    assert SHORT.rest_s == experiments[0].rest_s  # type: ignore[union-attr]
    assert GainsTrial("short").duration_s == sum(
        s.duration_s for s in plan_experiment(SHORT).segments
    )
    both = [
        s.duration_s for experiment in experiments for s in plan_experiment(experiment).segments
    ]
    assert GainsTrial("whole").duration_s == pytest.approx(sum(both))


@pytest.mark.parametrize("hold_s", [0.0, 6.0])
def test_a_motion_of_ones_own_that_never_rests_is_held_to_experiment_2(hold_s, tmp_path):
    ramps = {"kind": "ramps", "levels_mm": [6, 8, 6], "speed_mm_per_s": 4}
    path = tmp_path / "mine.yaml"
    path.write_text(json.dumps({**ramps, "jerk_mm_per_s3": 900, "hold_s": hold_s}))
    base = resolve(experiment=str(path)).model_dump_json()
    verdict = GainsTrial("whole", base, own_motion=True).verdict(PID, PAPER[0])
    bounds_um = {"max": 272.0, "RMS": 35.6, "steady": 15.0} if hold_s else {"max": 272, "RMS": 43.2}
    assert verdict.figures_um.keys() == bounds_um.keys()
    ratios = [verdict.figures_um[name] / bound for name, bound in bounds_um.items()]
    assert verdict.mean == pytest.approx(np.mean(ratios))
    assert verdict.worst == pytest.approx(max(ratios))


# --- the space -----------------------------------------------------------------------


@pytest.mark.parametrize("law", LAWS)
@given(data=st.data())
def test_every_point_is_a_controller_that_can_be_written_and_read(law, data):
    space = find_space(law)
    point = np.array([data.draw(st.floats(low, high)) for low, high in space.bounds])
    controller = space.controller(point)
    gains = space.gains(point)
    assert {name: settings_to_data(controller)[name] for name in gains if name != "model"} == {
        name: value for name, value in gains.items() if name != "model"
    }
    assert space.point(gains) == pytest.approx(point, abs=2e-3)


@pytest.mark.parametrize("law", LAWS)
def test_the_stiffness_of_the_search_is_the_response_of_the_law_to_an_error(law):
    """All laws are therefore searched within the same bounds of it."""
    space = find_space(law)
    point = space.usual
    sought = dict(zip((axis.name for axis in space.space.axes), 10.0**point, strict=True))
    controller = space.controller(point)
    gains = law_of(controller).to_gains(controller)
    resting = Reference(Phase.REST, 11.81e-3, 0.0, 0.0, 0.0, np.nan)
    half_filled_pa = 0.5 * (441.3e3 + 101.3e3)
    short_of_it = Estimate(11.8e-3, half_filled_pa, -0.01e-3, 0.0, 0.0)
    command, _ = respond(gains, ARMED, ARMED, resting, short_of_it, 1e-9)
    stiffness = sought.get("stiffness_v_per_mm", sought.get("kp_v_per_length"))
    assert command.command_v == pytest.approx(0.01 * stiffness, rel=0.01)


# --- the jury ------------------------------------------------------------------------


class Told(GainsTrial):
    """A trial whose verdicts are known beforehand: a plant's name is its ratio."""

    def verdict(self, controller: object, member: Member) -> GainsVerdict:
        return GainsVerdict(float(member.name), "told", {}, 0.0)


def called(*ratios: float) -> tuple[Member, ...]:
    return tuple(Member(str(ratio), PAPER[0].plant) for ratio in ratios)


def test_gains_cost_the_worst_named_plant_and_a_quantile_of_the_drawn_ones():
    jury = Jury(called(*range(21)), called(20, 30))
    found = compute_cost(PID, np.inf, jury, Told(), range(21))
    assert found.value == 30.0 + 19.0
    assert found.runs == 23


@given(
    drawn=st.lists(st.integers(1, 9), min_size=1, max_size=12),
    named=st.lists(st.integers(1, 9), max_size=3),
    limit=st.floats(0.5, 20.0),
    data=st.data(),
)
def test_skipping_plants_never_changes_the_best_gains(drawn, named, limit, data):
    jury = Jury(called(*drawn), called(*named))
    order = data.draw(st.permutations(range(len(drawn))))
    whole = compute_cost(PID, np.inf, jury, Told(), range(len(drawn)))
    raced = compute_cost(PID, limit, jury, Told(), order)
    assert raced.value <= whole.value
    assert (raced.value <= limit) == (whole.value <= limit)
    assert raced.value > limit or raced == whole._replace(ratios=raced.ratios)


# --- the search ----------------------------------------------------------------------


def search() -> GainsSearch:
    return GainsSearch("pid", BEFORE_PAPER, 1)


@pytest.fixture(scope="module")
def three_generations() -> list[float]:
    going = search()
    return [going.advance().cost for _ in range(3)]


def test_the_search_improves_and_never_worsens(three_generations):
    assert three_generations == sorted(three_generations, reverse=True)
    assert three_generations[-1] < 1.0


def test_a_search_begins_within_its_bounds_in_every_part_of_them():
    going = search()
    low, high = np.array(find_space("pid").bounds).T
    shares = (going._population - low) / (high - low)
    assert ((shares >= 0.0) & (shares <= 1.0)).all()
    apart = shares[len(shares) // 2 :]
    assert (np.unique(np.floor(apart * len(shares)), axis=0).shape) == apart.shape


def test_several_processes_or_threads_find_the_same_gains(three_generations):
    going = search()
    with ThreadPoolExecutor(2) as executor:
        assert [going.advance(executor).cost for _ in range(2)] == three_generations[:2]


# --- the command ---------------------------------------------------------------------


def tune(*options: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return run_pamctl("tune", *options, cwd=cwd)


def test_a_score_says_how_many_plants_are_inside_and_what_is_too_large_on_the_others():
    members = [Member(name, PAPER[0].plant) for name in ("good", "bad", "worse")]
    good = GainsVerdict(0.5, "max 1", {"max 1": 136.0, "RMS 1": 15.0}, 0.4)
    bad, worse = good._replace(worst=1.5, why="RMS 2"), GainsVerdict(90.0, "safety trip", {}, 90.0)
    scores = summarise_verdicts(members, [good, worse, bad])
    assert (scores.inside, scores.median, scores.worst) == (1, 1.5, 90.0)
    task = TuningTask("pid", BEFORE_PAPER, [], 0, None, PID, None, (), GainsTrial("whole"))
    said = format_terminal(report_gains(task, {"named": scores}, {}))
    assert said.startswith("pid, named plants: 1 of 3 inside every bound of Table IV (33.3 %)")
    assert "outside: plant bad: safety trip" in said
    assert "outside: plant worse: RMS error of experiment 2 is 1.50 times the paper's" in said
    own = replace(task, whole_trial=GainsTrial("whole", own_motion=True))
    assert "errors over those of the median plant: 95 % 60.00" in format_terminal(
        report_gains(own, {"named": scores._replace(errors_um={"max": 9.0, "RMS": 2.0})}, {})
    )
    best = BestGains({"law": "pid"}, 1.25, 3, 75)
    header = format_gains_file(task, best, {"named": scores}, "pamctl tune --law pid")
    words = " ".join(header.replace("# ", "").split())
    assert "PID: u = -(K_p e" in words
    assert "3 generations, 75 runs of 104 s, for paper; cost 1.250." in words
    assert "on 3 named plants 1 inside Table IV (33.3 %), score median 1.50" in words
    assert "pamctl tune --law pid" in words


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--law", "lqr", "--out", "x.yaml"], "--law lqr: must be one of"),
        (
            ["--plant", "chamber.yaml"],
            "`pamctl plant export PLANT.yaml PLANT.fmu` makes an FMU of it",
        ),
        (["--plant", "axis.yaml"], "plant.drive_n_per_v is missing"),
        (["--plant", "driven.yaml"], "rig.safe_volts 0 is a command of -5 V, which pushes"),
        (["--plant", "driven.yaml", "--rig", "sim", "--set", "rig.safe_volts=5"], "rig.homing"),
        (["--law", "pid", "--out", "there.yaml"], "never overwritten"),
        (["--law", "pid", "--out", "no/where.yaml"], "no directory"),
        (["--law", "pid", "--out", "x.yaml", "--plant", "papier"], "did you mean 'paper'"),
        (["--law", "pid", "--out", "x.yaml", "--start", "qsmc"], "gains of qsmc"),
        (["--law", "pid", "--out", "x.yaml", "--start", "nope"], "--start nope: there is no such"),
        (["--check", "pid", "--out", "x.yaml"], "for --out: belongs to a search: with --check"),
    ],
)
def test_invalid_options_are_refused(tmp_path, options, said):
    (tmp_path / "there.yaml").write_text("")
    (tmp_path / "chamber.yaml").write_text("actuator: chamber\nchamber_volume_m3: 1e-3\n")
    (tmp_path / "axis.yaml").write_text(AXIS.replace("drive_n_per_v: 20\n", ""))
    (tmp_path / "driven.yaml").write_text(AXIS)
    made = tune(*options, cwd=tmp_path)
    assert made.returncode in (2, 78)
    assert said in made.stderr


AXIS = """\
actuator: direct
drive_n_per_v: 20
parameters: {mass_kg: 4, damping_n_s_per_m: 30, stiffness_n_per_m: 0}
effects: {coulomb_friction: {force_n: 6}}
"""


def test_three_commands_lead_from_a_plant_of_ones_own_to_gains_and_a_run(tmp_path):
    """An axis that a force drives, which is no muscle: law, file and errors have their defaults."""
    (tmp_path / "plant.yaml").write_text(AXIS)
    rows = "\n".join(f"{t},{x}" for t, x in ((0, 0), (1, 60), (2, 0)))
    (tmp_path / "motion.csv").write_text(f"t_s,position_mm\n{rows}\n")
    (tmp_path / "mine.yaml").write_text("kind: table\nfile: motion.csv\n")
    which = ["--plant", "plant.yaml", "--rig", "axis", "--experiment", "mine.yaml"]
    made = tune(*which, "--generations", "1", "--jobs", "1", cwd=tmp_path)
    assert made.returncode == 0, made.stderr
    assert made.stdout.startswith("pid, named plants: largest error ")
    assert "inside" not in made.stdout
    header = (tmp_path / "gains.yaml").read_text()
    assert "pamctl tune --plant plant.yaml --rig axis" in header
    assert "--generations 1" in header
    assert check_config_file(tmp_path / "gains.yaml") == "controller"
    assert "inside" not in header
    run = ["--fast", "--quiet", "--controller", "gains.yaml", "--log", "run.mcap"]
    ran = run_pamctl("run", *which, *run, cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    assert "paper" not in ran.stdout
    again = tune(*which, "--jobs", "1", cwd=tmp_path)
    assert again.returncode == 2
    assert "gains.yaml" in again.stderr


def test_gains_are_sought_for_a_motion_of_ones_own_at_another_rate_and_on_a_card(tmp_path):
    rows = "\n".join(f"{t},{x}" for t, x in ((0, 2), (1, 6), (2, 3)))
    (tmp_path / "motion.csv").write_text(f"t_s,position_mm\n{rows}\n")
    (tmp_path / "mine.yaml").write_text("kind: table\nfile: motion.csv\n")
    which = ["--plant", "paper", "--experiment", "mine.yaml", "--rig", "pci6221"]
    rate = ["--set", "rig.loop.rate_hz=500"]
    size = ["--generations", "1", "--jobs", "1"]
    made = tune("--law", "pid", *which, *rate, *size, "--out", "g.yaml", cwd=tmp_path)
    assert made.returncode == 0, made.stderr
    assert "pid, named plants: largest error " in made.stdout
    assert "without homing. A run homes first" in made.stdout
    assert "paper" not in made.stdout + (tmp_path / "g.yaml").read_text().split("Score:")[1]
    found = yaml.safe_load((tmp_path / "g.yaml").read_text())
    assert max(found["lpf1_hz"], found["lpf2_hz"]) <= 225.0
    open_loop = ["--experiment", "square-1", "--out", "x.yaml"]
    refused = tune("--law", "pid", "--plant", "paper", *open_loop, cwd=tmp_path)
    assert refused.returncode == 2
    assert "tracks nothing" in refused.stderr


@pytest.mark.long
def test_a_signal_keeps_the_best_gains_so_far(tmp_path):
    (tmp_path / "short.yaml").write_text("kind: hold\nposition_mm: 3\ntransition_s: 1\nhold_s: 1\n")
    command = [sys.executable, "-m", "pamctl", "tune", "--plant", "paper"]
    short = ["--experiment", "short.yaml", "--generations", "1000", "--jobs", "2"]
    process = subprocess.Popen(
        [*command, *short, "--out", "mine.yaml"],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        cwd=tmp_path,
    )
    assert process.stderr is not None
    assert any(b"of 1000, best so far" in line for line in process.stderr)
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=120)
    assert process.returncode == 143, said
    assert check_config_file(tmp_path / "mine.yaml") == "controller"
    assert b"--start mine.yaml goes on from these gains" in said
    assert not _children_of(process.pid)


def _children_of(pid: int) -> list[str]:
    listed = run_process(["ps", "-o", "pid=", "--ppid", str(pid)])
    return listed.stdout.split()
