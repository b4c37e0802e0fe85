"""The page of a diagnosis for every verdict."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pamctl.diagnose.fitting.drives import Drive
from pamctl.diagnose.naming.remainder import regress_remainder
from pamctl.diagnose.naming.rivals import Rival
from pamctl.diagnose.naming.whiteness import ResidualSign
from pamctl.diagnose.report.compared_models import HeldOutRun, HeldOutSignal, ModelStage
from support.browser import look, printed
from support.command_line import parse_command
from typer.testing import CliRunner

from pamctl.cli.app import app
from pamctl.diagnose import Diagnosis, Record, Verdict, diagnose, record_of, summary
from pamctl.diagnose.extend import assemble_plant
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.diagnose.report.next_experiment import choose_next_experiment
from pamctl.diagnose.report.page.diagnosis_page import build_diagnosis_page
from pamctl.diagnose.report.page.traces_part import STRETCH_S, find_telling_stretch
from pamctl.diagnose.report.verdict_words import advise_next_steps
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.model import PlantSettings

HOSTILE = "<script>alert('x')</script>"
SEARCHED = {"valve_deadband", "valve_curve", "cubic_stiffness"}
"""A small catalogue, to save time."""


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two runs in simulation of a rig whose valve has a dead band."""
    folder = tmp_path_factory.mktemp("diagnosed")
    plant = folder / "mine.yaml"
    plant.write_text("effects: {valve_deadband: {fill_width_v: 0.25, exhaust_width_v: 0.2}}\n")
    made = []
    for seed in ("1", "2"):
        made.append(folder / f"run-{seed}.mcap")
        options = ["--experiment", "diagnosis", "--plant", str(plant), "--log", str(made[-1])]
        options += ["--duration", "13", "--seed", seed, "--set", f"experiment.seed={seed}"]
        result = CliRunner().invoke(app, ["run", "--fast", "--quiet", *options])
        assert made[-1].exists(), result.output
    return made


@pytest.fixture(scope="module")
def records(logs: list[Path]) -> list[Record]:
    return [record_of(path) for path in logs]


@pytest.fixture(scope="module")
def named(records: list[Record]) -> Diagnosis:
    """A real diagnosis: the start model lacks the rig's dead band."""
    found = diagnose(records[:1], records[1:], PlantSettings(), without={*CATALOGUE} - SEARCHED)
    assert found.verdict is Verdict.NAMED
    return found


def as_if(named: Diagnosis, verdict: Verdict) -> Diagnosis:
    """The same evidence under another verdict."""
    (standing,) = named.standings
    match verdict:
        case Verdict.NAMED:
            return named
        case Verdict.AMBIGUOUS:
            equal = Rival("valve_asymmetry", 1.02, 0.4, is_equal=True)
            standings = (replace(standing, rivals=(equal, *standing.rivals)),)
            return replace(named, verdict=verdict, standings=standings)
        case Verdict.PARTIAL:
            return replace(named, verdict=verdict, explained_by_block={"pressure": 0.83})
        case _:
            base = named.base
            assert base is not None
            own = tuple(n for n in named.numbers if "." not in n.name)
            bare = replace(named, model=base, misfits=named.base_misfits, standings=(), numbers=own)
            rest = replace(bare, verdict=verdict)
            left = regress_remainder(base, "pressure") if verdict is Verdict.NONE_KNOWN else None
            return replace(rest, plant=assemble_plant(base), explained=0.0, remainder=left)


def page(diagnosis: Diagnosis, records: list[Record]) -> str:
    return build_diagnosis_page(diagnosis, records).html()


def headline(html: str) -> str:
    (found,) = re.findall(r"<h1>(.*?)</h1>", html)
    return found


@pytest.mark.long
def test_the_first_screen_has_verdict_gap_and_next_step_before_any_section(named, records):
    first, _ = page(named, records).split("<h2 id=", 1)
    assert headline(first) == "Missing from the model: valve deadband"
    width_v = float(re.findall(r"dead band where u &gt; 0: ([\d.]+) V \(90 %", first)[0])
    assert width_v == pytest.approx(0.25, abs=0.005)
    assert first.count('class="levels"') == 2
    assert ">What to do next</h2>" in first
    assert "<code>pamctl tune --law qsmc --plant plant.yaml --out gains.yaml</code>" in first


@pytest.mark.parametrize("verdict", Verdict)
def test_every_command_that_is_advised_can_be_typed(named: Diagnosis, verdict: Verdict) -> None:
    found = as_if(named, verdict)
    told = "\n".join([*advise_next_steps(found), summary(found)])
    commands = re.findall(r"`(pamctl [^`]*)`|next: (pamctl [^\n]*)", told)
    for command in filter(None, (one for both in commands for one in both)):
        parse_command(command)


