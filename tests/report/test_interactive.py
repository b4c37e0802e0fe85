"""Interactive pages: zoom and cursor in a real browser; without them, no script."""

import json
import re
from base64 import b64decode
from pathlib import Path

import numpy as np
import pytest
from support.chromium import Page as Tab
from support.chromium import page as open_browser
from typer.testing import CliRunner

from pamctl.cli.app import app
from pamctl.report.axes import MOST_POINTS, PlotAxis
from pamctl.report.figure import MUTED, Plot
from pamctl.report.html_page import embed_plots, write_html
from pamctl.report.report import Figure, Report

GOLDEN = Path(__file__).parents[1] / "golden"
TIME = PlotAxis("time", "s", tight=True)
T_S = np.arange(20_000) * 1e-3
SPIKE = 13_370
HOSTILE = "</script><script>alert(1)</script>\u202e"


def draw_page() -> Report:
    error = np.sin(T_S)
    error[SPIKE] = 40.0
    first = Plot("Error", TIME, PlotAxis("e", "µm")).line(T_S, error, "error")
    first.band(T_S[[0, -1]], -2.0, 2.0).place(13.0, HOSTILE).level(30.0, "limit")
    second = Plot("Command", TIME, PlotAxis("u", "V"))
    second.line(T_S, np.cos(T_S), "of the law", colour=MUTED, thick=True)
    second.points(T_S[5000:5003], [0.5, 0.6, 0.7], "cut")
    page = Report("Zoom")
    page.add(Figure([first, second]))
    page.add(
        Figure([Plot("Plane", PlotAxis("x"), PlotAxis("y")).points(error, error)], is_grid=True)
    )
    return page


def drag(tab: Tab, selector: str, begin: float, end: float) -> None:
    """Drag over an element, from one share of its width to another, and stay in the middle."""
    where = f"document.querySelector({json.dumps(selector)}).getBoundingClientRect()"
    x, y, width = tab.value(f"(b => [b.x, b.y + b.height / 2, b.width])({where})")
    steps = (("mouseMoved", begin), ("mousePressed", begin), ("mouseMoved", 0.5 * (begin + end)),
             ("mouseMoved", end), ("mouseReleased", end))  # fmt: skip
    for kind, share in steps:
        held = {"button": "left", "buttons": 1, "clickCount": 1} if kind != "mouseMoved" else {}
        tab._call("Input.dispatchMouseEvent", type=kind, x=x + share * width, y=y, **held)


def point(tab: Tab, selector: str, share: float) -> None:
    where = f"document.querySelector({json.dumps(selector)}).getBoundingClientRect()"
    x, y, width = tab.value(f"(b => [b.x, b.y + b.height / 2, b.width])({where})")
    tab._call("Input.dispatchMouseEvent", type="mouseMoved", x=x + share * width, y=y)


def read_cursor(tab: Tab, selector: str, share: float) -> list[float]:
    """Time and value in the first plot, and time in the second, with the cursor in the first."""
    point(tab, selector, share)
    tab.value("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    said = tab.value(
        "[document.querySelector('.ptitle .value'), document.querySelector('.legend .value'),"
        " document.querySelector(\"[data-plot='1'] .ptitle .value\")].map(e => e.textContent)"
    )
    return [float(text.split()[0].replace("\N{MINUS SIGN}", "-")) for text in said]


