"""The page, the sentence and the document of a diagnosis, for every verdict."""

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.chromium import look
from support.made_records import ask_only, measured, pair
from typer.testing import CliRunner

from pamctl.cli.app import app
from pamctl.diagnose import Diagnosis, Verdict, diagnose, report_diagnosis, sentence
from pamctl.diagnose.evidence.ladder import Finding
from pamctl.diagnose.plant_numbers import FittedNumber, with_values
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.diagnose.report.diagnosis_page import build_diagnosis_page
from pamctl.diagnose.report.finding_words import list_numbers
from pamctl.diagnose.report.traces_part import STRETCH_S, ModelStage, ShownRun, find_telling_stretch
from pamctl.diagnose.report.verdict_words import choose_words
from pamctl.plant.model import PlantSettings
from pamctl.report.html_page import write_html
from pamctl.report.report import format_terminal, spell_figure

HOSTILE = "<script>alert('x')</script>"
DEAD_BAND = {"valve_deadband__fill_width_v": 0.25, "valve_deadband__exhaust_width_v": 0.2}


@pytest.fixture(scope="module")
def named() -> Diagnosis:
    """A real diagnosis: the start model lacks the rig's dead band."""
    asked = ask_only("valve_deadband", "valve_curve", "exhausting~curve", "chamber_leak")
    found = diagnose(*pair(**DEAD_BAND), PlantSettings(), without=asked)
    assert found.verdict is Verdict.NAMED
    return found


def with_level(found: Diagnosis, *levels: str) -> Diagnosis:
    """The same evidence, with the first finding repeated at other levels of the ladder."""
    assert found.evidence is not None
    (first,) = found.findings
    at = {
        "name": (True, True), "kind": (True, True), "place": (True, False), "set": (False, False),
    }  # fmt: skip
    near = tuple(
        replace(first.judged[0], hypothesis=found.evidence.pool[n], is_beaten=False)
        for n in ("valve_curve", "exhausting~curve(command)")
    )
    findings = tuple(
        replace(
            first,
            says_place=at[level][0],
            says_kind=at[level][1],
            doubt="" if level == "name" else "open",
            judged=first.judged if level == "name" else near,
        )
        for level in levels
    )
    return replace(found, evidence=replace(found.evidence, findings=findings))


def as_if(named: Diagnosis, verdict: Verdict) -> Diagnosis:
    """The same evidence under another verdict."""
    match verdict:
        case Verdict.NAMED:
            found = named
        case Verdict.AMBIGUOUS:
            found = with_level(named, "set")
        case Verdict.PARTIAL:
            found = with_level(named, "name", "place")
        case Verdict.DESCRIBED:
            found = with_level(named, "kind")
        case _:
            found = with_level(named)
    reason = "gap: the logger paused" if verdict is Verdict.BAD_DATA else ""
    evidence = None if reason else found.evidence
    return replace(found, verdict=verdict, reason=reason, evidence=evidence)


def page(diagnosis: Diagnosis) -> str:
    records = [*diagnosis.train, *diagnosis.holdout]
    return write_html(build_diagnosis_page(diagnosis, records))


def headline(html: str) -> str:
    (found,) = re.findall(r"<h1>(.*?)</h1>", html)
    return found


def figures_of(document: Any) -> Iterator[float]:
    """Yield every number of a document, also those that a name of its own spells."""
    if isinstance(document, dict):
        for key, value in document.items():
            yield from figures_of(value) if key not in ("sentence", "text") else ()
    elif isinstance(document, list):
        for value in document:
            yield from figures_of(value)
    elif isinstance(document, (int, float)) and not isinstance(document, bool):
        yield float(document)


def is_rounded(text: str, figures: list[float]) -> bool:
    """Tell whether a figure in a text is one of a document, in the unit of a reader."""
    digits = max(len(re.sub(r"^[-+]?0*\.?0*|\.|e.*$|^[-+]", "", text)), 1)
    shown = abs(float(text))
    return any(
        abs(shown - abs(f) * factor) <= 0.5001 * 10.0 ** (_order(abs(f) * factor) + 1 - digits)
        for f in figures
        for factor in (1.0, 100.0, 1e3, 1e6, 1e-3)
    )


def _order(value: float) -> int:
    return int(np.floor(np.log10(value))) if value > 0.0 else -12


