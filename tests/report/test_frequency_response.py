"""Answers as text and as tables: the response over frequency, numbers, the line of progress."""

import math
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import TypeAdapter

from pamctl.control.course import Course
from pamctl.control.experiment import ExperimentSettings, plan_experiment
from pamctl.report.frequency import find_responses
from pamctl.report.html_page import write_html
from pamctl.report.progress_line import WorkProgress
from pamctl.report.report import Facts, Points, Report, ReportTable, Section, Text, format_terminal
from pamctl.report.reported_run import ReportedRun
from pamctl.signals import Phase

POLE, GAIN, STIFFNESS = 0.99, 2e-5, 200.0
"""The plant x' = 0.99 x + 2e-5 u at 1 kHz, and the law u = 200 (r - y) V/m."""

MULTISINE = {
    "kind": "multisine", "offset_mm": 10, "amplitude_mm": 1, "low_hz": 0.5, "high_hz": 20,
    "period_s": 2, "periods": 9, "tones": 24,
}  # fmt: skip
CHIRP = {
    "kind": "chirp", "offset_mm": 10, "amplitude_mm": 1, "start_hz": 0.5, "end_hz": 20,
    "duration_s": 40,
}  # fmt: skip


def simulate(experiment: dict[str, Any], noise_m: float, seed: int = 1) -> ReportedRun:
    """Run the known loop on an experiment; noise moves the muscle and disturbs the sensor."""
    adapter: TypeAdapter[Any] = TypeAdapter(ExperimentSettings)
    plan = plan_experiment(adapter.validate_python(experiment))
    course, drawn = Course(plan.segments), np.random.default_rng(seed)
    rows, x = [], 0.0
    while (asked := course.at(len(rows) * 1e-3)) is not None:
        y = x + noise_m * drawn.normal()
        is_open = math.isnan(asked.reference_m)
        u = asked.reference_valve_v if is_open else STIFFNESS * (asked.reference_m - y)
        rows.append(
            (len(rows) * 1e-3, asked.phase, asked.reference_m, asked.reference_valve_v, y, u)
        )
        x = POLE * x + GAIN * u + noise_m * 0.1 * drawn.normal()
    names = ("t_s", "phase", "reference_m", "reference_valve_v", "position_m", "valve_v")
    columns = dict(zip(names, np.array(rows).T, strict=True))

    class Recorded(SimpleNamespace):
        def __len__(self) -> int:
            return len(rows)

    log: Any = Recorded(columns=columns, config={"experiment": experiment}, events=[], metadata={})
    return ReportedRun(log, "made")