def test_a_reader_zooms_to_a_spike_and_reads_it_to_the_sample(tmp_path):
    path = tmp_path / "zoom.html"
    path.write_text(write_html(draw_page(), interactive=True))
    over = "[data-plot='0'] .u-over"
    with open_browser(tmp_path) as tab:
        tab.open(path.as_uri(), width=1000, height=900)
        tab.wait_for("document.querySelectorAll('.u-over').length === 2")
        # From 13.3 to 13.44 s in three steps; the second plot follows.
        for begin_s, end_s, low_s, high_s in (
            (13.0, 14.0, 0.0, 19.999), (13.3, 13.44, 13.0, 14.0),
        ):  # fmt: skip
            span_s = high_s - low_s
            drag(tab, over, (begin_s - low_s) / span_s, (end_s - low_s) / span_s)
        # At this zoom every sample has some pixels: one look at two places tells where each is.
        left_s, right_s = (read_cursor(tab, over, share)[0] for share in (0.2, 0.8))
        assert 0.05 < right_s - left_s < 0.15
        share = 0.2 + 0.6 * (1e-3 * SPIKE - left_s) / (right_s - left_s)
        assert read_cursor(tab, over, share) == [13.37, 40.0, 13.37]
        at_s, read_um, _ = read_cursor(tab, over, 0.8)
        assert read_um == pytest.approx(np.sin(at_s), abs=6e-3)
        tab.click("button[aria-label='show all']")
        point(tab, over, 0.999)
        tab.wait_for("parseFloat(document.querySelector('.ptitle .value').textContent) > 19.9")
        assert tab.value("document.querySelectorAll('figure svg.data').length") == 1  # the plane
        assert tab.complaints == []
        assert {address.split(":")[0] for address in tab.asked} <= {"file"}

        tab.open(path.as_uri(), width=390, height=800)
        tab.wait_for("document.querySelectorAll('.u-over').length === 2")
        assert tab.value("document.documentElement.scrollWidth") <= 390


def test_without_the_option_a_page_has_no_script_and_with_it_only_its_own():
    page = draw_page()
    assert "<script" not in write_html(page)
    assert "script-src" not in write_html(page)
    html = write_html(page, interactive=True)
    assert html.count("<script") == 3
    assert HOSTILE not in html
    assert "\u202e" not in html
    assert len(re.findall(r"'sha256-[\w+/=]+'", html)) == 2
    assert "<script" not in write_html(Report("words"), interactive=True)


def test_the_data_in_the_page_are_those_of_the_plot_each_once():
    plots = [part for part in (_plot(T_S), _plot(T_S)) if part.can_be_zoomed]
    body = embed_plots(plots).body
    (text,) = re.findall(r'id="plots">(.*?)</script>', body)
    held = json.loads(text)
    assert len(held["arrays"]) == 2  # one time and one signal for both plots
    time, signal = (np.frombuffer(b64decode(part), f"<{kind}") for kind, part in held["arrays"])
    assert np.array_equal(time, T_S)
    assert np.allclose(signal, np.sin(T_S), atol=1e-7)


def _plot(t_s: np.ndarray) -> Plot:
    return Plot("p", TIME, PlotAxis("y")).line(t_s, np.sin(t_s))


def test_a_long_line_keeps_its_extremes_and_its_gaps():
    t_s = np.arange(5 * MOST_POINTS) * 1e-3
    y = np.sin(t_s)
    y[123_456], y[300_000] = 9.0, np.nan
    body = embed_plots([Plot("p", TIME, PlotAxis("y")).line(t_s, y)]).body
    (text,) = re.findall(r'id="plots">(.*?)</script>', body)
    (_, x), (_, kept) = json.loads(text)["arrays"]
    signal = np.frombuffer(b64decode(kept), "<f4")
    assert len(signal) <= 1.01 * MOST_POINTS
    assert np.nanmax(signal) == 9.0
    assert np.frombuffer(b64decode(x), "<f8")[np.isnan(signal)].tolist() == [t_s[300_000]]


def test_the_verbs_write_interactive_pages_when_asked(tmp_path):
    log, page = str(GOLDEN / "qsmc.mcap"), tmp_path / "page.html"
    for arguments, where in ((["report", log], "--out"), (["compare", log], "--plot")):
        done = CliRunner().invoke(app, [*arguments, where, str(page), "--interactive"])
        assert done.exit_code == 0, done.output
        assert "<script" in page.read_text()
    done = CliRunner().invoke(app, ["compare", log, "--interactive"])
    assert done.exit_code == 2
    assert "--plot" in done.output