@pytest.mark.parametrize("verdict", Verdict)
def test_every_figure_in_a_sentence_is_a_figure_of_the_document(named, verdict):
    document = build_diagnosis_document(as_if(named, verdict))
    words = re.sub(r"90 %", "", document["sentence"])
    figures = [*figures_of(document)]
    shown = re.findall(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]\d+)?(?!\w)", words)
    assert shown or verdict is Verdict.BAD_DATA
    assert [text for text in shown if not is_rounded(text, figures)] == []


@pytest.mark.parametrize("verdict", Verdict)
def test_every_document_is_json_with_the_same_keys(named, verdict):
    document = build_diagnosis_document(as_if(named, verdict))
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert document["schema"] == 2
    named_keys = build_diagnosis_document(named).keys()
    assert {*document} - {"reason"} == {*named_keys}


@pytest.mark.parametrize(
    ("verdict", "title", "said"),
    [
        (Verdict.NO_DISCREPANCY, "The model explains", "Go on with the model that you have"),
        (Verdict.MISCALIBRATED, "its numbers are off", "needs no further effect"),
        (Verdict.AMBIGUOUS, "valve deadband, valve curve or curve of", "more than one place"),
        (Verdict.DESCRIBED, "a law of the command in the valve", "No name is"),
        (Verdict.PARTIAL, "valve deadband; and, without a name, something in the valve", "Sure by"),
        (Verdict.NONE_KNOWN, "nothing that was asked explains it", "same experiment twice"),
        (Verdict.BAD_DATA, "cannot be diagnosed", "the logger paused"),
    ],
)
def test_every_other_verdict_has_a_page_that_says_so(named, verdict, title, said):
    html = page(as_if(named, verdict))
    assert title in headline(html)
    assert said in html
    assert ">What to do next</h2>" in html
    assert "<svg" in html


def test_what_is_sure_of_a_finding_decides_where_the_document_has_it(named):
    by_level = {
        level: build_diagnosis_document(with_level(named, level))
        for level in ("name", "kind", "place", "set")
    }
    filled = {
        level: {k for k in ("effects", "terms", "places", "ambiguous") if document[k]}
        for level, document in by_level.items()
    }
    assert filled == {
        "name": {"effects"}, "kind": {"places"}, "place": {"places"},
        "set": {"effects", "ambiguous"},
    }  # fmt: skip
    assert by_level["set"]["ambiguous"] == [
        ["valve_deadband", "valve_curve", "curve of exhausting over command"]
    ]
    assert by_level["kind"]["places"][0]["kind"] == "over command"
    assert by_level["place"]["places"][0]["kind"] is None
    for level, document in by_level.items():
        (finding,) = document["findings"]
        assert (finding["level"], finding["place"]) == (level, "valve")


def test_a_number_at_its_range_stands_in_the_first_sentence(named):
    assert named.evidence is not None
    (first,) = named.findings
    ended = replace(first, at_range=("valve_deadband.fill_width_v",))
    found = replace(named, evidence=replace(named.evidence, findings=(ended,)))
    first_sentence = sentence(found).split(". ")[0]
    assert first_sentence.endswith("with valve_deadband.fill_width_v at the low end of its range")
    assert build_diagnosis_document(found)["at_bound"] == ["valve_deadband.fill_width_v"]
    rows = format_terminal(report_diagnosis(found)).splitlines()
    (line,) = (row for row in rows if row.startswith("valve_deadband.fill"))
    assert line.endswith("at the low end")
    only_mends = replace(
        found, evidence=replace(named.evidence, findings=(replace(ended, is_rest=True),))
    )
    assert "at the low end" not in sentence(only_mends).split(". ")[0]


@pytest.mark.parametrize(
    "verdict", [v for v in Verdict if v not in (Verdict.BAD_DATA, Verdict.NO_DISCREPANCY)]
)
def test_no_verdict_says_that_nothing_is_missing_where_much_is_left(named, verdict):
    found = as_if(named, verdict)
    assert found.evidence is not None
    noise = {channel: 0.01 * rms for channel, rms in found.evidence.noise_rms.items()}
    words = choose_words(replace(found, evidence=replace(found.evidence, noise_rms=noise)))
    said = f"{words.title}. {words.body} {words.why} {' '.join(words.advice)}"
    assert "more is missing" in said
    assert not re.match("Missing from the model, and without a name", words.title)
    assert not re.search("othing is missing|no further effect|explains the measurement[.]", said)
    assert not re.search("it does,|fits the measurement|predicts what was measured", said)