def test_a_record_of_the_whole_program_is_not_told_to_run_it(named: Diagnosis) -> None:
    sentence = "contains them all"
    found = as_if(named, Verdict.AMBIGUOUS)
    assert choose_next_experiment(found) is not None
    assert not any(sentence in step for step in advise_next_steps(found))
    other = replace(found, train=tuple(replace(r, experiment="chirp") for r in found.train))
    assert any(sentence in step for step in advise_next_steps(other))


def test_the_bars_are_the_gap_of_the_diagnosis(named, records):
    html = page(named, records)
    shown = re.findall(r'aria-label="([^"]*): ([\d.e+-]+) (µm|kPa)"', html)
    gaps = [named.gap["position_m"], named.gap["pressure_pa"]]
    told = [f"{g * f:.4g}" for gap, f in zip(gaps, (1e6, 1e-3), strict=True)
            for g in (gap.nominal, gap.recalibrated, gap.extended)]  # fmt: skip
    assert [value for _, value, _ in shown] == told
    assert [label for label, *_ in shown[:3]] == [
        "start model", "recalibrated", "with valve deadband",
    ]  # fmt: skip


def test_a_named_effect_has_its_equation_and_intervals_and_rivals(named, records):
    html = page(named, records)
    assert "A_v = K_Av (u - d_f) for u &gt; d_f" in html
    for number in named.numbers:
        assert f"{number.low:.5g} to {number.high:.5g}" in html
    assert "valve curve</td>" in html
    assert "worse</td>" in html


def test_the_map_of_regimes_begins_with_the_block_that_hides_the_effect(named, records):
    shares = r"(?:<td[^>]*>\d+ %</td>){2}"
    row = rf"<tr><td[^>]*>(pressure|mechanics)</td><td[^>]*>[^<]*</td>{shares}<td[^>]*>([\d.]+)"
    found = re.findall(row, page(named, records))
    left = [float(value) for block, value in found if block == "pressure"]
    assert [block for block, _ in found[: len(left)]] == ["pressure"] * len(left)
    assert left == sorted(left, reverse=True)
    assert left[0] > 20.0


@pytest.mark.parametrize(
    ("verdict", "title", "said"),
    [
        (Verdict.NO_DISCREPANCY, "The model explains", "Go on with the model that you have"),
        (Verdict.MISCALIBRATED, "its numbers are off", "needs no further effect"),
        (Verdict.AMBIGUOUS, "valve deadband or valve asymmetry", "which tells"),
        (Verdict.PARTIAL, "at least valve deadband", "closes 83 % of the pressure block"),
        (Verdict.NONE_KNOWN, "none of the known effects", "it says how the model is wrong"),
    ],
)
def test_every_other_verdict_has_a_page_that_says_so(named, records, verdict, title, said):
    html = page(as_if(named, verdict), records)
    assert title in headline(html)
    assert said in html
    assert ">What to do next</h2>" in html
    assert "<svg" in html


def test_a_residual_that_is_no_noise_is_said_on_the_page_and_in_the_document(named, records):
    sign = ResidualSign("pressure", "coloured", "averaged over 0.1 s it is 3.0 times the noise")
    found = replace(as_if(named, Verdict.NONE_KNOWN), signs=(sign,))
    html = page(found, records)
    assert headline(html) == "The noise is in doubt, so nothing can be said of the model"
    assert html.count("in the pressure block averaged over 0.1 s") >= 2
    document = build_diagnosis_document(found)
    assert document["residual_signs"] == [sign.as_dict()]
    assert document["confirmed_on"]["records"] == [records[1].name]


def test_an_unexplained_remainder_is_drawn_but_never_called_a_cause(named, records):
    html = page(as_if(named, Verdict.NONE_KNOWN), records)
    assert "Pressure block: unnamed correction" in html
    assert "not why" in html
    assert "Unnamed correction, not a cause: the remainder of the pressure" in html
    assert ">The effect</h2>" not in html
    assert "Missing from the model" not in html
    assert "with valve deadband" not in html


def test_two_equal_effects_both_come_first_with_the_experiment_that_separates_them(named, records):
    first, rest = page(as_if(named, Verdict.AMBIGUOUS), records).split("<h2 id=", 1)
    assert "Do not repair the rig on this evidence" in first
    assert "<code>pamctl run --experiment null-staircase</code>" in first
    assert "not told apart</td>" in rest