def plant_at(frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
    response: NDArray[np.complex128] = GAIN / (np.exp(2j * np.pi * frequency_hz * 1e-3) - POLE)
    return response


def loop_at(frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
    open_loop = STIFFNESS * plant_at(frequency_hz)
    return open_loop / (1.0 + open_loop)


@pytest.mark.parametrize("experiment", [MULTISINE, CHIRP], ids=["multisine", "chirp"])
def test_without_noise_the_responses_are_those_of_the_loop(experiment):
    found = find_responses(simulate(experiment, 0.0))
    assert found is not None
    assert found.closed_loop is not None
    within = 1e-3 if experiment is MULTISINE else 0.03  # a band is a sixth of an octave wide
    for curve, truth in ((found.closed_loop, loop_at), (found.plant, plant_at)):
        wanted = truth(curve.frequency_hz)
        assert np.abs(curve.response / wanted - 1.0).max() < within
        assert curve.coherence.min() > 0.99
    assert found.plant.frequency_hz[0] == pytest.approx(0.5, rel=0.3)
    assert found.plant.frequency_hz[-1] == pytest.approx(20.0, rel=0.3)


@pytest.mark.parametrize("experiment", [MULTISINE, CHIRP], ids=lambda e: e["kind"])
def test_the_truth_lies_in_the_intervals_about_as_often_as_they_say(experiment):
    inside = []
    for seed in range(4):
        found = find_responses(simulate(experiment, 2e-4, seed))
        assert found is not None
        assert found.closed_loop is not None
        for curve, truth in ((found.closed_loop, loop_at), (found.plant, plant_at)):
            missed = np.abs(curve.response - truth(curve.frequency_hz))
            assert np.isfinite(curve.radius).all()
            inside += (missed <= curve.radius).tolist()
    assert 0.82 <= np.mean(inside) <= 0.99


def test_the_noise_in_a_loop_biases_the_plant_less_than_the_plain_ratio():
    few = {"low_hz": 4, "high_hz": 16, "tones": 8, "periods": 30}
    run = simulate({**MULTISINE, **few}, 2e-4)
    found = find_responses(run)
    assert found is not None
    frequency_hz = found.plant.frequency_hz
    begin = round(run.t_s[run.phase == Phase.TRACK][0] * 1e3)
    lines = np.rint(frequency_hz * 2.0).astype(int)
    moved, valve = (
        np.fft.rfft(run.log.columns[name][begin:][:60_000].reshape(30, -1), axis=1)[:, lines]
        for name in ("position_m", "valve_v")
    )
    plain = (moved * valve.conj()).sum(axis=0) / (np.abs(valve) ** 2).sum(axis=0)
    ours, theirs = (
        abs((response / plant_at(frequency_hz)).mean() - 1.0)
        for response in (found.plant.response, plain)
    )
    assert ours < 0.1
    assert theirs > 2 * ours


def test_in_open_loop_there_is_the_plant_alone():
    experiment = {
        "kind": "valve_multisine", "amplitude_v": 1, "low_hz": 0.5, "high_hz": 20, "period_s": 2,
        "periods": 1,
    }  # fmt: skip
    found = find_responses(simulate(experiment, 0.0))
    assert found is not None
    assert found.closed_loop is None
    assert np.isnan(found.plant.radius).all()
    assert "no interval" in found.basis
    wanted = plant_at(found.plant.frequency_hz)
    assert np.abs(found.plant.response / wanted - 1.0).max() < 0.05


def test_other_experiments_and_a_run_that_ended_early_have_none():
    run = simulate(MULTISINE, 0.0)
    half = {name: column[: len(run) // 2] for name, column in run.log.columns.items()}
    run.log.columns.update(half)
    assert find_responses(ReportedRun(run.log, "half")) is None
    sine = {"kind": "sine", "offset_mm": 10, "amplitude_mm": 1, "frequency_hz": 1}
    assert find_responses(simulate(sine, 0.0)) is None
    run.log.config["experiment"] = None
    assert find_responses(ReportedRun(run.log, "imported")) is None


# --- answers in text -----------------------------------------------------------------------------


def test_terminal_and_page_say_the_same_and_the_terminal_in_ascii():
    report = Report("Title", "12.3 µm ± 0.1: good").add(
        Section("Errors"),
        ReportTable(["", "max, µm"], [["measured", "38.5"], ["true", "-"]], "All of it."),
        Facts({"plant": "paper"}),
        Points(["run `pamctl doctor`"]),
        Text("\N{MINUS SIGN}3 V"),
    )
    said = format_terminal(report)
    assert said.isascii()
    assert said.splitlines() == [
        "12.3 um +- 0.1: good", "", "Errors", "All of it.", "          max, um",
        "measured     38.5", "true            -", "", "plant  paper", "", "- run pamctl doctor",
        "-3 V",
    ]  # fmt: skip
    page = write_html(report)
    for part in (
        "12.3 µm ± 0.1: good",
        "38.5</td>",
        "<dd>paper</dd>",
        "<code>pamctl doctor</code>",
    ):
        assert part in page


def test_long_work_says_in_a_file_how_far_it_is(capsys):
    with WorkProgress("compare") as show:
        show(1, 4, "paper, mechanics")
        assert "25%" in show.line()
        assert "left" in show.line()
        assert capsys.readouterr().err == ""
        deadline_s = time.monotonic() + 30.0
        while not (said := capsys.readouterr().err) and time.monotonic() < deadline_s:
            time.sleep(0.1)
    # It may say, too, that the model is compiled: that depends on what ran before.
    assert said.startswith("compare: paper, mechanics")
    assert ", 2 s, 25%, about " in said