def test_a_search_that_was_interrupted_can_go_on_from_its_plant_file(named):
    found = as_if(named, Verdict.INTERRUPTED)
    for said in (page(found), format_terminal(report_diagnosis(found))):
        assert "let it end" in said
        assert "Or go on from plant.yaml" in said


@pytest.mark.parametrize(("low", "said"), [(-1.0, "no spring"), (1.0, "at the low end")])
def test_a_spring_that_may_be_absent_is_called_so_and_no_end_of_a_range(
    monkeypatch, named, low, said
):
    stiffness = "stiffness_n_per_m"
    assert named.evidence is not None
    model = named.evidence.model
    at = [n.name for n in model.numbers].index(stiffness)
    x = model.x.copy()
    x[at] = model.numbers[at].low
    unsure = tuple(
        replace(n, low=low) if n.name == stiffness else n for n in named.evidence.recalibrated
    )
    found = replace(named, evidence=replace(named.evidence, model=replace(model, x=x)))
    monkeypatch.setattr(type(named.evidence), "recalibrated", unsure)
    title = choose_words(found).title
    low_end = "with stiffness_n_per_m at the low end of its range"
    absent = "with stiffness_n_per_m as good as 0: no spring"
    assert title.endswith(absent if said == "no spring" else low_end)


def test_a_number_of_the_start_model_that_is_far_off_stands_in_the_sentence(named):
    first = named.recalibrated[0]
    for share, is_said in ((1.5, True), (1.1, False)):
        stated = with_values(named.nominal, {first.name: first.value / share})
        found = replace(named, nominal=stated)
        told = f"{first.name} is {spell_figure(first.value)}"
        assert (told in sentence(found)) == is_said
        assert (told in page(found).split("<h2 id=")[0]) == is_said


def test_a_wave_is_shown_as_amplitude_and_phase_with_their_intervals(named):
    (first,) = named.findings
    halves = (
        FittedNumber("~supply_ripple.sine", 3e3, 2.9e3, 3.1e3, ""),
        FittedNumber("~supply_ripple.cosine", 4e3, 3.9e3, 4.1e3, ""),
        FittedNumber("supply_ripple.frequency_hz", 7.0, 6.9, 7.1, "Hz"),
    )
    wave: Finding = replace(first, numbers=halves)
    size, phase, rate = list_numbers(wave)
    assert (size.name, size.value, size.unit) == ("supply_ripple.amplitude_pa", 5e3, "Pa")
    assert (size.low, size.high) == pytest.approx((4.9e3, 5.1e3))
    assert phase.value == pytest.approx(np.arctan2(4.0, 3.0))
    assert 0.5 * (phase.high - phase.low) == pytest.approx(100.0 / 5e3)
    assert rate == halves[2]


def test_the_first_screen_has_verdict_gap_and_next_step_before_any_section(named):
    first, _ = page(named).split("<h2 id=", 1)
    assert headline(first) == "Missing from the model: valve deadband"
    width_v = float(re.findall(r"fill_width_v ([\d.]+) V \(90 %", first)[0])
    assert width_v == pytest.approx(0.25, abs=0.005)
    assert first.count('class="levels"') == 2
    assert ">What to do next</h2>" in first
    assert "<code>pamctl tune --law qsmc --plant plant.yaml --out gains.yaml</code>" in first


def test_the_bars_are_the_gap_of_the_diagnosis(named):
    shown = re.findall(r'aria-label="([^"]*): ([\d.e+-]+) (µm|kPa)"', page(named))
    gaps = [named.gap["position_m"], named.gap["pressure_pa"]]
    told = [spell_figure(g * f) for gap, f in zip(gaps, (1e6, 1e-3), strict=True) for g in gap[:3]]
    assert [value for _, value, _ in shown] == told
    assert [label for label, *_ in shown[:3]] == [
        "start model", "recalibrated", "with what was found",
    ]  # fmt: skip