def test_bad_data_have_a_page_with_the_reason_and_the_columns_as_given(logs, records, tmp_path):
    stuck = replace(records[0], position_m=np.zeros(len(records[0])))
    found = diagnose([stuck], records[1:], PlantSettings())
    assert found.verdict is Verdict.BAD_DATA
    html = build_diagnosis_page(found, [stuck, records[1]]).html()
    assert headline(html) == "These data cannot be diagnosed"
    assert found.reason.split(";")[0] in html
    assert html.count(">valve_v <") == 2


def test_a_log_without_a_command_has_a_page_of_the_mechanics_alone(records):
    alone = replace(records[0].cut_samples(0, 8000, "alone"), valve_v=None)
    found = diagnose([alone], [], PlantSettings(), without={*CATALOGUE} - {"cubic_stiffness"})
    html = build_diagnosis_page(found, [alone]).html()
    assert html.count('class="levels"') == 1
    assert "Pressure block" not in html
    assert "Valve command" not in html
    assert "cut: half for the fit, a third to choose by, a sixth to confirm" in html


def test_diagnose_writes_page_and_document_for_bad_data_too(tmp_path):
    header, out = "t_s,valve_v,pressure_pa,position_m", tmp_path / "out"
    rows = [f"{k * 1e-3:.3f},{k % 2},{2e5 + k},0.0" for k in range(300)]
    (tmp_path / "lab.csv").write_text("\n".join([header, *rows]))
    log = tmp_path / "lab.mcap"
    CliRunner().invoke(app, ["log", "import", str(tmp_path / "lab.csv"), str(log)])
    result = CliRunner().invoke(app, ["diagnose", str(log), "--out", str(out)])
    assert result.exit_code == 65, result.output
    reason = json.loads((out / "diagnosis.json").read_text())["reason"]
    assert reason.split(":")[0] in (out / "report.html").read_text()


def test_names_of_records_are_escaped(named, records):
    hostile = [replace(r, name=HOSTILE) for r in records]
    html = page(named, hostile)
    assert "<script" not in html
    assert "&lt;script&gt;" in html


def test_the_page_of_a_minute_stays_below_a_megabyte(named, records):
    model, base = named.model, named.base
    assert model is not None
    assert base is not None
    longer = {b: tuple(map(five_times, ds)) for b, ds in model.evidence.holdout.items()}
    minute = replace(model.evidence, holdout=longer)
    assert minute.holdout["pressure"][0].step_s.sum() > 60.0
    model, base = replace(model, evidence=minute), replace(base, evidence=minute)
    html = page(replace(named, model=model, base=base), records)
    assert len(html.encode()) < 1_000_000


def five_times(drive: Drive) -> Drive:
    """The same record five times, one after the other."""
    names = ("valve_v", "driven", "measured", "part")
    columns = {name: np.tile(getattr(drive, name), 5) for name in names}
    period = float(np.median(drive.step_s))
    steps = np.concatenate([np.append(drive.step_s, period)] * 5)[:-1]
    return replace(drive, step_s=steps, **columns)


def test_the_selected_stretch_is_where_the_gap_opens():
    t_s = np.arange(20_000) * 1e-3
    opens = 12.0
    gap_m = np.clip(t_s - opens, 0.0, 1.0) * 1e-3
    signal = HeldOutSignal("position_m", gap_m, {"a": np.zeros(20_000), "b": gap_m}, 1e-6)
    record = HeldOutRun("run", t_s, None, np.ones(20_000, dtype=bool), (signal,))
    shown = [ModelStage(key, key, PlantSettings(), 0) for key in "ab"]
    found = find_telling_stretch([record], shown)
    assert t_s[found.start] <= opens
    assert t_s[found.stop - 1] >= opens + 1.0
    assert t_s[found.stop - 1] - t_s[found.start] <= STRETCH_S


@pytest.mark.parametrize("verdict", [Verdict.NAMED, Verdict.NONE_KNOWN])
def test_the_page_fits_a_phone_and_the_console_stays_empty(named, records, tmp_path, verdict):
    file = tmp_path / "report.html"
    file.write_text(page(as_if(named, verdict), records), encoding="utf-8")
    found, console, asked = look(file, tmp_path, width=390)
    assert console == []
    assert found["needed"] <= found["width"]
    assert found["outside"] == []
    assert found["plots"] > 15
    assert found["smallest"] >= 11.5
    assert {path for path in asked if path != "/favicon.ico"} == {"/look.html", "/page.html"}


def test_the_page_can_be_printed(named, records, tmp_path):
    file = tmp_path / "report.html"
    file.write_text(page(named, records), encoding="utf-8")
    assert printed(file, tmp_path).startswith(b"%PDF")