def test_a_named_effect_has_its_equation_and_intervals_and_rivals_in_nats(named):
    html = page(named)
    assert "A_v = K_Av (u - d_f) for u &gt; d_f" in html
    for number in named.numbers:
        assert number.spell()[1] in html
    (finding,) = named.findings
    rival = finding.judged[0]
    assert f"{finding.gain_nats:.0f} nats" in html
    assert f"{rival.behind_nats:.0f} nats" in html
    assert "valve curve" in html


def test_a_log_without_a_command_has_a_page_of_the_mechanics_alone():
    alone = replace(measured("fit", 1), valve_v=None)
    plant = PlantSettings.model_validate({"effects": {"dead_volume": {"volume_m3": 1e-5}}})
    said: list[str] = []
    asked = ask_only("coulomb_friction")
    found, told = diagnose([alone], [], plant, without=asked, progress=said.append), " ".join(said)
    html = write_html(build_diagnosis_page(found, [alone]))
    assert html.count('class="levels"') == 1
    assert "Valve command" not in html
    fitted = {n.name for n in found.recalibrated}
    assert "damping_n_s_per_m" in fitted
    assert not fitted & {"valve_gain_m2_per_v", "tank_pressure_pa", "dead_volume.volume_m3"}
    assert told.count("no command: only the mechanics is asked") == 1
    assert "on seconds that were used for no fit" in html


def test_diagnose_writes_page_and_document_for_bad_data_too(tmp_path):
    header, out = "t_s,valve_v,pressure_pa,position_m", tmp_path / "out"
    rows = [f"{k * 1e-3:.3f},{k % 2},{2e5 + k},0.0" for k in range(300)]
    (tmp_path / "lab.csv").write_text("\n".join([header, *rows]))
    log = tmp_path / "lab.mcap"
    CliRunner().invoke(app, ["log", "import", str(tmp_path / "lab.csv"), str(log)])
    result = CliRunner().invoke(app, ["diagnose", str(log), "--out", str(out)])
    assert result.exit_code == 65, result.output
    assert "no --plant: the start model is the paper's muscle and valve" in result.stderr
    reason = json.loads((out / "diagnosis.json").read_text())["reason"]
    assert reason.split(":")[0] in (out / "report.html").read_text()


def test_names_of_records_are_escaped(named):
    hostile = [replace(r, name=HOSTILE) for r in (*named.train, *named.holdout)]
    html = write_html(build_diagnosis_page(named, hostile))
    assert "<script" not in html
    assert "&lt;script&gt;" in html


def test_the_selected_stretch_is_where_the_gap_opens():
    t_s = np.arange(20_000) * 1e-3
    opens = 12.0
    gap_m = np.clip(t_s - opens, 0.0, 1.0)[None] * 1e-3
    left = {"a": gap_m, "b": np.zeros_like(gap_m)}
    noise = np.array([1e-6])
    run = ShownRun(
        "run", t_s, None, ("position_m",), gap_m, left, np.ones_like(gap_m), noise, ((1e6, "µm"),)
    )
    stages = [ModelStage(key, key, None, 0) for key in "ab"]
    found, part = find_telling_stretch([run], stages)
    assert found.t_s[part.start] <= opens
    assert found.t_s[part.stop - 1] >= opens + 1.0
    assert found.t_s[part.stop - 1] - found.t_s[part.start] <= STRETCH_S


@pytest.mark.parametrize("verdict", [Verdict.NAMED, Verdict.AMBIGUOUS])
def test_the_page_fits_a_phone_and_the_console_stays_empty(named, tmp_path, verdict):
    file = tmp_path / "report.html"
    file.write_text(page(as_if(named, verdict)), encoding="utf-8")
    found, console, asked = look(file, tmp_path, width=390)
    assert console == []
    assert found["needed"] <= found["width"]
    assert found["outside"] == []
    assert found["plots"] > 15
    assert found["smallest"] >= 11.5
    assert asked == [file.as_uri()]


def test_a_stated_number_that_is_far_off_stands_in_the_sentence_and_a_guess_does_not(named) -> None:
    far = with_values(named.nominal, {"damping_n_s_per_m": 300.0})
    guess = far.model_copy(update={"guessed": ("damping_n_s_per_m",)})
    told = [sentence(replace(named, nominal=plant)) for plant in (far, guess)]
    assert "damping_n_s_per_m is 57" in told[0]
    assert "damping_n_s_per_m is" not in told[1]
